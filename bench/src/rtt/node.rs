//! Programs without Gleaner: the nodes of `bench/baselines`, as a user would write them, and those
//! in Rust of `native`.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Command;

use clap::ValueEnum;
use gleaner_tests::live::RunningProgram;
use gleaner_tests::root;
use serde_json::Value;

use super::ANSWERS;
use super::workload::{IMU, Workload};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NodeKind {
    /// A reader that only answers.
    Bare,
    /// The same reader, with the arithmetic of the workload.
    Rust,
    /// Cyclone DDS for Python: a stand-in where there is no ROS 2.
    StandIn,
    /// An ordinary ROS 2 node.
    Rclpy,
    /// The same, with a C library that keeps the memory of messages.
    RclpyKeepingMemory,
}

/// A node, the number of messages that its topics keep, and the limit of socket buffers.
pub(super) struct NodeSide {
    pub(super) kind: NodeKind,
    pub(super) depth: u32,
    pub(super) buffer: u64,
}

/// Settings of glibc with which it keeps the memory of messages.
const KEEPING: [(&str, &str); 3] = [
    ("MALLOC_MMAP_THRESHOLD_", "33554432"),
    ("MALLOC_TRIM_THRESHOLD_", "4294967296"),
    ("MALLOC_TOP_PAD_", "67108864"),
];

/// Facts that a node states, and their names in the table.
const FACTS: [(&str, &str); 5] = [
    ("stack", "stack"),
    ("socket_buffer", "socket buffer, B"),
    ("depth", "depth"),
    ("luma", "luma"),
    ("model", "model"),
];

impl NodeSide {
    /// Name of the reader that only answers.
    pub(super) const BARE: &'static str = "bare reader";
    /// Name of the node with the arithmetic of the wasm lambda, without isolation.
    pub(super) const RUST: &'static str = "native Rust";
    /// Name of the stand-in.
    pub(super) const STAND_IN: &'static str = "stand-in (Cyclone DDS for Python)";
    /// Name of the ROS 2 node.
    pub(super) const RCLPY: &'static str = "rclpy";

    /// Number of messages that a topic keeps in ROS 2 by default.
    pub(super) const DEPTH: u32 = 10;

    pub(super) fn name(&self) -> String {
        let name = match self.kind {
            NodeKind::Bare => Self::BARE,
            NodeKind::Rust => Self::RUST,
            NodeKind::StandIn => Self::STAND_IN,
            NodeKind::Rclpy => Self::RCLPY,
            NodeKind::RclpyKeepingMemory => "rclpy, memory kept",
        };
        match self.depth {
            Self::DEPTH => name.to_owned(),
            depth => format!("{name}, depth {depth}"),
        }
    }

    /// Starts the node, and waits for its topics; returns what it states about itself.
    ///
    /// # Errors
    ///
    /// The reason why it cannot run here.
    pub(super) fn start(
        &self,
        workload: Workload,
    ) -> Result<(RunningProgram, BTreeMap<String, String>), String> {
        let started = RunningProgram::start(match self.kind {
            NodeKind::Bare | NodeKind::Rust => self.native(workload),
            NodeKind::StandIn | NodeKind::Rclpy | NodeKind::RclpyKeepingMemory => {
                self.baseline(workload)?
            }
        });
        let first = started.until_line("the first line of a node", |line| {
            serde_json::from_str::<Value>(line).ok()
        });
        if let Some(why) = first["skipped"].as_str() {
            return Err(why.to_owned());
        }
        let facts = FACTS.iter().filter_map(|(key, name)| {
            let value = match &first[*key] {
                Value::Null => return None,
                Value::String(text) => text.clone(),
                other => other.to_string(),
            };
            Some(((*name).to_owned(), value))
        });
        Ok((started, facts.collect()))
    }

    fn native(&self, workload: Workload) -> Command {
        let mut command = Command::new(std::env::current_exe().expect("a program has a path"));
        let workload = workload.to_possible_value().expect("no workload is hidden");
        command.args(["node", workload.get_name()]);
        command.args((self.kind == NodeKind::Bare).then_some("--bare"));
        command
    }

    fn baseline(&self, workload: Workload) -> Result<Command, String> {
        let (folder, python) = if self.kind == NodeKind::StandIn {
            ("cyclonedds_py", root().join("target/baselines/bin/python3"))
        } else {
            let python = std::env::var_os("GLEANER_ROS_PYTHON");
            ("rclpy", python.map_or_else(|| "python3".into(), PathBuf::from))
        };
        if self.kind == NodeKind::StandIn && !python.is_file() {
            return Err(format!("there is no {}", python.display()));
        }
        let mut command = Command::new(python);
        command.arg(root().join("bench/baselines").join(folder).join("node.py"));
        command.arg(workload.of_baseline()).args(["--input", IMU.0, "--answers", ANSWERS]);
        command.args(["--depth", &self.depth.to_string()]);
        if workload.is_of_images() {
            command.args(["--image", workload.event().0]);
        }
        command.args(workload.config().iter().flat_map(|value| ["--config", value]));
        command.env("CYCLONEDDS_URI", self.cyclone());
        if self.kind == NodeKind::RclpyKeepingMemory {
            command.envs(KEEPING);
        }
        Ok(command)
    }

    /// Returns the configuration of Cyclone DDS: as much socket buffer as the system grants.
    fn cyclone(&self) -> String {
        format!(
            "<CycloneDDS><Domain id=\"any\"><Internal>\
               <SocketReceiveBufferSize min=\"{}B\"/>\
             </Internal></Domain></CycloneDDS>",
            self.buffer
        )
    }
}

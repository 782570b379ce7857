//! Tests of the commands for a cloud, as a user starts them, with a cloud that gives set answers.

mod fake;
mod fleet;
mod people;
mod vehicles;

use std::fs;
use std::path::PathBuf;
use std::process::Command;

use serde_json::{Value, json};
use tempfile::TempDir;

use crate::programs;
use fake::FakeServer;

struct CloudUser {
    folder: TempDir,
    cloud: FakeServer,
}

impl CloudUser {
    fn new() -> Self {
        Self { folder: tempfile::tempdir().unwrap(), cloud: FakeServer::on_tcp() }
    }

    fn logged_in() -> Self {
        let user = Self::new();
        let session = json!({
            "user": { "name": "ada", "role": "admin" }, "token": "gln_1", "expires": 4102444800_u64,
        });
        user.cloud.answers("POST /v1/login", &[(200, session)]);
        let text = user.done(&["login", &user.cloud.url(), "--code", "c0de"]);
        assert!(text.contains("as ada (admin; expires 2100-01-01T00:00:00Z)"), "{text}");
        assert!(!text.contains("gln_1"), "{text}");
        user
    }

    fn path(&self, path: &str) -> PathBuf {
        self.folder.path().join(path)
    }

    fn command(&self, arguments: &[&str]) -> Command {
        let mut gleaner = programs::gleaner(self.folder.path(), arguments);
        gleaner.env("XDG_CONFIG_HOME", self.path("config"));
        for variable in ["GLEANER_CLOUD", "GLEANER_CLOUD_TOKEN", "GLEANER_RUN"] {
            gleaner.env_remove(variable);
        }
        gleaner
    }

    /// Runs a command that must succeed, and returns its output.
    #[track_caller]
    fn done(&self, arguments: &[&str]) -> String {
        programs::done(&mut self.command(arguments))
    }

    #[track_caller]
    fn json(&self, arguments: &[&str]) -> Value {
        serde_json::from_str(&self.done(&[arguments, &["--json"]].concat())).unwrap()
    }

    /// Runs a command that must fail with `code`, and returns its message.
    #[track_caller]
    fn fails(&self, code: i32, arguments: &[&str]) -> String {
        programs::fails(self.command(arguments), code)
    }
}

#[test]
fn commands_of_the_cloud_itself_are_passed_on_with_their_exit_status() {
    let user = CloudUser::new();
    let home = user.path("home");
    fs::create_dir(&home).unwrap();
    programs::script(&home.join("gleaner-cloud"), "#!/bin/sh\necho \"$@\"\nexit 7\n");
    for arguments in [["serve", "--state", "a b"], ["invite", "ada", "--role=admin"]] {
        let mut command = user.command(&[&["cloud"][..], &arguments].concat());
        let output = programs::output(command.env("GLEANER_HOME", &home));
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(7), "{stderr}");
        assert_eq!(String::from_utf8_lossy(&output.stdout), arguments.join(" ") + "\n");
    }
    // Beside this copy, there is no player, also where the checkout has built one.
    let alone = user.path("gleaner");
    let copied = Command::new("cp").arg(env!("CARGO_BIN_EXE_gleaner")).arg(&alone).status();
    assert!(copied.unwrap().success());
    let mut play = Command::new(&alone);
    play.args(["play", "a.mcap"]).env("GLEANER_HOME", &home);
    let text = programs::fails(play, 1);
    assert!(text.contains("install the package `gleaner`, which has it; "), "{text}");
}

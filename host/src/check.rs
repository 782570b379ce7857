//! `gleaner-runtime check`: checks a lambda without any sample. It loads the lambda as on a
//! vehicle, allocates its rings and runs `init`, which finds inputs that the manifest lacks and
//! fields that their types lack.
//!
//! Message definitions are those beside the lambda, on this machine, or in this program.

use std::io::Write;
use std::time::Instant;

use clap::Args;
use gleaner_base::{Exit, Failure};
use gleaner_buffers::Pool;
use gleaner_lambda::manifest::{InputSpec, Manifest, Store, bounds};
use gleaner_lambda::{BuildDir, Fault};
use gleaner_messages::Sources;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_protocol::ingress::TopicGrant;
use gleaner_protocol::{CheckReport, Need, NeedPlace, Report};
use gleaner_sandbox::Paths;

use crate::api::frame::Info;
use crate::input::Remap;
use crate::isolation::{code_cache_dir, definition_dirs};
use crate::live::UNWRITTEN;
use crate::session_setup::{
    ConfiguredLambda, LambdaArgs, Load, RunMode, SessionSetup, not_started,
};

/// Bytes that the recorder may need beside the preroll: the journals of two open clips, and data on
/// its way to the disk.
const RECORDER: u64 = (2 * 256 + 16) << 20;

/// Arguments of `check`.
#[derive(Args, Clone, Debug)]
pub struct CheckArgs {
    #[command(flatten)]
    lambda_args: LambdaArgs,
}

pub struct CheckJob {
    pub lambda: ConfiguredLambda,
    pub manifest: Manifest,
}

impl CheckJob {
    /// Checks the arguments against the build and its manifest.
    pub fn new(args: CheckArgs) -> Result<Self, Failure> {
        let build = BuildDir::check_fresh(&args.lambda_args.lambda)?;
        let mut manifest = Manifest::load(build.path())?;
        let lambda = ConfiguredLambda::new(args.lambda_args, build, &mut manifest)?;
        Ok(Self { lambda, manifest })
    }

    /// Paths that may be opened while `init` runs.
    pub fn paths(&self) -> Paths {
        let mut read = definition_dirs();
        read.push(self.lambda.folder.clone());
        read.extend(self.lambda.vehicle.clone());
        read.extend(code_cache_dir(self.manifest.lambda.kind));
        Paths { read, write: Vec::new() }
    }

    /// Runs the check and reports its result.
    pub fn run(self, load: Load<'_>, reports: &mut dyn Write) -> Result<Exit, Failure> {
        let Self { lambda, manifest } = self;
        let (mut topics, notes) = topics(&lambda, &manifest)?;
        let mode = RunMode::Live(manifest.limits.deadline);
        let mut setup = SessionSetup::load(&mut topics, &lambda, &manifest, mode, load)?;
        // `init` is skipped if a type is unknown: its fields would seem to be missing.
        let mut log = Vec::new();
        let mut started = |outcome: Result<(), Fault>| {
            let (lines, _) = setup.session.take_log();
            outcome.map_err(|fault| not_started(manifest.lambda.name.as_str(), fault, &lines))?;
            log.extend(lines.into_iter().map(|line| line.message));
            Ok::<_, Failure>(())
        };
        started(setup.guest.prepare())?;
        let mut init_ms = None;
        if notes.is_empty() {
            let begun = Instant::now();
            started(setup.guest.init())?;
            init_ms = Some(begun.elapsed().as_secs_f64() * 1e3);
        }
        let checked = CheckReport {
            lambda: manifest.lambda.name.to_string(),
            version: manifest.lambda.version.to_string(),
            kind: manifest.lambda.kind,
            engine: setup.guest.engine().to_string(),
            init_ms,
            resident_bytes: setup.guest.resident_bytes(),
            needs: needs(&lambda, &manifest),
            log,
            notes,
        };
        // The reader may have ended.
        let _ = serde_json::to_writer(&mut *reports, &Report::Checked(Box::new(checked)));
        let _ = reports.write_all(b"\n");
        Ok(Exit::Ok)
    }
}

/// Returns the lambda's topics without samples, and notes on those of unknown type.
fn topics(
    lambda: &ConfiguredLambda,
    manifest: &Manifest,
) -> Result<(Loopback, Vec<String>), Failure> {
    let sources = Sources::new(&[lambda.build.path().join("msg")], &definition_dirs());
    let (topics, mut notes) = (Loopback::new(), Vec::new());
    for input in &manifest.inputs {
        let type_name = input.type_name.as_str();
        let text = sources.find(type_name).map_err(|error| {
            Failure::caused_by(
                Exit::Usage,
                format!("cannot use the definition of `{type_name}`"),
                &error,
            )
        })?;
        if text.is_none() {
            notes.push(format!(
                "no definition of `{type_name}`, of input `{}`, is on this machine: `init` was not \
                 run. Put its .msg files into msg/ beside lambda.toml; a drive or the node that \
                 writes the topic brings its own",
                input.name
            ));
        }
        topics.add_topic(
            Remap::apply(&lambda.remaps, input.topic.as_str()),
            type_name,
            text.as_deref().unwrap_or(""),
        );
    }
    Ok((topics, notes))
}

/// Memory that the samples of an input need.
fn input_needs(input: &InputSpec) -> Vec<Need> {
    let (name, size) = (&input.name, input.max_size);
    let TopicGrant { depth, holds, .. } = TopicGrant::for_input(0, input, "", false, false);
    let held = u64::from(holds.windows) * u64::from(holds.window) + u64::from(holds.singles);
    // One sample is written while the others are shown.
    let shown = u64::from(depth) + 1;
    let bytes = |samples: u64| Some(samples.saturating_mul(size.bytes()));
    let place = NeedPlace::Memory;
    let need = |preallocated, purpose, bytes| Need { purpose, bytes, place, preallocated };
    let mut purpose = format!("input `{name}`: {shown} samples of {size}, shared by all lambdas");
    if size == bounds::MAX_SIZE_LARGE.default {
        purpose += "; the default of `max_size`: `gleaner inspect DRIVE` prints one that fits";
    }
    let mut needs = vec![need(true, purpose, bytes(shown))];
    let purpose = format!("input `{name}`: {held} samples that the lambda holds");
    needs.push(need(false, purpose, bytes(held)));
    if let Some(decoded) = input.decoded_size {
        let slots = input.decoded_slots();
        let bytes = Pool::<Info>::bytes_needed(slots, decoded.as_usize());
        let purpose = format!("input `{name}`: {slots} decoded pictures of {decoded}");
        needs.push(need(true, purpose, bytes.map(|bytes| bytes as u64)));
    }
    needs
}

/// Memory and disk that the lambda needs: its own process in the order of the manifest, then the
/// recorder, then the disk.
fn needs(lambda: &ConfiguredLambda, manifest: &Manifest) -> Vec<Need> {
    let limits = &manifest.limits;
    let mut needs: Vec<Need> = manifest.inputs.iter().flat_map(input_needs).collect();
    let need = |place, preallocated, purpose: &str, bytes| {
        let purpose = purpose.to_owned();
        Need { purpose, bytes, place, preallocated }
    };
    let memory = |purpose, bytes| need(NeedPlace::Memory, false, purpose, Some(bytes));
    let disk = |purpose| need(NeedPlace::Disk, false, purpose, None);
    needs.push(memory("the lambda itself (`memory`)", limits.memory.bytes()));
    if manifest.inputs.iter().any(|input| input.type_name.is_frame()) {
        let purpose = "frames that the lambda creates (also up to `memory`)";
        needs.push(memory(purpose, limits.memory.bytes()));
    }
    if limits.scratch.bytes() > 0 {
        let purpose = "its scratch entries (`scratch`, twice while an entry grows)";
        needs.push(memory(purpose, limits.scratch.bytes().saturating_mul(2)));
    }
    needs.push(memory("queued decisions", UNWRITTEN));
    if let Some(record) = &manifest.record {
        let (place, preallocated) = match record.store {
            Store::Ram => (NeedPlace::Memory, true),
            Store::Disk => (NeedPlace::Disk, false),
        };
        let preroll = Some(record.preroll_size.bytes());
        needs.extend([
            need(place, preallocated, "recorder: preroll", preroll),
            memory("recorder: queued messages, and clips being written", RECORDER),
            disk("clips; limit them by `gleaner run --clips-max` or `--bytes-max`"),
        ]);
    }
    for model in &manifest.models {
        let file = lambda.build.path().join(model.file.as_path());
        let bytes = file.metadata().ok().map(|data| data.len());
        needs.push(need(NeedPlace::Disk, true, &format!("model `{}`", model.name), bytes));
    }
    needs.push(disk("decisions.jsonl and log.jsonl"));
    needs
}

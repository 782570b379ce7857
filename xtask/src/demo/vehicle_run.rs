//! A run of the examples on a vehicle: deployed, fed over DDS, one of them killed, and the clips
//! verified. With a cloud, it deploys them, and the clips are those that reached it. Each
//! expectation that is not met is an error.

use std::collections::BTreeSet;
use std::ffi::OsString;
use std::fs;
use std::io::{self, Write};
use std::path::Path;
use std::process::{Child, Stdio};
use std::time::Instant;

use gleaner_base::{Exit, Failure, visible};
use gleaner_fleet::people::Invitation;
use gleaner_lambda::Clip;
use gleaner_protocol::Verified;
use gleaner_protocol::supervision::LambdaPhase;
use gleaner_protocol::vehicle_api::{StreamLine, VehicleStatus};
use gleaner_report::clips;
use gleaner_report::format::{clip_contents, counted, grouped};
use rustix::process::Signal;

use super::demo_vehicle::{DemoVehicle, NAME, OUT, file, signal};
use super::{arrivals, relay};
use crate::checkout::Checkout;
use crate::examples::{DRIVE, EXAMPLES, Example};
use crate::steps::{copy_files, parsed};

/// The command of xtask that runs it: for the demo only.
pub(crate) const COMMAND: &str = "demo-vehicle";

/// The argument of [`COMMAND`] for a vehicle of a cloud.
pub(super) const BY_CLOUD: &str = "by-cloud";

/// The part of the drive that is played, in s: it has a trigger of each example.
const PLAYED_S: u32 = 20;

/// Demand of the detectors, as measured on two cores. Without it, the vehicle would assume more.
const DETECTOR_DEMAND: &str = "\n[demand]\nrate_hz = 10\ncpu = \"5ms\"\nmodel_time = \"45ms\"\n";

/// The topics that the examples read or record.
const TOPICS: &str = "/camera/front/compressed,/imu/data,/vehicle/speed";

const LANGUAGES: [&str; 2] = ["rust", "python"];

/// The lambda whose process is killed, and the number of its wakes by then: 8 s of the IMU.
const VICTIM: (&str, u64) = ("hello-python", 800);

/// The lambda whose decisions are repeated from the clips: it keeps no state.
const REPEATED: &str = "hello-rust";

/// Runs everything, and prints a line for each result. The arguments are the folder of the sockets,
/// [`BY_CLOUD`] if there is a cloud, and the address of its page if that is left open until
/// SIGTERM.
pub(crate) fn run(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let (run, has_cloud, page) = match arguments {
        [run] => (Path::new(run), false, None),
        [run, by] if by == BY_CLOUD => (Path::new(run), true, None),
        [run, by, page] if by == BY_CLOUD => (Path::new(run), true, page.to_str()),
        _ => return Err(Failure::new(Exit::Usage, "it is a part of `cargo xtask demo`")),
    };
    relay::into(&run.join("relay")).map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot reach the cloud from the vehicle", &error)
    })?;
    let vehicle = DemoVehicle::start(checkout, run, has_cloud)?;
    let enrolled = if has_cloud { ", and is enrolled" } else { "" };
    println!("{NAME} has keys and a trust root, runs gleaner-orchestrator{enrolled}\n");
    let lambdas = EXAMPLES.iter().flat_map(|it| LANGUAGES.map(|language| (it, language)));
    let mut ids = Vec::new();
    for (example, language) in lambdas {
        ids.push(deploy(checkout, &vehicle, example, language)?);
    }
    // It is started again for a lambda that records larger samples than those before.
    vehicle.until("the recorder to be ready", |status| {
        let recorder = status.supervisor.as_ref()?.recorder.as_ref()?;
        recorder.is_ready.then_some(())
    })?;
    let player = play(checkout)?;
    println!("\nplaying {PLAYED_S} s of {DRIVE} over DDS");
    kill(&vehicle)?;
    println!("\n$ gleaner top --once");
    vehicle.show(&["top", "--once"])?;
    finish(player)?;
    // The window of the last trigger ends some seconds after the drive.
    let status = vehicle.until("the last clip", |status| {
        let recorder = status.supervisor.as_ref()?.recorder.as_ref()?.last.as_ref()?;
        let is_idle = !recorder.is_recording && recorder.in_flight == 0;
        (is_idle && recorder.recording.clips > 0).then(|| status.clone())
    })?;
    println!("\nthe drive has ended\n$ gleaner status");
    vehicle.show(&["status"])?;
    if let Some(id) = ids.iter().find(|id| !runs(&status, id)) {
        return Err(Failure::new(Exit::Differs, format!("`{id}` does not run at the end")));
    }
    let recorded = clips(&checkout.path(file("state/clips")))?;
    if has_cloud {
        arrivals::run(&vehicle, &ids, &recorded)?;
    }
    let vehicles = checkout.path(file("vehicles"));
    fs::write(&vehicles, format!("{} {}\n", status.vehicle, status.key))
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot write `vehicles`", &error))?;
    verify(&vehicle, &recorded)?;
    report(&vehicle, &recorded)?;
    if let Some(page) = page {
        leave_open(&vehicle, page)?;
    }
    vehicle.stop()?;
    println!("\ngleaner-orchestrator has ended all lambdas; {OUT}/ has keys, state, clips and log");
    Ok(Exit::Ok)
}

/// Prints how to open the page, and waits until the demo is to end.
fn leave_open(vehicle: &DemoVehicle, page: &str) -> Result<(), Failure> {
    let invitation = vehicle.gleaner(&["users", "invite", "you", "--role", "admin", "--json"])?;
    let invitation: Invitation = parsed(&invitation, "gleaner users invite")?;
    println!(
        "\nThe vehicle and the cloud run on. Look at all of this on the page:\n\n  \
         {page}/vehicles/{NAME}/events\n  log in by the one-time code {}\n\n\
         Press Ctrl-C to end the demo.",
        invitation.code
    );
    // Flushed, since the output may be a pipe.
    let _ = io::stdout().flush();
    vehicle.until_end();
    Ok(())
}

/// Publishes a twin, and deploys it under a name of its own, as a vehicle runs each name once.
fn deploy(
    checkout: &Checkout,
    vehicle: &DemoVehicle,
    example: &Example,
    language: &str,
) -> Result<String, Failure> {
    let name = format!("{}-{language}", example.name);
    let (from, to) = (Path::new("examples").join(example.name).join(language), folder(&name));
    let [source, copy] = [from.as_path(), to.as_ref()].map(|path| checkout.path(path));
    // The build comes after its source, and so is not older.
    let copied = fs::create_dir_all(&copy).and_then(|()| {
        let manifest = fs::read_to_string(source.join("lambda.toml"))?;
        let own = format!("name = \"{}\"", example.name);
        let mut manifest = manifest.replacen(&own, &format!("name = \"{name}\""), 1);
        if manifest.contains("[[model]]") {
            manifest += DETECTOR_DEMAND;
        }
        fs::write(copy.join("lambda.toml"), &manifest)?;
        copy_files(&source.join("build"), &copy.join("build"))?;
        fs::write(copy.join("build/lambda.toml"), &manifest)
    });
    copied.map_err(|error| {
        Failure::caused_by(Exit::Internal, format!("cannot copy `{}`", from.display()), &error)
    })?;
    vehicle.gleaner(&["publish", &to, "--key", &file("publisher.pem")])?;
    let key = file("deployer.pem");
    let mut arguments = vec!["deploy", &to, "--key", &key];
    let target: &[_] =
        if vehicle.has_cloud { &["--fleet", "--label", "fleet=demo"] } else { &["--local"] };
    arguments.extend(target);
    arguments.extend(example.set.iter().flat_map(|set| ["--set", *set]));
    let started = Instant::now();
    vehicle.gleaner(&arguments)?;
    println!("  {name:<21} runs after {:.1} s", started.elapsed().as_secs_f64());
    Ok(name)
}

/// Starts the player, which waits until the vehicle reads all topics.
fn play(checkout: &Checkout) -> Result<Child, Failure> {
    let mut player = checkout.command(checkout.program("gleaner-player"));
    player.args([DRIVE, "--topics", TOPICS, "--wait", "1", "--json"]);
    player.args(["--duration", &PLAYED_S.to_string()]);
    let player = player.stdin(Stdio::null()).stdout(Stdio::null()).spawn();
    player
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot start gleaner-player", &error))
}

fn finish(mut player: Child) -> Result<(), Failure> {
    match player.wait() {
        Ok(status) if status.success() => Ok(()),
        Ok(status) => Err(Failure::new(Exit::Internal, format!("gleaner-player: {status}"))),
        Err(error) => {
            Err(Failure::caused_by(Exit::Internal, "cannot wait for gleaner-player", &error))
        }
    }
}

/// Kills the process of a lambda during the drive, and waits until it runs again.
fn kill(vehicle: &DemoVehicle) -> Result<(), Failure> {
    let (id, wakes) = VICTIM;
    let (pid, before) = vehicle.until_lambda(id, "to have woken often", |deployment| {
        let lambda = deployment.status.as_ref()?;
        let has_woken = lambda.live.as_ref().is_some_and(|live| live.wakes >= wakes);
        Some((lambda.pid.filter(|_| has_woken)?, lambda.restarts))
    })?;
    signal(pid, Signal::KILL)?;
    let killed = Instant::now();
    let restarts = vehicle.until_lambda(id, "to run again", |deployment| {
        let lambda = deployment.status.as_ref()?;
        let runs = lambda.phase == LambdaPhase::Running && lambda.pid != Some(pid);
        Some(lambda.restarts).filter(|restarts| runs && *restarts > before)
    })?;
    println!(
        "  kill -9 {pid}: `{id}` runs again after {:.1} s, restarts {before} -> {restarts}",
        killed.elapsed().as_secs_f64()
    );
    let on: &[_] = if vehicle.has_cloud { &["--on", NAME] } else { &[] };
    let event = vehicle.look_until("its failure as an event", || {
        let events = vehicle.gleaner(&[&["events", "--json"], on].concat())?;
        let mut events =
            events.lines().filter_map(|line| serde_json::from_str::<StreamLine>(line).ok());
        Ok(events.find(|it| it.record["event"] == "failed" && it.record["lambda"] == id))
    })?;
    let text = visible(event.record["text"].as_str().unwrap_or_default());
    println!("  $ gleaner {}: {text}", [&["events"], on].concat().join(" "));
    Ok(())
}

fn runs(status: &VehicleStatus, id: &str) -> bool {
    let deployment = status.deployments.iter().find(|deployment| deployment.id == id);
    let lambda = deployment.and_then(|deployment| deployment.status.as_ref());
    lambda.is_some_and(|lambda| lambda.phase == LambdaPhase::Running)
}

/// Verifies the signature of each clip, and repeats the decisions of one lambda in it.
fn verify(vehicle: &DemoVehicle, recorded: &[Clip]) -> Result<(), Failure> {
    let trust = file("vehicles");
    println!("clips, verified with `gleaner verify CLIP --trust {trust}`:");
    let mut all = 0;
    for clip in recorded {
        let path = clip_path(vehicle, clip);
        vehicle.gleaner(&["verify", &path, "--trust", &trust])?;
        println!("  {path}\n    {}", clip_contents(clip));
        // A lambda that was started again in the clip is in it twice.
        let names: BTreeSet<&str> = clip.lambdas.iter().map(|it| it.name.as_str()).collect();
        let (triggers, lambdas) =
            (counted(clip.triggers, "trigger"), counted(names.len() as u64, "lambda"));
        println!("    signed by the vehicle; {triggers} of {lambdas}");
        for reason in &clip.incomplete {
            println!("    incomplete: {}", visible(reason));
        }
        if clip.lambdas.iter().any(|lambda| lambda.name == REPEATED) {
            let lambda = folder(REPEATED);
            let arguments = ["verify", &path, "--trust", &trust, "--lambda", &lambda, "--json"];
            let verified: Verified = parsed(&vehicle.gleaner(&arguments)?, "gleaner verify")?;
            let same = verified.wakes.saturating_sub(verified.uncovered);
            println!("    {} decisions of `{REPEATED}` repeated, all identical", grouped(same));
            all += same;
        }
    }
    match all {
        0 => Err(Failure::new(Exit::Differs, format!("no clip has decisions of `{REPEATED}`"))),
        _ => Ok(()),
    }
}

/// Replays the first clip of the repeated lambda, which writes the report.
fn report(vehicle: &DemoVehicle, recorded: &[Clip]) -> Result<(), Failure> {
    let of_lambda = |clip: &&Clip| clip.lambdas.iter().any(|lambda| lambda.name == REPEATED);
    let Some(clip) = recorded.iter().find(of_lambda) else { return Ok(()) };
    let (lambda, out, path) = (folder(REPEATED), file("report"), clip_path(vehicle, clip));
    let settings = EXAMPLES.iter().find(|it| REPEATED.starts_with(it.name));
    let settings = settings.into_iter().flat_map(|it| it.set).flat_map(|set| ["--set", *set]);
    let mut arguments = vec!["replay", &lambda, &path, "--out", &out];
    arguments.extend(settings);
    vehicle.gleaner(&arguments)?;
    println!("report of `{REPEATED}` on the first clip: {out}/report.html");
    Ok(())
}

/// Folder of a lambda, relative to the checkout.
fn folder(name: &str) -> String {
    file(&format!("lambdas/{name}"))
}

/// Path of a clip, relative to the checkout: as it came from the cloud, if there is one.
fn clip_path(vehicle: &DemoVehicle, clip: &Clip) -> String {
    if vehicle.has_cloud {
        let name = clip.file.file_name().unwrap_or_default();
        file(&format!("cloud-clips/{NAME}/{}", name.display()))
    } else {
        file(&format!("state/clips/{}", clip.file.display()))
    }
}

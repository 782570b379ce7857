//! The command line, the start and the end of the program.

use std::convert::Infallible;
use std::fs;
use std::net::SocketAddr;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::time::Duration;

use clap::Parser;
use gleaner_base::{Exit, Failure};
use gleaner_fleet::listener::BoundedListener;
use gleaner_lambda::Vehicle;
use gleaner_protocol::process_stats::log;
use gleaner_protocol::supervision::{EventKind, SUPERVISION_VERSION, SupervisionSpec};
use gleaner_trust::{PublicKey, SecretKey, VehicleName};
use tokio::net::{TcpListener, UnixListener};
use tokio::signal::unix::{Signal, SignalKind, signal};
use tokio::sync::watch;

use crate::api::Api;
use crate::clock_jumps::ClockJumps;
use crate::cloud::{Cloud, CloudLink};
use crate::durable::DurableFile;
use crate::layout::VehicleFolders;
use crate::link::SupervisorLink;
use crate::orchestrator::Orchestrator;

/// Runs what is deployed on this vehicle, until SIGTERM, which ends all lambdas in order. After
/// SIGHUP it replaces itself by the program that is installed now, and the lambdas run on.
#[derive(Parser, Debug)]
#[command(name = "gleaner-orchestrator", version = gleaner_base::version())]
struct Args {
    /// Configuration file of the vehicle; see docs/vehicle.md
    #[arg(long, value_name = "FILE")]
    vehicle: Option<PathBuf>,
    /// Folder of everything that survives a restart
    #[arg(long, value_name = "DIR", default_value = "/var/lib/gleaner")]
    state: PathBuf,
    /// Folder of the sockets
    #[arg(long, value_name = "DIR", default_value = "/run/gleaner")]
    run: PathBuf,
    /// Keep every decision, not only those with a trigger or a fault
    #[arg(long)]
    all: bool,
    /// Folder of cgroup v2 for the control groups of the lambdas, delegated to this user
    #[arg(long, value_name = "DIR")]
    cgroup: Option<PathBuf>,
}

/// Interval at which the trusted time is moved; also at the end, after a jump of the clock and with
/// a refusal. Each time is a write of the state.
const TIME_INTERVAL: Duration = Duration::from_secs(600);
/// Interval at which refused deployments are verified again.
const REFUSED_INTERVAL: Duration = Duration::from_secs(10);
/// Interval at which the watchdog is reset, and the clock is looked at.
const WATCHDOG_INTERVAL: Duration = Duration::from_secs(3);

/// Maximum number of connections to the socket of the API, on which users also follow records, and
/// of those that read metrics, which any user of the machine may open.
const CONTROL_MAX: usize = 256;
const METRICS_MAX: usize = 64;

enum ProgramEnd {
    /// The end by SIGTERM: all lambdas have ended.
    Stopped,
    /// The end by SIGHUP: it is to be started again.
    Restart,
}

pub fn main() -> ExitCode {
    let args = Args::parse();
    log::init_service();
    // Each connection takes one; the usual limit is low.
    gleaner_base::raise_open_files();
    loop {
        match run(&args) {
            Ok(ProgramEnd::Stopped) => return Exit::Ok.into(),
            // Without the new program, this one goes on.
            Ok(ProgramEnd::Restart) => log::failure(exec()),
            Err(failure) => {
                log::failure(&failure);
                return failure.exit.into();
            }
        }
    }
}

/// Becomes the program that is installed now. Returns only on errors.
fn exec() -> Failure {
    let program = std::env::args_os().next().unwrap_or_default();
    let error = std::process::Command::new(program).args(std::env::args_os().skip(1)).exec();
    Failure::caused_by(Exit::Internal, "cannot start the program again", &error)
}

fn run(args: &Args) -> Result<ProgramEnd, Failure> {
    let vehicle = args.vehicle.as_ref().map_or_else(|| Ok(Vehicle::default()), Vehicle::load)?;
    let layout = VehicleFolders::create(&args.state, &args.run)?;
    let _lock = layout.lock()?;
    let name = name(&vehicle)?;
    let key = vehicle_key(&layout)?;
    let core = Arc::new(Orchestrator::open(layout, vehicle, (name, key))?);
    // Two threads: the work that takes long runs in others.
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .thread_name("orchestrator")
        .enable_all()
        .build()
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot start threads", &error))?;
    let ended = runtime.block_on(serve(Arc::clone(&core), spec(args, &core)));
    // A stream that follows never ends by itself.
    runtime.shutdown_background();
    core.observe_time();
    if matches!(ended, Ok(ProgramEnd::Stopped)) {
        core.event(EventKind::Stopped, None, "the orchestrator has stopped");
    }
    ended
}

/// Returns the name of the vehicle: that of its configuration, or that of the machine.
fn name(vehicle: &Vehicle) -> Result<VehicleName, Failure> {
    let name = match &vehicle.identity.name {
        Some(name) => name.as_str().parse(),
        None => VehicleName::of_machine(),
    };
    name.map_err(|reason| {
        let mut failure = Failure::new(Exit::Usage, "this vehicle has no name");
        failure.causes = vec![reason];
        failure.with_help("name it: `name` in the table [vehicle] of vehicle.toml")
    })
}

/// Makes the key of the vehicle if it has none; returns its public part.
fn vehicle_key(layout: &VehicleFolders) -> Result<PublicKey, Failure> {
    let path = layout.key();
    if !path.exists() {
        SecretKey::generate()?.create_file(&path)?;
    }
    Ok(SecretKey::load(&path)?.public())
}

fn spec(args: &Args, core: &Orchestrator) -> SupervisionSpec {
    let Orchestrator { layout, vehicle, name, .. } = core;
    let domain = vehicle.network.domain.map(|domain| format!("--domain={domain}"));
    let interfaces = vehicle.network.interfaces.iter().map(|it| format!("--interface={it}"));
    let real_time = vehicle.network.real_time.then(|| "--real-time".to_owned());
    let recording = &vehicle.recording;
    SupervisionSpec {
        version: SUPERVISION_VERSION,
        spool: layout.spool(),
        spool_bytes: vehicle.deployments.spool.bytes(),
        records: layout.records(),
        clips: layout.clips(),
        vehicle: args.vehicle.clone(),
        signer: Some((layout.key(), name.to_string())),
        network: domain.into_iter().chain(interfaces).chain(real_time).collect(),
        all: args.all,
        decisions: vehicle.deployments.decisions.as_ref().map(ToString::to_string),
        commands: recording.commands.as_ref().map(ToString::to_string),
        disk_floor: recording.disk_floor.map(|size| size.bytes()),
        clips_max: recording.clips_max,
        bytes_max: recording.bytes_max.map(|size| size.bytes()),
        cgroup: args.cgroup.clone(),
    }
}

async fn serve(core: Arc<Orchestrator>, spec: SupervisionSpec) -> Result<ProgramEnd, Failure> {
    let mut signals = EndSignals::handle()?;
    let listener = listen(&core.layout)?;
    let (stop, stopped) = watch::channel(false);
    let link = SupervisorLink { core: Arc::clone(&core), spec, stop: stopped };
    let mut link = tokio::spawn(link.keep());
    let measuring = Arc::clone(&core);
    tokio::task::spawn_blocking(move || measuring.measure_speed());
    let (cloud, damage) = Cloud::load(DurableFile::new(core.layout.cloud()));
    if let Some(damage) = damage {
        core.warn(&format!("the file of the enrolment is damaged: {damage}"));
    }
    tokio::spawn(CloudLink { core: Arc::clone(&core), cloud: cloud.clone() }.keep());
    let api = Api { core: Arc::clone(&core), cloud };
    // The API answers until the end of the program.
    let serving = watch::Sender::new(false);
    if let Some(address) = core.vehicle.metrics.listen {
        serve_metrics(address, &api, &serving).await;
    }
    let control = ("control connections", CONTROL_MAX);
    tokio::spawn(
        BoundedListener::plain(listener, control, api.router(), serving.subscribe()).serve(),
    );
    let _ = sd_notify::notify(&[sd_notify::NotifyState::Ready]);
    let ended = tokio::select! {
        end = signals.next() => {
            if matches!(end, ProgramEnd::Restart) {
                let _ = sd_notify::notify(&[sd_notify::NotifyState::Reloading]);
                return Ok(end);
            }
            let _ = sd_notify::notify(&[sd_notify::NotifyState::Stopping]);
            stop.send_replace(true);
            link.await
        }
        // It ends only when it is to stop, or with a failure.
        ended = &mut link => ended,
        never = run_periodically(&core) => match never {},
    };
    ended
        .map_err(|_| Failure::new(Exit::Internal, "the link to the supervisor failed"))?
        .map(|()| ProgramEnd::Stopped)
}

/// The signals that end the program.
struct EndSignals {
    terminate: Signal,
    interrupt: Signal,
    hangup: Signal,
}

impl EndSignals {
    fn handle() -> Result<Self, Failure> {
        let handle = |kind, name: &str| {
            signal(kind).map_err(|error| {
                Failure::caused_by(Exit::Internal, format!("cannot handle {name}"), &error)
            })
        };
        Ok(Self {
            terminate: handle(SignalKind::terminate(), "SIGTERM")?,
            interrupt: handle(SignalKind::interrupt(), "SIGINT")?,
            hangup: handle(SignalKind::hangup(), "SIGHUP")?,
        })
    }

    async fn next(&mut self) -> ProgramEnd {
        tokio::select! {
            _ = self.terminate.recv() => ProgramEnd::Stopped,
            _ = self.interrupt.recv() => ProgramEnd::Stopped,
            _ = self.hangup.recv() => ProgramEnd::Restart,
        }
    }
}

/// Resets the watchdog, moves the trusted time, and verifies refused deployments again.
async fn run_periodically(core: &Orchestrator) -> Infallible {
    let mut watchdog = tokio::time::interval(WATCHDOG_INTERVAL);
    let mut time = tokio::time::interval(TIME_INTERVAL);
    let mut refused = tokio::time::interval(REFUSED_INTERVAL);
    let mut jumps = ClockJumps::new();
    loop {
        tokio::select! {
            _ = watchdog.tick() => {
                let _ = sd_notify::notify(&[sd_notify::NotifyState::Watchdog]);
                if let Some(text) = jumps.look() {
                    core.warn(&text);
                    core.observe_time();
                }
            }
            _ = time.tick() => core.observe_time(),
            _ = refused.tick() => core.verify_refused(),
        }
    }
}

/// Serves the metrics at this address. A port that another program uses is an event: it must not
/// keep lambdas from running.
async fn serve_metrics(address: SocketAddr, api: &Api, serving: &watch::Sender<bool>) {
    match TcpListener::bind(address).await {
        Ok(listener) => {
            let (most, router) =
                (("metrics connections", METRICS_MAX), api.clone().metrics_router());
            tokio::spawn(
                BoundedListener::plain(listener, most, router, serving.subscribe()).serve(),
            );
        }
        Err(error) => {
            api.core.warn(&format!("the metrics are not served at {address}: {error}"));
        }
    }
}

/// Listens on the socket of the API. The lock of the run folder ensures that no other
/// orchestrator uses it.
fn listen(layout: &VehicleFolders) -> Result<UnixListener, Failure> {
    let path = layout.control_socket();
    let _ = fs::remove_file(&path);
    let listener = UnixListener::bind(&path).and_then(|listener| {
        fs::set_permissions(&path, fs::Permissions::from_mode(0o660))?;
        Ok(listener)
    });
    listener.map_err(|error| {
        let action = format!("cannot listen on `{}`", path.display());
        Failure::caused_by(Exit::Usage, action, &error)
            .with_help("choose another folder with --run")
    })
}

//! The loop: keeps running what the orchestrator wants, across failures of processes.

use std::collections::HashSet;
use std::fs;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, Failure, chain};
use gleaner_lambda::{BuildDir, Manifest, Vehicle};
use gleaner_protocol::supervision::{
    DesiredLambda, DesiredState, EventKind, LAMBDAS_MAX, LambdaPhase, LambdaStatus,
    SUPERVISION_VERSION, SupervisionSpec, SupervisorReport, SupervisorRequest,
};
use signal_hook::consts::{SIGINT, SIGTERM};

use super::connection::Connection;
use super::status_board::StatusBoard;
use crate::failures::Failures;
use crate::installation::Installation;
use crate::process_group::{GroupEnd, ProcessGroup, RunRecord};
use crate::reconcile::{Action, KnownLambda, reconcile};
use crate::restart_delay::{RestartDelay, jittered};
use crate::revision_check::CheckFailure;
use crate::spec::{ClipSigning, LambdaSpec, RunSpec};
use crate::summary::RunCounts;
use crate::supervised::SupervisedLambda;
use crate::{POLL_INTERVAL, RunContext, clock_offset};

/// Interval of the status without a change.
const STATUS_INTERVAL: Duration = Duration::from_secs(1);
/// Pause before a lambda that this machine lacked something to load is loaded again.
const SHORTAGE_PAUSE: Duration = Duration::from_secs(5);
/// Interval of looks for requests between two groups.
const PAUSE: Duration = Duration::from_millis(10);
/// Size of samples that the ingress always expects: it is not started again for a lambda with
/// images of usual cameras.
const LARGEST: u64 = 8 << 20;

/// Runs what the orchestrator wants until it requests the end, or until SIGTERM.
pub(super) fn serve(listener: std::os::unix::net::UnixListener) -> Result<(), Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [SIGTERM, SIGINT] {
        signal_hook::flag::register(signal, Arc::clone(&stop))
            .map_err(|error| Failure::caused_by(Exit::Internal, "cannot handle signals", &error))?;
    }
    let connection = Connection::accept(listener)?;
    let Some(spec) = configured(&connection, &stop) else { return Ok(()) };
    let board = StatusBoard::open(&spec)?;
    board.event(EventKind::Started, None, "the supervisor has started");
    let run = run_spec(&spec)?;
    let context =
        RunContext { spec: &run, parts: InstalledPrograms::find()?, offset_ns: clock_offset() };
    let mut lambdas = Vec::new();
    let mut wanted = WantedState {
        spec: &spec,
        installation: Installation::of(&context.parts),
        desired: DesiredState::default(),
        is_new: true,
        unusable: Vec::new(),
    };
    let mut vehicle = Vehicle::default();
    let (mut failures, mut counts) = (Failures::default(), RunCounts::default());
    let mut delay = RestartDelay::of_service();
    loop {
        let started = Instant::now();
        if let Some(file) = &spec.vehicle {
            match Vehicle::load(file) {
                Ok(loaded) => vehicle = loaded,
                Err(error) => board.event(EventKind::Warning, None, &chain(&error)),
            }
        }
        let record = RunRecord { failures: &mut failures, counts: &mut counts };
        let mut observer = board.clone();
        let group = ProcessGroup::start(&context, &mut lambdas, &mut observer, record, &vehicle);
        let ended = group.and_then(|mut group| {
            connection.rings(group.sender.clone());
            let ended = group.run(|group| wanted.keep(group, &connection, &board, &stop));
            group.add_counts();
            ended
        });
        let reason = match ended {
            Ok(GroupEnd::Complete) => break,
            Ok(GroupEnd::NotStarted(exit)) => {
                format!("ingress or recorder could not start (exit code {})", exit.code())
            }
            Ok(GroupEnd::Broken(reason)) => reason,
            Err(failure) => failure.to_string(),
        };
        board.group_ended(&reason);
        let delay = jittered(delay.after(started.elapsed()));
        let until = Instant::now() + delay;
        let text = format!("{reason}; all processes start again in {} ms", delay.as_millis());
        board.event(EventKind::Failed, None, &text);
        if wanted.pause(until, &lambdas, &connection, &board, &stop) {
            break;
        }
    }
    board.event(EventKind::Stopped, None, "the supervisor has stopped");
    Ok(())
}

/// Waits for the settings; `None` if it is requested to end.
fn configured(connection: &Connection, stop: &AtomicBool) -> Option<SupervisionSpec> {
    while !stop.load(Ordering::Relaxed) {
        match connection.next(POLL_INTERVAL) {
            Some(SupervisorRequest::Configure(spec)) if spec.version == SUPERVISION_VERSION => {
                return Some(*spec);
            }
            Some(SupervisorRequest::Configure(spec)) => {
                let reason = format!(
                    "it has version {SUPERVISION_VERSION}, the orchestrator {}",
                    spec.version
                );
                connection.report(&SupervisorReport::Refused { reason });
            }
            Some(SupervisorRequest::Stop) => return None,
            None => {}
            Some(SupervisorRequest::Apply(_)) => {
                let reason = "it has no settings yet".to_owned();
                connection.report(&SupervisorReport::Refused { reason });
            }
        }
    }
    None
}

fn run_spec(spec: &SupervisionSpec) -> Result<RunSpec, Failure> {
    let signing = spec.signer.as_ref().map(|(path, vehicle)| {
        let key = fs::File::open(path).map_err(|error| {
            let action = format!("cannot open the key of the vehicle `{}`", path.display());
            Failure::caused_by(Exit::Internal, action, &error)
        })?;
        Ok::<_, Failure>(ClipSigning { key: Arc::new(key), vehicle: vehicle.clone() })
    });
    Ok(RunSpec {
        signing: signing.transpose()?,
        clips: spec.clips.clone(),
        vehicle: spec.vehicle.clone(),
        network: spec.network.iter().map(Into::into).collect(),
        all: spec.all,
        records: true,
        decisions: spec.decisions.clone(),
        commands: spec.commands.clone(),
        disk_floor: spec.disk_floor,
        clips_max: spec.clips_max,
        bytes_max: spec.bytes_max,
        cgroup: spec.cgroup.clone(),
        spool: Some((spec.spool.clone(), spec.spool_bytes)),
        largest: LARGEST,
        ..RunSpec::default()
    })
}

struct WantedState<'a> {
    spec: &'a SupervisionSpec,
    installation: Installation,
    desired: DesiredState,
    /// Set while the desired state was not compared with what runs.
    is_new: bool,
    unusable: Vec<UnusableLambda>,
}

/// A lambda that cannot even be loaded.
struct UnusableLambda {
    lambda: DesiredLambda,
    failure: CheckFailure,
    since: Instant,
}

impl WantedState<'_> {
    /// Keeps the group running as wanted, until its end.
    fn keep(
        &mut self,
        group: &mut ProcessGroup<'_>,
        connection: &Connection,
        board: &StatusBoard,
        stop: &AtomicBool,
    ) -> Result<GroupEnd, Failure> {
        let mut reported: (Option<Instant>, (_, Vec<_>)) = (None, ([false; 3], Vec::new()));
        let mut has_changed = false;
        loop {
            group.poll(if has_changed { Duration::ZERO } else { group.due_in() });
            let (is_new, ends) = self.receive(connection);
            if ends || stop.load(Ordering::Relaxed) {
                return Ok(GroupEnd::Complete);
            }
            // Without an orchestrator, there would be no next supervisor.
            if connection.is_open()
                && (board.lacks_service() || group.lambdas.iter().any(SupervisedLambda::will_start))
                && self.installation.is_replaced()
            {
                let text = "the programs were replaced by an upgrade, and one of them has to \
                            start: all processes start again with the new ones";
                board.event(EventKind::Warning, None, text);
                connection.report(&SupervisorReport::Replaced);
                return Ok(GroupEnd::Complete);
            }
            if let Some(end) = group.step()? {
                return Ok(end);
            }
            for lambda in group.lambdas.iter_mut() {
                if lambda.is_leaving() {
                    lambda.kill_if_late(group.observer);
                }
                if let Some(reason) = lambda.take_quarantine() {
                    group.observer.quarantined(&lambda.lambda, &reason);
                }
            }
            has_changed = self.approach(group.lambdas, board);
            let phases = group.lambdas.iter().map(SupervisedLambda::phase).collect();
            let phases = (board.ready_services(), phases);
            let is_due = reported.0.is_none_or(|at| at.elapsed() >= STATUS_INTERVAL);
            if is_due || is_new || phases != reported.1 {
                reported = (Some(Instant::now()), phases);
                connection.report(&self.status(group.lambdas, board));
            }
        }
    }

    /// Waits between two groups, and goes on reporting; returns whether it is to end.
    fn pause(
        &mut self,
        until: Instant,
        lambdas: &[SupervisedLambda],
        connection: &Connection,
        board: &StatusBoard,
        stop: &AtomicBool,
    ) -> bool {
        let mut reported: Option<Instant> = None;
        while Instant::now() < until {
            let (is_new, ends) = self.receive(connection);
            if ends || stop.load(Ordering::Relaxed) {
                return true;
            }
            if is_new || reported.is_none_or(|at| at.elapsed() >= STATUS_INTERVAL) {
                reported = Some(Instant::now());
                connection.report(&self.status(lambdas, board));
            }
            thread::sleep(PAUSE);
        }
        false
    }

    /// Handles the requests that have arrived; returns whether there were any, and whether it is
    /// to end.
    fn receive(&mut self, connection: &Connection) -> (bool, bool) {
        let mut is_new = false;
        while let Some(request) = connection.next(Duration::ZERO) {
            is_new = true;
            match self.handle(request) {
                Ok(true) => return (is_new, true),
                Ok(false) => {}
                Err(refused) => connection.report(&refused),
            }
        }
        (is_new, false)
    }

    /// Handles a request; returns whether it is to end.
    fn handle(&mut self, request: SupervisorRequest) -> Result<bool, SupervisorReport> {
        match request {
            SupervisorRequest::Stop => return Ok(true),
            SupervisorRequest::Configure(spec) if *spec == *self.spec => {}
            SupervisorRequest::Configure(_) => return Err(SupervisorReport::OtherSettings),
            SupervisorRequest::Apply(state) => {
                check(&state).map_err(|reason| SupervisorReport::Refused { reason })?;
                (self.desired, self.is_new) = (*state, true);
            }
        }
        Ok(false)
    }

    /// Starts and stops lambdas as wanted; returns whether it did any of that.
    fn approach(&mut self, lambdas: &mut Vec<SupervisedLambda>, board: &StatusBoard) -> bool {
        // With many lambdas the comparison costs more than all else in this loop.
        let has_left = lambdas.iter().any(SupervisedLambda::has_left);
        if !std::mem::take(&mut self.is_new) && !has_left && self.unusable.is_empty() {
            return false;
        }
        lambdas.retain(|lambda| {
            let has_left = lambda.has_left();
            if has_left {
                board.event(EventKind::Ended, Some(&lambda.lambda), "ended on request");
            }
            !has_left
        });
        self.unusable.retain(|UnusableLambda { lambda, failure, since }| {
            let is_over = failure.is_shortage && since.elapsed() >= SHORTAGE_PAUSE;
            !is_over && self.desired.lambdas.contains(lambda)
        });
        let running = lambdas.iter().filter_map(|it| {
            let lambda = it.lambda.deployment.as_deref()?;
            Some(KnownLambda { lambda, is_leaving: it.is_leaving() })
        });
        let unusable = self.unusable.iter();
        let unusable = unusable.map(|it| KnownLambda { lambda: &it.lambda, is_leaving: false });
        let known: Vec<_> = running.chain(unusable).collect();
        let actions = reconcile(&self.desired, &known);
        let has_changed = !actions.is_empty();
        for action in actions {
            match action {
                Action::Start(lambda) => match self.load(&lambda) {
                    Ok(spec) => lambdas.push(SupervisedLambda::new(spec)),
                    Err(failure) => {
                        let since = Instant::now();
                        self.unusable.push(UnusableLambda { lambda, failure, since });
                    }
                },
                Action::Stop(id) => {
                    let of_id = |it: &&mut SupervisedLambda| {
                        it.lambda.deployment.as_ref().is_some_and(|deployed| deployed.id == id)
                    };
                    lambdas.iter_mut().filter(of_id).for_each(SupervisedLambda::leave);
                }
            }
        }
        has_changed
    }

    fn load(&self, wanted: &DesiredLambda) -> Result<LambdaSpec, CheckFailure> {
        let cannot = |error: &(dyn std::error::Error + 'static)| {
            CheckFailure::of("it cannot be loaded", error)
        };
        let build = BuildDir::of(&wanted.folder);
        let manifest = Manifest::load(build.path()).map_err(|error| cannot(&error))?;
        if manifest.lambda.name.as_str() != wanted.name {
            let reason = format!("it cannot be loaded: its name is `{}`", manifest.lambda.name);
            return Err(CheckFailure { reason, is_shortage: false });
        }
        let out = self.spec.records.join(&wanted.id);
        fs::create_dir_all(&out).map_err(|error| {
            CheckFailure::of(&format!("cannot create `{}`", out.display()), &error)
        })?;
        Ok(LambdaSpec {
            folder: wanted.folder.clone(),
            manifest,
            out,
            prefix: format!("{}: ", wanted.id),
            set: wanted.set.clone(),
            remaps: Vec::new(),
            deployment: Some(Box::new(wanted.clone())),
        })
    }

    fn status(&self, lambdas: &[SupervisedLambda], board: &StatusBoard) -> SupervisorReport {
        let mut status = board.status();
        status.generation = self.desired.generation;
        status.lambdas = lambdas.iter().filter_map(SupervisedLambda::status_report).collect();
        status.lambdas.extend(self.unusable.iter().map(
            |UnusableLambda { lambda, failure, .. }| LambdaStatus {
                id: lambda.id.clone(),
                name: lambda.name.clone(),
                revision: lambda.revision.clone(),
                attempt: lambda.attempt,
                phase: match failure.is_shortage {
                    true => LambdaPhase::Waiting,
                    false => LambdaPhase::Quarantined,
                },
                last_end: Some(failure.reason.clone()),
                ..LambdaStatus::default()
            },
        ));
        let place = |lambda: &LambdaStatus| {
            self.desired.lambdas.iter().position(|it| it.id == lambda.id).unwrap_or(usize::MAX)
        };
        status.lambdas.sort_by_key(place);
        // A refusal names the beginning of the digest; another file is another model.
        let models = || lambdas.iter().flat_map(|lambda| &lambda.lambda.manifest.models);
        status.refused_models.retain(|refused| {
            models().any(|model| refused.contains(&model.sha256.to_string()[..8]))
        });
        SupervisorReport::Status(Box::new(status))
    }
}

/// Checks that ids and names are unique, and that an id is the name of a folder.
fn check(state: &DesiredState) -> Result<(), String> {
    if state.lambdas.len() > LAMBDAS_MAX {
        let count = state.lambdas.len();
        return Err(format!("{count} lambdas are wanted, and {LAMBDAS_MAX} are possible"));
    }
    let (mut ids, mut names) = (HashSet::new(), HashSet::new());
    for lambda in &state.lambdas {
        let is_name = lambda.id.bytes().all(|it| it.is_ascii_alphanumeric() || b"-_".contains(&it));
        if lambda.id.is_empty() || !is_name {
            return Err(format!("invalid deployment id `{}`", gleaner_base::excerpt(&lambda.id)));
        }
        if !ids.insert(&lambda.id) || !names.insert(&lambda.name) {
            return Err(format!("`{}` or its lambda `{}` is wanted twice", lambda.id, lambda.name));
        }
    }
    Ok(())
}

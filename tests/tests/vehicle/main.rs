//! The daemon of a vehicle, with real lambdas: what is deployed runs, whatever is killed.

mod chaos;
mod cloud;
mod deployments;
mod faults;
mod recorder;
mod refused;
mod top;
mod wheels;

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::sync::RwLock;

use gleaner_lambda::Clip;
use gleaner_protocol::supervision::{EventKind, VehicleEvent};
use gleaner_tests::vehicle::TestVehicle;
use gleaner_tests::{LambdaCopy, TempFolder, namespace};
use libtest_mimic::{Arguments, Trial};

type Case = (&'static str, fn());

const CASES: [Case; 30] = [
    ("lambdas_outlive_the_orchestrator", deployments::outlive),
    ("a_supervisor_that_ends_after_sighup_is_no_zombie", deployments::reaped),
    ("after_an_upgrade_old_and_new_programs_do_not_mix", deployments::upgraded),
    ("a_stopped_deployment_stays_stopped", deployments::stopped),
    ("a_failed_revision_is_replaced_by_its_fallback_for_good", deployments::fallback),
    ("a_lambda_without_a_fallback_is_quarantined_alone", deployments::quarantined),
    ("a_lambda_that_kills_itself_between_wakes_is_quarantined", deployments::killed_by_itself),
    ("a_revision_whose_wakes_fault_fails_its_probation", faults::probation),
    ("a_proven_lambda_whose_wakes_fault_runs_on_with_a_warning", faults::proven),
    ("a_lambda_decides_without_a_recorder_and_joins_the_next_one", recorder::missing),
    ("deployments_at_once_do_not_disturb_each_other", deployments::at_once),
    ("what_is_not_signed_for_this_vehicle_is_refused", refused::signatures),
    ("a_file_that_was_changed_later_does_not_start", refused::changed_file),
    ("a_lambda_waits_for_a_layer_that_its_machine_lacks_and_is_not_blamed", refused::layers),
    ("a_removed_deployment_is_gone_and_its_releases_stay_known", deployments::removed),
    ("revisions_outlive_a_lost_state", refused::lost_state),
    ("a_deployment_that_could_not_be_read_is_verified_again", refused::retried),
    ("what_does_not_fit_is_refused_with_both_numbers", refused::memory),
    ("a_lambda_that_states_too_much_is_refused_and_others_run_on", refused::cpu),
    ("a_lambda_runs_with_its_wheels_and_not_with_changed_ones", wheels::runs),
    ("wheels_that_do_not_fit_are_refused_while_the_former_lambda_runs", wheels::refused),
    ("top_shows_figures_and_outlives_the_orchestrator", top::figures),
    ("top_restores_the_terminal", top::terminal),
    ("top_ends_with_a_terminal_that_sends_no_signal", top::lost_terminal),
    ("what_follows_ends_with_its_reader_although_nothing_happens", top::readers),
    ("a_vehicle_runs_what_the_cloud_wants_and_sends_its_records", cloud::follows),
    ("clips_reach_the_cloud_once_and_are_verified_after_a_pull", cloud::clips),
    ("a_cloud_that_is_killed_loses_nothing", cloud::killed),
    ("a_restored_cloud_takes_nothing_away_until_a_user_agrees", cloud::restored),
    ("a_vehicle_refuses_what_no_trusted_key_signed_and_runs_without_a_cloud", cloud::refused),
];

/// It measures the time to recover, so that it runs without another case beside it.
const ALONE: Case = ("processes_are_killed_at_random", chaos::killed_at_random);

/// Cases at a time: they mostly wait, each with a vehicle and a network of its own.
const AT_ONCE: usize = 3;

/// Selects the case that this process runs, in a network of its own.
const CASE: &str = "GLEANER_CASE";

fn main() -> ExitCode {
    if let Ok(case) = std::env::var(CASE) {
        let case = CASES.iter().chain([&ALONE]).find(|(name, _)| *name == case).expect("a case");
        (case.1)();
        return ExitCode::SUCCESS;
    }
    let mut arguments = Arguments::from_args();
    arguments.test_threads = Some(AT_ONCE);
    let missing = namespace::unavailable();
    static OTHERS: RwLock<()> = RwLock::new(());
    let trials = CASES.iter().chain([&ALONE]).map(|(name, _)| match missing {
        Some(why) => Trial::test(format!("{name} [{why}]"), || Ok(())).with_ignored_flag(true),
        None => Trial::test(*name, || {
            if *name == ALONE.0 {
                let _alone = OTHERS.write();
                return namespace::case(CASE, name);
            }
            let _beside = OTHERS.read();
            namespace::case(CASE, name)
        }),
    });
    libtest_mimic::run(&arguments, trials.collect()).exit_code()
}

/// A lambda that triggers an event at each tick, ten a second.
fn ticker(language: &str, name: &str) -> LambdaCopy {
    LambdaCopy::named(&format!("tests/lambdas/ticker/{language}"), name)
}

/// Returns a ticker that records what the player sends, a second around each tick.
fn recording(language: &str, name: &str) -> LambdaCopy {
    LambdaCopy::changed_and_named(&format!("tests/lambdas/ticker/{language}"), name, |manifest| {
        manifest.replace("/imu/data", "/imu/synthetic")
            + "[record]\ntopics = [\"/imu/synthetic\", \"/camera/synthetic/image_raw\"]\n\
               preroll = \"1s\"\npostroll = \"1s\"\nmax_length = \"5s\"\n"
    })
}

fn clips(vehicle: &TestVehicle) -> Vec<Clip> {
    let text = std::fs::read_to_string(vehicle.path("state/clips/clips.jsonl"));
    let text = text.unwrap_or_default();
    // The last line may be in the making.
    let lines = text.split_inclusive('\n').filter(|line| line.ends_with('\n'));
    lines.map(|line| serde_json::from_str(line).expect("a line is a clip")).collect()
}

/// The constructor of a lambda that needs nothing.
const INIT: &str = "def __init__(self, ctx):\n    self.wakes = 0\n";

/// A built Python lambda with this code in its class, that wakes ten times a second.
struct PythonLambda {
    folder: TempFolder,
}

impl PythonLambda {
    fn new(name: &str, code: &str) -> Self {
        let lambda = Self { folder: TempFolder::new() };
        lambda.write(name, "0.1.0", code);
        lambda
    }

    /// Replaces its code, and builds it.
    fn write(&self, name: &str, version: &str, code: &str) {
        let manifest = format!(
            "[lambda]\nname = \"{name}\"\nversion = \"{version}\"\nkind = \"python\"\n\
             entry = \"main.py\"\n[schedule]\nperiod = \"100ms\"\n[limits]\ndeadline = \"5s\"\n"
        );
        let init = if code.contains("__init__") { "" } else { INIT };
        let code = format!("{init}{code}");
        let code: String = code.lines().map(|line| format!("    {line}\n")).collect();
        // The build last: it must not be older than its sources.
        for place in ["", "build/"] {
            self.folder.write(&format!("{place}main.py"), format!("class Lambda:\n{code}"));
            self.folder.write(&format!("{place}lambda.toml"), &manifest);
        }
    }

    fn add(&self, tables: &str) {
        for place in ["", "build/"] {
            let path = self.path().join(format!("{place}lambda.toml"));
            let manifest = std::fs::read_to_string(&path).expect("it was written");
            self.folder.write(&format!("{place}lambda.toml"), manifest + tables);
        }
    }

    fn path(&self) -> &Path {
        self.folder.path()
    }
}

fn events(vehicle: &TestVehicle, kind: EventKind) -> Vec<String> {
    let events = vehicle.records(None).into_iter().filter(|line| line.kind == "event");
    let events = events
        .map(|line| serde_json::from_value::<VehicleEvent>(line.record).expect("it is an event"));
    events.filter(|event| event.event == kind).map(|event| event.text).collect()
}

/// The files below `folder`, sorted.
fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<_> = entries.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

//! Live topics with programs on other people's DDS: what they write arrives whole, what we write
//! arrives there, and neither restarts, losses nor hostile packets keep it from doing so.
//!
//! Each case is this program once more, in a network of its own (`gleaner_tests::namespace`).
//! `GLEANER_RESTARTS` says how often a publisher is killed; 5 times if it does not.

mod counted;
mod faults;
mod from_peers;
mod graph;
mod ours;
mod rtps;
mod to_peers;
mod together;

use std::process::{ExitCode, Stdio};
use std::sync::{PoisonError, RwLock};

use gleaner_tests::namespace;
use gleaner_tests::peers::Kind;
use libtest_mimic::{Arguments, Failed, Trial};

/// What a case needs besides a network of its own.
#[derive(Copy, Clone)]
enum Need {
    Peer(Kind),
    /// Rules that drop packets.
    Nft,
}

type Run = fn() -> Result<(), Failed>;

struct Case {
    name: &'static str,
    needs: &'static [Need],
    run: Run,
}

/// Tells this program which case it is.
const CASE: &str = "GLEANER_DDS_CASE";

fn main() -> ExitCode {
    let suites = [
        from_peers::CASES,
        to_peers::CASES,
        graph::CASES,
        faults::CASES,
        together::CASES,
        counted::CASES,
    ];
    let cases = || suites.into_iter().flatten();
    if let Ok(name) = std::env::var(CASE) {
        let case = cases()
            .find(|case| case.name == name)
            .expect("this program gives itself the names of its cases");
        return match (case.run)() {
            Ok(()) => ExitCode::SUCCESS,
            Err(failed) => {
                eprintln!("{}", failed.message().unwrap_or("failed"));
                ExitCode::FAILURE
            }
        };
    }
    let mut arguments = Arguments::from_args();
    // They wait for most of their time, and each is in a network of its own.
    arguments.test_threads.get_or_insert(3);
    let trials = cases().map(|case| {
        let run = || run(case);
        match unavailable(case) {
            None => Trial::test(case.name, run),
            Some(why) => Trial::test(format!("{} [{why}]", case.name), run).with_ignored_flag(true),
        }
    });
    libtest_mimic::run(&arguments, trials.collect()).exit_code()
}

/// Runs a case in a process of its own; one that moves images or point clouds while no other runs:
/// two of them at the same time would show how small this machine is.
fn run(case: &Case) -> Result<(), Failed> {
    static RUNNING: RwLock<()> = RwLock::new(());
    let is_large = ["images", "point_clouds"].iter().any(|large| case.name.contains(large));
    let _alone = is_large.then(|| RUNNING.write().unwrap_or_else(PoisonError::into_inner));
    let _beside_others =
        (!is_large).then(|| RUNNING.read().unwrap_or_else(PoisonError::into_inner));
    namespace::case(CASE, case.name)
}

fn unavailable(case: &Case) -> Option<&'static str> {
    let missing = |need: &Need| match need {
        Need::Peer(kind) => kind.unavailable(),
        Need::Nft => (!can_filter()).then_some("no packets can be dropped here: nft is needed"),
    };
    namespace::unavailable().or_else(|| case.needs.iter().find_map(missing))
}

fn can_filter() -> bool {
    let mut probe = namespace::command("nft".as_ref());
    let probe =
        probe.args(["add", "table", "inet", "probe"]).stdin(Stdio::null()).stderr(Stdio::null());
    probe.status().is_ok_and(|status| status.success())
}

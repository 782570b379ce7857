//! Live topics with peers on other DDS implementations: messages arrive complete in both
//! directions, in spite of restarts, losses and hostile packets.
//!
//! Each case runs in another process of this program, in a private network
//! (`gleaner_tests::namespace`). `GLEANER_RESTARTS` sets the number of restarts of a publisher; the
//! default is 5.

mod counted;
mod faults;
mod from_peers;
mod graph;
mod let_go;
mod real_time;
mod receiver;
mod rtps;
mod to_peers;
mod together;

use std::process::{ExitCode, Stdio};
use std::sync::{PoisonError, RwLock};

use gleaner_tests::live::no_player;
use gleaner_tests::namespace;
use gleaner_tests::peers::PeerKind;
use libtest_mimic::{Arguments, Failed, Trial};

/// Requirement of a case besides a private network.
#[derive(Copy, Clone)]
enum Need {
    Peer(PeerKind),
    Player,
    /// Rules that drop packets.
    Nft,
    /// A program that takes real-time priority, and one that gives a capability up.
    RealTime,
}

type CaseFn = fn() -> Result<(), Failed>;

struct DdsCase {
    name: &'static str,
    needs: &'static [Need],
    run: CaseFn,
}

const fn case(name: &'static str, needs: &'static [Need], run: CaseFn) -> DdsCase {
    DdsCase { name, needs, run }
}

/// Environment variable with the case that this process runs.
const CASE: &str = "GLEANER_DDS_CASE";

fn main() -> ExitCode {
    let suites = [
        from_peers::CASES,
        to_peers::CASES,
        graph::CASES,
        faults::CASES,
        together::CASES,
        let_go::CASES,
        counted::CASES,
        real_time::CASES,
    ];
    let cases = || suites.into_iter().flatten();
    if let Ok(name) = std::env::var(CASE) {
        let case = cases().find(|case| case.name == name).expect("the name is that of a case");
        return match (case.run)() {
            Ok(()) => ExitCode::SUCCESS,
            Err(failed) => {
                eprintln!("{}", failed.message().unwrap_or("failed"));
                ExitCode::FAILURE
            }
        };
    }
    let mut arguments = Arguments::from_args();
    // They mostly wait, and each is in its own network.
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

/// Runs a case in another process. Cases with images or point clouds run alone: two at the same
/// time would overload the machine.
fn run(case: &DdsCase) -> Result<(), Failed> {
    static RUNNING: RwLock<()> = RwLock::new(());
    let is_large = ["images", "point_clouds"].iter().any(|word| case.name.contains(word));
    let _exclusive = is_large.then(|| RUNNING.write().unwrap_or_else(PoisonError::into_inner));
    let _shared = (!is_large).then(|| RUNNING.read().unwrap_or_else(PoisonError::into_inner));
    namespace::case(CASE, case.name)
}

fn unavailable(case: &DdsCase) -> Option<&'static str> {
    let missing = |need: &Need| match need {
        Need::Peer(kind) => kind.unavailable(),
        Need::Player => no_player(),
        Need::Nft => (!can_filter()).then_some("cannot drop packets: nft is needed"),
        Need::RealTime => real_time::unavailable(),
    };
    namespace::unavailable().or_else(|| case.needs.iter().find_map(missing))
}

fn can_filter() -> bool {
    let mut probe = namespace::command("nft".as_ref());
    let probe =
        probe.args(["add", "table", "inet", "probe"]).stdin(Stdio::null()).stderr(Stdio::null());
    probe.status().is_ok_and(|status| status.success())
}

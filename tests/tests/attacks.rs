//! Runs lambdas that attack their environment live, under `gleaner-shim`. The outcome of each
//! attack is a row of the table in `docs/security.md`, and must be as documented there.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, ExitCode, Stdio};

use gleaner_base::Exit;
use gleaner_lambda::{Decision, FaultKind};
use gleaner_protocol::{LiveStatus, Report};
use gleaner_tests::live::{JsonReport, RunningProgram, decisions, run};
use gleaner_tests::{TempFolder, namespace, root};
use libtest_mimic::{Arguments, Trial};

/// Environment variable with the case that this process runs in its private network.
const CASE: &str = "GLEANER_ATTACK_CASE";

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
enum AttackOutcome {
    /// The wake ends with this fault; the process goes on.
    Fault(FaultKind),
    /// The call is refused, with this text in the error, and the lambda may continue.
    Refused(&'static str),
    /// It may continue; output over the limits is dropped and counted.
    RateLimited,
    /// It may continue; what it wrote in place of results is counted, and changes no other result.
    Garbled,
    /// The shim kills the process, or the process ends itself. A new one is started, and the wake
    /// is a fault of kind `killed`, with this text.
    Killed(&'static str),
    /// The process cannot continue, reports why and ends, each time it is started. It was not
    /// killed, and the run fails.
    Broken,
}

use AttackOutcome::{Broken, Fault, Garbled, Killed, RateLimited, Refused};
use FaultKind::{Deadline, Exception, Fuel, HostCall, Memory, Trap};

/// An attack, and its outcome in WebAssembly and in Python; `None` where the language cannot
/// express it.
const ATTACKS: &[(&str, Option<AttackOutcome>, Option<AttackOutcome>)] = &[
    ("endless", Some(Fault(Fuel)), Some(Fault(Deadline))),
    ("host_calls", Some(Fault(Fuel)), Some(Fault(Deadline))),
    ("recurse", Some(Fault(Trap)), Some(Fault(Exception))),
    ("memory", Some(Fault(Memory)), Some(Fault(Memory))),
    ("read_only_memory", None, Some(Killed("MiB of memory; the limit is"))),
    ("page_tables", None, Some(Killed("MiB of memory; the limit is"))),
    ("threads", None, Some(Killed("threads; the limit is 512"))),
    ("full", None, Some(Killed("needed more memory"))),
    ("log_flood", Some(RateLimited), Some(RateLimited)),
    // Even the event that would report the outcome is refused.
    ("event_flood", Some(Fault(Exception)), Some(Fault(Exception))),
    ("handles", Some(Fault(HostCall)), None),
    ("fork", Some(Refused("not supported")), Some(Refused("Operation not permitted"))),
    ("program", Some(Refused("not supported")), Some(Refused("Operation not permitted"))),
    ("read_passwd", Some(Refused("")), Some(Refused("Permission denied"))),
    ("read_memory", None, Some(Refused("Permission denied"))),
    ("socket", Some(Refused("")), Some(Refused("Operation not permitted"))),
    ("connect", Some(Refused("")), Some(Refused("Operation not permitted"))),
    ("write_outside", Some(Refused("")), Some(Refused("Permission denied"))),
    ("results", None, Some(Refused("Permission denied"))),
    ("forge", None, Some(Garbled)),
    ("chmod", None, Some(Refused("Operation not permitted"))),
    ("kill", None, Some(Refused("Operation not permitted"))),
    ("ptrace", None, Some(Refused("PermissionError(1"))),
    ("truncate", None, Some(Refused("Operation not permitted"))),
    ("cores", None, Some(Refused("Operation not permitted"))),
    ("limits_of_others", None, Some(Refused("Operation not permitted"))),
    ("owner", None, Some(Refused("Operation not permitted"))),
    ("datagrams", None, Some(Refused("Operation not permitted"))),
    ("uncounted", None, Some(Refused("Operation not permitted"))),
    ("moved_stack", None, Some(Refused("PermissionError(1"))),
    ("zeros", None, Some(Refused("Permission denied"))),
    ("lease", None, Some(Refused("Operation not permitted"))),
    ("pinned", None, Some(Refused("Operation not permitted"))),
    ("lock", None, Some(Refused("PermissionError(1"))),
    ("in_flight", None, Some(Refused("Operation not permitted"))),
    ("watch", None, Some(Refused("PermissionError(1"))),
    ("timer", None, Some(Refused("PermissionError(1"))),
    ("descriptors", None, Some(Refused("Too many open files"))),
    ("large_pipe", None, Some(Refused("Operation not permitted"))),
    ("settings", None, Some(Refused("Permission denied"))),
    ("replace", None, Some(Refused("Operation not permitted"))),
    ("sleep", Some(Fault(HostCall)), Some(Fault(Deadline))),
    ("swallow", None, Some(Killed("was in one wake"))),
    ("deaf", None, Some(Killed("was in one wake"))),
    ("late", None, Some(Fault(Deadline))),
    ("timer_off", None, Some(Fault(Deadline))),
    ("terminate", None, Some(Killed("ended by itself"))),
    ("stop", None, Some(Killed("was stopped by a signal"))),
    ("exit", Some(Fault(Trap)), Some(Fault(Exception))),
    ("exit_now", None, Some(Killed("ended by itself"))),
    ("abort", Some(Fault(Trap)), Some(Killed("ended by signal 6"))),
    ("descriptors_closed", None, Some(Broken)),
    ("corrupt", None, Some(Killed("ended by signal"))),
    // On the memory that all lambdas read; another is in `tests/tests/programs/shared_topics.rs`.
    ("shared_write", None, Some(Killed("ended by signal 11"))),
    ("shared_protect", None, Some(Refused("Permission denied"))),
    ("shared_file", None, Some(Refused("not permitted"))),
    ("shared_wait", None, Some(Refused("Operation not permitted"))),
];

fn main() -> ExitCode {
    if let Ok(case) = std::env::var(CASE) {
        let (attack, language) = case.split_once('/').expect("a case of this suite");
        let (_, wasm, python) =
            ATTACKS.iter().find(|(name, ..)| *name == attack).expect("a case of this suite");
        let outcome = if language == "rust" { wasm } else { python };
        run_attack(attack, language, outcome.expect("a case of this suite"));
        return ExitCode::SUCCESS;
    }
    let missing = namespace::unavailable();
    let cases = ATTACKS.iter().flat_map(|(attack, wasm, python)| {
        let languages = [("rust", wasm), ("python", python)];
        languages
            .into_iter()
            .filter(|(_, outcome)| outcome.is_some())
            .map(move |(language, _)| format!("{attack}/{language}"))
    });
    let trial = |case: String| {
        let name = match missing {
            Some(why) => format!("{case} [{why}]"),
            None => case.clone(),
        };
        Trial::test(name, move || namespace::case(CASE, &case)).with_ignored_flag(missing.is_some())
    };
    let mut arguments = Arguments::from_args();
    // They mostly wait: for a start, a deadline, a status each half a second.
    arguments.test_threads.get_or_insert(4);
    let trials = cases.map(trial).collect();
    libtest_mimic::run(&arguments, trials).exit_code()
}

/// An unrelated process, as a target of attacks.
struct Bystander(Child);

impl Bystander {
    fn new() -> Self {
        let child =
            Command::new("sleep").arg("1000").stdin(Stdio::null()).spawn().expect("`sleep` exists");
        Self(child)
    }

    fn is_alive(&mut self) -> bool {
        matches!(self.0.try_wait(), Ok(None))
    }
}

impl Drop for Bystander {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn run_attack(attack: &str, language: &str, outcome: AttackOutcome) {
    let mut bystander = Bystander::new();
    let out = TempFolder::new();
    let lambda = root().join("tests/lambdas/attack").join(language);
    let (attack_set, target) = (format!("attack={attack}"), format!("target={}", bystander.0.id()));
    let started = run(&lambda, out.path(), &["--set", &attack_set, "--set", &target]);
    let decision = decision_with_outcome(&started, outcome);
    // A process that dies from the attack dies again after each start.
    let live = (!matches!(outcome, Killed(_) | Broken)).then(|| until_it_continues(&started));
    if outcome == Garbled {
        started.until_live("garbage to be counted", |live| live.unwritten >= 100);
    }
    let finished = started.interrupt();
    let code = match outcome {
        Fault(_) | Killed(_) => Some(Exit::LambdaFaulted),
        Broken => Some(Exit::Internal),
        Refused(_) | RateLimited | Garbled => None,
    };
    if let Some(code) = code {
        assert_eq!(finished.status.code(), Some(i32::from(code.code())), "{}", finished.stderr);
    }
    println!("{attack}/{language}: {}", summary_of(decision.as_ref()));
    match outcome {
        Fault(kind) => {
            let fault = decision.and_then(|decision| decision.fault).expect("a fault");
            assert_eq!(fault.kind, kind, "{}", fault.message);
            // The shim may see the memory of a further attack before that is refused.
            let by_shim = kind == Memory && finished.stderr.contains("of memory; the limit is");
            let restarts = finished.ended().restarts;
            assert!(restarts == 0 || by_shim, "the process lives on: {}", finished.stderr);
        }
        Refused(words) => {
            let decision = decision.expect("an event");
            let event = decision
                .triggers
                .iter()
                .find(|it| it.label != "flood")
                .expect("the lambda reports the outcome");
            assert_eq!(event.label, "refused", "{event:?}");
            let why = event.attributes["why"].as_str().expect("a text");
            assert!(why.contains(words) && !why.contains("unknown attack"), "{why}");
        }
        Broken => assert!(finished.stderr.contains("a process failed"), "{}", finished.stderr),
        RateLimited => assert!(live.is_some_and(|live| live.log_dropped > 1000)),
        Garbled => {
            let written = decisions(out.path());
            let forged =
                |it: &Decision| it.fault.as_ref().is_some_and(|fault| fault.message == "forged");
            assert!(written.iter().any(forged), "{written:?}");
            // Its other results are unaffected, among them the event after the attack.
            assert!(
                written
                    .iter()
                    .any(|it| it.triggers.iter().any(|trigger| trigger.label == "escaped")),
                "{written:?}"
            );
            assert_eq!(finished.ended().restarts, 0, "the process lives on: {}", finished.stderr);
        }
        Killed(words) => {
            let fault = decision.and_then(|decision| decision.fault).expect("a fault");
            assert_eq!(fault.kind, FaultKind::Killed, "{}", fault.message);
            assert!(fault.message.contains(words), "{}", fault.message);
            let written = decisions(out.path());
            let killed = |it: &Decision| {
                it.fault.as_ref().is_some_and(|fault| fault.kind == FaultKind::Killed)
            };
            assert!(written.iter().any(killed), "{written:?}");
        }
    }
    assert!(bystander.is_alive(), "an unrelated process was hit");
    assert!(
        !Path::new("/tmp/gleaner-escaped").exists(),
        "a file was written outside of the allowed folders"
    );
}

/// The decision that shows the outcome; `None` if it is only counted.
fn decision_with_outcome(started: &RunningProgram, outcome: AttackOutcome) -> Option<Decision> {
    let decision = |wanted: &dyn Fn(&Decision) -> bool| {
        started.until("the attack to show", |line| match line {
            JsonReport::Lambda(Report::Decision(decision)) if wanted(&decision) => Some(*decision),
            _ => None,
        })
    };
    // If the machine stalls in a wake, a deadline fault may come first; the lambda attacks again.
    let fault = |kind| decision(&|it| it.fault.as_ref().is_some_and(|fault| fault.kind == kind));
    match outcome {
        Fault(kind) => Some(fault(kind)),
        Refused(_) => Some(decision(&|decision| !decision.triggers.is_empty())),
        Killed(_) => Some(fault(FaultKind::Killed)),
        Broken => {
            let mut starts = 0;
            started.until("a start after the first", |line| {
                starts += u32::from(matches!(line, JsonReport::Lambda(Report::Ready)));
                (starts > 1).then_some(())
            });
            None
        }
        RateLimited | Garbled => None,
    }
}

/// Waits until the lambda has run for some wakes after its attack.
fn until_it_continues(started: &RunningProgram) -> LiveStatus {
    let mut seen: BTreeMap<u32, u64> = BTreeMap::new();
    started.until("the lambda to continue", |line| match line {
        JsonReport::Lambda(Report::Live(live)) => {
            let first = *seen.entry(live.restarts).or_insert(live.wakes);
            (live.wakes > first.max(5)).then_some(*live)
        }
        _ => None,
    })
}

fn summary_of(decision: Option<&Decision>) -> String {
    let Some(decision) = decision else { return "counted".to_owned() };
    match (&decision.fault, decision.triggers.first()) {
        (Some(fault), _) => {
            format!("{:?}: {}", fault.kind, fault.message.lines().last().unwrap_or_default())
        }
        (None, Some(trigger)) => format!("{}: {:?}", trigger.label, trigger.attributes),
        (None, None) => "nothing".to_owned(),
    }
}

//! The attacker: the lambda of `tests/lambdas/attack`, with the highest plausible limits in its
//! manifest.

use std::fmt;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use gleaner_messages::transport::Clock;
use gleaner_protocol::LiveStatus;
use gleaner_tests::live::{RunningProgram, run};
use gleaner_tests::{LambdaCopy, TempFolder};

use super::blocks::{BLOCK_MS, BlockSchedule};
use crate::measure::{Twin, bind_to};
use gleaner_bench::Figure;

pub(super) struct Attack {
    name: &'static str,
    /// Name of the behaviour in the lambda, and its language. `None` for a busy thread of the
    /// bench: it shows what the machine itself does not isolate.
    by: Option<(&'static str, Twin)>,
}

const fn by(name: &'static str, behaviour: &'static str, kind: Twin) -> Attack {
    Attack { name, by: Some((behaviour, kind)) }
}

pub(super) const ATTACKS: &[Attack] = &[
    Attack { name: "busy thread, not a lambda", by: None },
    by("endless loop", "endless", Twin::Rust),
    by("loop of host calls", "host_calls", Twin::Rust),
    by("memory bomb", "memory", Twin::Rust),
    by("writing to all memory", "touch", Twin::Rust),
    by("log flood", "log_flood", Twin::Rust),
    by("event flood", "event_flood", Twin::Rust),
    by("endless loop", "endless", Twin::Python),
    by("memory bomb", "memory", Twin::Python),
    by("writing to all memory", "touch", Twin::Python),
    by("busy numpy", "numpy", Twin::Python),
    by("log flood", "log_flood", Twin::Python),
    by("event flood", "event_flood", Twin::Python),
    by("sleeping past the deadline", "sleep", Twin::Python),
];

/// Limits of the attacker: 200 ms of every wake, a wake each millisecond, more memory than the
/// largest cache, and the highest output rates that the host accepts.
const LIMITS: &str = "[limits]
deadline = \"200ms\"
fuel = 1_000_000_000_000
memory = \"256 MiB\"
log_lines = 10_000
log_bytes = \"16 MiB\"
events_per_minute = 60_000

";
const TOUCHED_MIB: u32 = 128;

impl Attack {
    pub(super) fn is_by_lambda(&self) -> bool {
        self.by.is_some()
    }

    /// Returns whether the attack runs with `--quick`, which runs two.
    pub(super) fn is_quick(&self) -> bool {
        matches!(self.by, Some(("endless", _)))
    }
}

impl fmt::Display for Attack {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.by {
            Some((_, kind)) => write!(f, "{} in {kind}", self.name),
            None => f.write_str(self.name),
        }
    }
}

/// A running attacker on its own core.
pub(super) enum Attacker {
    Lambda {
        name: String,
        started: RunningProgram,
        statuses: Vec<(i64, LiveStatus)>,
        _folders: (LambdaCopy, TempFolder),
    },
    Thread {
        core: usize,
    },
}

impl Attacker {
    /// Starts the attacker on `core` and waits until its `init` has returned.
    pub(super) fn start(attack: &Attack, core: usize) -> Self {
        let Some((behaviour, kind)) = attack.by else { return Self::Thread { core } };
        let lambda =
            LambdaCopy::of(&format!("tests/lambdas/attack/{}", kind.folder()), |manifest| {
                with_high_limits(&manifest)
            });
        let out = TempFolder::new();
        let settings = [
            format!("attack={behaviour}"),
            format!("every_ms={BLOCK_MS}"),
            format!("touch_mib={TOUCHED_MIB}"),
        ];
        let start = || {
            // Child processes inherit the core of their thread.
            bind_to([core]).expect("an allowed core");
            let args = settings.iter().flat_map(|setting| ["--set", setting]).collect::<Vec<_>>();
            run(lambda.path(), out.path(), &args)
        };
        let started = thread::scope(|scope| scope.spawn(start).join().expect("it starts"));
        started.until_ready();
        Self::Lambda {
            name: attack.to_string(),
            started,
            statuses: Vec::new(),
            _folders: (lambda, out),
        }
    }

    /// Runs until the end of `schedule`.
    pub(super) fn attack(&mut self, schedule: &BlockSchedule, clock: Clock) {
        match self {
            Self::Lambda { started, statuses, .. } => {
                while clock.now() < schedule.end_ns() {
                    let live = started.until_live("a status of the attacker", |_| true);
                    statuses.push((clock.now(), live));
                }
            }
            Self::Thread { core } => {
                busy(*core, schedule.end_ns(), clock).join().expect("the thread does not panic")
            }
        }
    }

    /// Stops the attacker and reports its activity. A goal is missed if it did not attack in
    /// attacked blocks, or attacked in quiet ones.
    pub(super) fn end(self, schedule: &BlockSchedule, figures: &mut Vec<Figure>) {
        let Self::Lambda { name, started, statuses, _folders } = self else { return };
        started.interrupt();
        let (mut limited, mut cpu_s, mut up_s) = ([0, 0], [0.0, 0.0], [0.0, 0.0]);
        for [(from_ns, before), (to_ns, after)] in statuses.array_windows() {
            let Some(block) = schedule.block(*from_ns, *to_ns) else { continue };
            let count = |live: &LiveStatus| live.faults + live.log_dropped + live.triggers_refused;
            limited[block % 2] += count(after).saturating_sub(count(before));
            cpu_s[block % 2] += after.cpu_s - before.cpu_s;
            up_s[block % 2] += after.up_s - before.up_s;
        }
        let name = format!("{name}: the attacker");
        figures.push(Figure::without_goal(
            &format!("{name}: share of its core, quiet"),
            "%",
            &[100.0 * cpu_s[0] / up_s[0]],
        ));
        figures.push(Figure::without_goal(
            &format!("{name}: share of its core, attacked"),
            "%",
            &[100.0 * cpu_s[1] / up_s[1]],
        ));
        let [quiet, attacked] = limited.map(|count| count as f64);
        // Otherwise nothing was measured.
        figures.push(Figure::at_most(
            &format!("{name}: limits exceeded, quiet"),
            "times",
            0.0,
            &[quiet],
        ));
        figures.push(Figure::at_least(
            &format!("{name}: limits exceeded, attacked"),
            "times",
            1.0,
            &[attacked],
        ));
        let rate = attacked / up_s[1];
        figures.push(Figure::without_goal(
            &format!("{name}: faults and dropped output"),
            "per second",
            &[rate],
        ));
    }
}

/// A thread that is busy on `core` in attacked blocks, and sleeps in quiet ones.
fn busy(core: usize, end_ns: i64, clock: Clock) -> JoinHandle<()> {
    thread::spawn(move || {
        bind_to([core]).expect("an allowed core");
        while clock.now() < end_ns {
            if clock.now() / (BLOCK_MS * 1_000_000) % 2 == 0 {
                thread::sleep(Duration::from_millis(1));
            }
        }
    })
}

fn with_high_limits(manifest: &str) -> String {
    let (before, rest) = manifest.split_once("[limits]\n").expect("the attack has limits");
    let (_, config) = rest.split_once("[config]\n").expect("and then a configuration");
    assert!(before.contains("\"20ms\""), "the period has changed");
    format!("{}{LIMITS}[config]\n{config}", before.replace("\"20ms\"", "\"1ms\""))
}

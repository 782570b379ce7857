//! The lambda of `tests/lambdas/attack`, with the manifest of somebody who wants as much as he can
//! get.

use std::fmt;
use std::thread::{self, JoinHandle};
use std::time::Duration;

use gleaner_protocol::Live;
use gleaner_tests::live::{Started, run};
use gleaner_tests::{Copy, Folder};
use gleaner_transport::Clock;

use super::blocks::{BLOCK_MS, Course};
use crate::measure::{Figure, Kind, stay_on};

/// What an attacker does.
pub(super) struct Attack {
    /// In words.
    name: &'static str,
    /// By its name in the lambda, and in which language; none for a thread of ours that does
    /// nothing but to be busy, which shows what the machine itself does not keep apart.
    by: Option<(&'static str, Kind)>,
}

const fn by(name: &'static str, behaviour: &'static str, kind: Kind) -> Attack {
    Attack { name, by: Some((behaviour, kind)) }
}

/// All of them.
pub(super) const ATTACKS: &[Attack] = &[
    Attack { name: "busy neighbour that is no lambda", by: None },
    by("endless loop", "endless", Kind::Rust),
    by("loop of host calls", "host_calls", Kind::Rust),
    by("memory bomb", "memory", Kind::Rust),
    by("writing to all its memory", "touch", Kind::Rust),
    by("log flood", "log_flood", Kind::Rust),
    by("event flood", "event_flood", Kind::Rust),
    by("endless loop", "endless", Kind::Python),
    by("memory bomb", "memory", Kind::Python),
    by("writing to all its memory", "touch", Kind::Python),
    by("busy numpy", "numpy", Kind::Python),
    by("log flood", "log_flood", Kind::Python),
    by("event flood", "event_flood", Kind::Python),
    by("sleeping past the deadline", "sleep", Kind::Python),
];

/// What the attacker asks for: 200 ms of every wake, a wake each millisecond, more memory than the
/// largest cache has, and all the words that the host takes.
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
    pub(super) fn is_by_a_lambda(&self) -> bool {
        self.by.is_some()
    }

    /// One of two that show that the bench runs.
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

/// An attacker on a core of its own.
pub(super) enum Attacker {
    Lambda { name: String, started: Started, seen: Vec<(i64, Live)>, _folders: (Copy, Folder) },
    Neighbour { core: usize },
}

impl Attacker {
    /// Starts it on `core`, and waits until it has had its `init`.
    pub(super) fn start(attack: &Attack, core: usize) -> Self {
        let Some((behaviour, kind)) = attack.by else { return Self::Neighbour { core } };
        let lambda = Copy::of(&format!("tests/lambdas/attack/{}", kind.folder()), |manifest| {
            hungry(&manifest)
        });
        let out = Folder::new();
        let settings = [
            format!("attack={behaviour}"),
            format!("every_ms={BLOCK_MS}"),
            format!("touch_mib={TOUCHED_MIB}"),
        ];
        let start = || {
            // What a thread starts stays on its core.
            stay_on(core).expect("one of the cores that may be used");
            let args = settings.iter().flat_map(|setting| ["--set", setting]).collect::<Vec<_>>();
            run(lambda.path(), out.path(), &args)
        };
        let started = thread::scope(|scope| scope.spawn(start).join().expect("it starts"));
        started.until_ready();
        Self::Lambda {
            name: attack.to_string(),
            started,
            seen: Vec::new(),
            _folders: (lambda, out),
        }
    }

    /// Until the end of `course`.
    pub(super) fn attack(&mut self, course: &Course, clock: Clock) {
        match self {
            Self::Lambda { started, seen, .. } => {
                while clock.now() < course.end_ns() {
                    let live = started.until_live("a status of the attacker", |_| true);
                    seen.push((clock.now(), live));
                }
            }
            Self::Neighbour { core } => {
                busy(*core, course.end_ns(), clock).join().expect("it does nothing")
            }
        }
    }

    /// Ends it, and tells how much it did: a goal is missed if it did not attack in attacked
    /// blocks, or did in quiet ones.
    pub(super) fn end(self, course: &Course, figures: &mut Vec<Figure>) {
        let Self::Lambda { name, started, seen, _folders } = self else { return };
        started.signal("INT");
        started.finish();
        let (mut hindered, mut cpu_s, mut up_s) = ([0, 0], [0.0, 0.0], [0.0, 0.0]);
        for [(from_ns, before), (to_ns, after)] in seen.array_windows() {
            let Some(block) = course.block(*from_ns, *to_ns) else { continue };
            let count = |live: &Live| live.faults + live.log_dropped + live.triggers_refused;
            hindered[block % 2] += count(after).saturating_sub(count(before));
            cpu_s[block % 2] += after.cpu_s - before.cpu_s;
            up_s[block % 2] += after.up_s - before.up_s;
        }
        let name = format!("{name}: the attacker");
        figures.push(Figure::told(
            &format!("{name}: share of its core, quiet"),
            "%",
            &[100.0 * cpu_s[0] / up_s[0]],
        ));
        figures.push(Figure::told(
            &format!("{name}: share of its core, attacked"),
            "%",
            &[100.0 * cpu_s[1] / up_s[1]],
        ));
        let [quiet, attacked] = hindered.map(|count| count as f64);
        // Else nothing was measured.
        figures.push(Figure::at_most(
            &format!("{name}: how often it was hindered, quiet"),
            "times",
            0.0,
            &[quiet],
        ));
        figures.push(Figure::at_least(
            &format!("{name}: how often it was hindered, attacked"),
            "times",
            1.0,
            &[attacked],
        ));
        let rate = attacked / up_s[1];
        figures.push(Figure::told(
            &format!("{name}: faults, and words that were thrown away"),
            "a second",
            &[rate],
        ));
    }
}

/// A thread that is busy on `core` in attacked blocks, and sleeps in quiet ones.
fn busy(core: usize, end_ns: i64, clock: Clock) -> JoinHandle<()> {
    thread::spawn(move || {
        stay_on(core).expect("one of the cores that may be used");
        while clock.now() < end_ns {
            if clock.now() / (BLOCK_MS * 1_000_000) % 2 == 0 {
                thread::sleep(Duration::from_millis(1));
            }
        }
    })
}

fn hungry(manifest: &str) -> String {
    let (before, rest) = manifest.split_once("[limits]\n").expect("the attack has limits");
    let (_, config) = rest.split_once("[config]\n").expect("and then a configuration");
    assert!(before.contains("\"20ms\""), "the period is another one");
    format!("{}{LIMITS}[config]\n{config}", before.replace("\"20ms\"", "\"1ms\""))
}

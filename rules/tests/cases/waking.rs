//! Cases of schedules and of the back-off.

use std::cell::Cell;
use std::rc::Rc;

use gleaner_rules::faults::{Faults, REINITIALISED};
use gleaner_rules::log::Rate;
use gleaner_rules::ring::Ring;
use gleaner_rules::schedule::{self, Backlog, Schedule};
use serde_json::{Value, json};

use crate::{CaseReplies, ns, replay, whole};

/// A ring, and the number of samples that a schedule skipped.
#[derive(Clone)]
struct Shown(Rc<(std::cell::RefCell<Ring<()>>, Cell<u64>)>);

impl schedule::RingView for Shown {
    type Sample = u64;

    fn head(&self) -> u64 {
        self.0.0.borrow().counts().received
    }

    fn depth(&self) -> usize {
        self.0.0.borrow().depth()
    }

    fn get(&self, position: u64) -> Option<u64> {
        self.0.0.borrow().get(position).map(|cell| cell.position)
    }

    fn newest(&self) -> Option<(u64, u64)> {
        self.0.0.borrow().newest().map(|cell| (cell.position, cell.position))
    }

    fn skip(&self, samples: u64) {
        self.0.1.set(self.0.1.get() + samples);
    }
}

#[test]
fn schedules() {
    replay("schedule", include_str!("../../cases/schedule.json"), |given| {
        let (depth, hold) =
            (given["depth"].as_u64().unwrap_or(1), given["hold"].as_u64().unwrap_or(1));
        let ring = Ring::new(depth as usize, hold as usize, 0);
        let shown = Shown(Rc::new((ring.into(), Cell::new(0))));
        let mut schedule = match given["backlog"].as_str() {
            None => Schedule::periodic(ns(&given["period_ns"])),
            Some("each") => Schedule::event(shown.clone(), Backlog::Each),
            Some(_) => Schedule::event(shown.clone(), Backlog::Latest),
        };
        let live = given["live"] == true;
        let replies: CaseReplies<'static> = Box::new(move |call, given| match call {
            "begin" if live => json!(schedule.begin_live(ns(&given[0]))),
            "begin" => json!(schedule.begin(ns(&given[0]))),
            "ticks" => {
                let ticks = std::iter::from_fn(|| schedule.next_tick(ns(&given[0])));
                ticks.map(|tick| json!([tick.at_ns, tick.missed])).collect()
            }
            "missed" => json!(schedule.missed()),
            "arrive" => {
                json!((0..whole(&given[0])).for_each(|_| shown.0.0.borrow_mut().push((), 0)))
            }
            "wakes" => std::iter::from_fn(|| schedule.next_event()).map(Value::from).collect(),
            "skipped" => json!(shown.0.1.get()),
            "finish" => json!(schedule.finish()),
            other => panic!("{other}"),
        });
        replies
    });
}

#[test]
fn backs_off_after_faults() {
    replay("faults", include_str!("../../cases/faults.json"), |_| {
        let (mut faults, mut log) = (Faults::default(), Rate::new(0, 0));
        Box::new(move |_, given| {
            let at_ns = ns(&given[0]) * 1_000_000;
            if faults.is_backing_off(at_ns) {
                return json!("backs off");
            }
            let notes = [faults.begin(), faults.end(at_ns, given[1] == true)];
            let notes = notes.into_iter().flatten().filter(|note| log.notes(at_ns, note));
            notes
                .map(|note| if note == REINITIALISED { "re-initialised" } else { "backs off" })
                .collect()
        })
    });
}

//! Tests of the windows, also against a naive model.

use gleaner_lambda::TriggerKind::{self, Event, Start, Stop};

use super::*;

fn rules(preroll_ns: i64, postroll_ns: i64, cooldown_ns: i64) -> WindowRules {
    WindowRules { preroll_ns, postroll_ns, cooldown_ns }
}

const LONG: i64 = i64::MAX / 4;

fn machine(max_length_ns: i64, rules: &[WindowRules]) -> Windows {
    let mut windows = Windows::new(max_length_ns);
    rules.iter().for_each(|rules| {
        windows.add(*rules);
    });
    windows
}

/// Does all pending steps; returns the finished groups.
fn drain(windows: &mut Windows) -> Vec<Group> {
    let mut finished = Vec::new();
    while let Some(step) = windows.step() {
        match step {
            WindowStep::Finish(group) | WindowStep::Late(_, group) => finished.push(*group),
            WindowStep::Begin(_) | WindowStep::Join { .. } | WindowStep::Roll { .. } => {}
        }
    }
    finished
}

/// Returns the begins and ends of the groups of triggers of lambda 0, each at its anchor.
fn groups(windows: &mut Windows, triggers: &[(i64, TriggerKind)]) -> Vec<(i64, i64)> {
    let mut finished = Vec::new();
    for (at, kind) in triggers {
        windows.pass(*at);
        finished.extend(drain(windows));
        windows.trigger(0, *kind, "x", *at);
        finished.extend(drain(windows));
    }
    windows.pass(LONG);
    finished.extend(drain(windows));
    spans(&finished)
}

fn spans(groups: &[Group]) -> Vec<(i64, i64)> {
    groups.iter().map(|group| (group.begin, group.to)).collect()
}

#[test]
fn overlapping_windows_share_a_clip_and_others_do_not() {
    let cases = [
        (vec![8, 12], vec![(3, 17)]),
        (vec![8, 16], vec![(3, 21)]),
        (vec![8, 18], vec![(3, 23)]),
        (vec![8, 19], vec![(3, 13), (14, 24)]),
        (vec![8, 8, 8], vec![(3, 13)]),
    ];
    for (anchors, expected) in cases {
        let triggers: Vec<_> = anchors.iter().map(|at| (*at, Event)).collect();
        let found = groups(&mut machine(LONG, &[rules(5, 5, 0)]), &triggers);
        assert_eq!(found, expected, "{anchors:?}");
    }
}

#[test]
fn a_start_lasts_until_its_stop_and_others_are_ignored() {
    let mut windows = machine(LONG, &[rules(5, 2, 0)]);
    let triggers = [(3, Stop), (10, Start), (11, Start), (12, Event), (500, Stop), (501, Stop)];
    assert_eq!(groups(&mut windows, &triggers), [(5, 502)]);
    let mut windows = machine(LONG, &[rules(5, 2, 0)]);
    let outcomes = triggers.map(|(at, kind)| windows.trigger(0, kind, "x", at));
    use TriggerOutcome::{Ignored, Opened, Stopped};
    assert_eq!(outcomes, [Ignored, Opened, Ignored, Opened, Stopped, Ignored]);
}

#[test]
fn the_end_of_an_event_may_be_later_than_the_stop() {
    let mut windows = machine(LONG, &[rules(0, 100, 0)]);
    assert_eq!(groups(&mut windows, &[(10, Start), (50, Event), (20, Stop)]), [(10, 150)]);
}

#[test]
fn a_cooldown_opens_no_window_until_it_ends() {
    let mut windows = machine(LONG, &[rules(1, 1, 10)]);
    let outcomes = [0, 9, 10, 19, 25].map(|at| windows.trigger(0, Event, "x", at));
    use TriggerOutcome::{InCooldown, Opened};
    assert_eq!(outcomes, [Opened, InCooldown, Opened, InCooldown, Opened]);
    assert_eq!(windows.trigger(0, Start, "x", 30), InCooldown);
    assert_eq!(windows.trigger(0, Stop, "x", 31), TriggerOutcome::Ignored);
}

#[test]
fn a_late_trigger_without_a_cooldown_opens_its_window() {
    let mut windows = machine(LONG, &[rules(1, 1, 0)]);
    assert_eq!([20, 10].map(|at| windows.trigger(0, Event, "x", at)), [TriggerOutcome::Opened; 2]);
}

#[test]
fn a_late_window_may_join_two_others() {
    // Lambda 1 reaches back over the gap between the windows of lambda 0 only later.
    let mut windows = machine(LONG, &[rules(1, 1, 0), rules(50, 1, 0)]);
    for (at, lambda) in [(100, 0), (120, 0), (140, 1)] {
        windows.pass(at);
        assert_eq!(drain(&mut windows), []);
        windows.trigger(lambda, Event, "x", at);
        assert_eq!(drain(&mut windows), []);
    }
    windows.pass(1000);
    let finished = drain(&mut windows);
    assert_eq!(spans(&finished), [(90, 141)]);
    // Only the windows of lambda 0 are covered for it.
    let covered: Vec<_> = (80..130).filter(|at| finished[0].covers(0, *at)).collect();
    assert_eq!(covered, [99, 100, 101, 119, 120, 121]);
}

#[test]
fn a_late_trigger_before_the_open_clip_makes_a_separate_clip() {
    let mut windows = machine(LONG, &[rules(5, 5, 0), rules(2, 2, 0)]);
    windows.pass(100);
    windows.trigger(0, Start, "x", 100);
    assert_eq!(drain(&mut windows), []);
    windows.trigger(1, Event, "x", 60);
    let late = drain(&mut windows);
    assert_eq!(spans(&late), [(58, 62)]);
    windows.trigger(1, Event, "x", 93);
    assert_eq!(drain(&mut windows), []);
    assert_eq!(windows.open().map(|group| (group.begin, group.from)), Some((91, 91)));
}

#[test]
fn a_late_stop_ends_its_window_now() {
    let mut windows = machine(LONG, &[rules(5, 5, 0)]);
    windows.pass(100);
    windows.trigger(0, Start, "x", 100);
    drain(&mut windows);
    windows.pass(200);
    windows.trigger(0, Stop, "x", 150);
    assert_eq!(windows.open().map(|group| group.to), Some(200));
}

#[test]
fn a_long_clip_is_split_without_a_gap() {
    let mut windows = machine(100, &[rules(5, 0, 0)]);
    windows.pass(50);
    windows.trigger(0, Start, "x", 50);
    drain(&mut windows);
    let mut boundaries = Vec::new();
    for now in 51..400 {
        windows.pass(now);
        while let Some(step) = windows.step() {
            let WindowStep::Roll { boundary, before } = step else { panic!("{step:?}") };
            assert_eq!((now, before.from + 100), (boundary + 1, boundary));
            let open = windows.open().map(|group| (group.from, group.windows(0)));
            assert_eq!(open, Some((boundary + 1, 1)));
            boundaries.push(boundary);
        }
    }
    assert_eq!(boundaries, [145, 246, 347]);
}

#[test]
fn extreme_times_do_not_overflow() {
    let mut windows = machine(LONG, &[rules(i64::MAX, i64::MAX, i64::MAX)]);
    for at in [0, i64::MAX, 5] {
        windows.pass(at);
        for kind in [Event, Start, Stop, Event] {
            windows.trigger(0, kind, "x", at);
            drain(&mut windows);
        }
    }
    assert!(windows.close().is_some());
}

#[test]
fn random_triggers_give_the_groups_of_the_model() {
    for seed in 0..3_000 {
        let mut random = SeededRandom(seed);
        let lambdas = 1 + random.below(3) as usize;
        let mut roll = || [0, random.below(5), random.below(40)][random.below(3) as usize];
        let rules: Vec<_> = (0..lambdas).map(|_| rules(roll(), roll(), roll())).collect();
        let mut windows = machine(LONG, &rules);
        let (mut triggers, mut finished, mut now) = (Vec::new(), Vec::new(), 100);
        let mut trimmed = i64::MIN;
        let mut act = |windows: &mut Windows| {
            while let Some(step) = windows.step() {
                match step {
                    WindowStep::Finish(group) => finished.push(*group),
                    WindowStep::Begin(new) | WindowStep::Join { windows: new, .. } => {
                        let is_kept = new.iter().all(|window| window.from >= trimmed);
                        assert!(is_kept, "a needed entry was dropped: {seed}");
                    }
                    step => panic!("{step:?}"),
                }
            }
            // Tighter than the recorder: one preroll, and no second for late triggers.
            let longest = rules.iter().map(|rules| rules.preroll_ns).max().unwrap_or(0);
            trimmed = windows.now - longest;
        };
        for _ in 0..random.below(30) {
            now += [0, 1, random.below(10), random.below(100)][random.below(4) as usize];
            windows.pass(now);
            act(&mut windows);
            if random.below(4) > 0 {
                let lambda = random.below(lambdas as u64) as usize;
                let kind = [Event, Event, Start, Stop][random.below(4) as usize];
                triggers.push((now, lambda, kind));
                windows.trigger(lambda, kind, "x", now);
                act(&mut windows);
            }
        }
        now += random.below(200);
        windows.pass(now);
        act(&mut windows);
        while let Some(group) = windows.close() {
            finished.push(group);
            finished.extend(drain(&mut windows));
        }
        let rolls = rules.iter().map(|of| (of.preroll_ns, of.postroll_ns, of.cooldown_ns));
        let expected = model_groups(&rolls.collect::<Vec<_>>(), &triggers);
        let end = |group: &[ModelWindow]| group.iter().map(|window| window.2).max().unwrap();
        let span = |group: &Vec<ModelWindow>| (group[0].1, end(group));
        let wanted: Vec<_> = expected.iter().map(span).collect();
        assert_eq!(spans(&finished), wanted, "seed {seed}: {rules:?} {triggers:?}");
        for (group, expected) in finished.iter().zip(&expected) {
            for lambda in 0..lambdas {
                let own: Vec<_> = expected.iter().filter(|window| window.0 == lambda).collect();
                assert_eq!(group.windows(lambda), own.len() as u64, "seed {seed}");
                for at in 0..now + 100 {
                    let covered = own.iter().any(|(_, from, to)| (*from..=*to).contains(&at));
                    let found = group.covers(lambda, at);
                    assert_eq!(found, covered, "seed {seed}, lambda {lambda} at {at}");
                }
            }
        }
    }
}

#[test]
fn a_stop_ends_the_recording_of_its_label_and_the_clip_lasts_until_the_last() {
    let mut windows = machine(1_000_000, &[rules(5, 5, 0)]);
    windows.pass(100);
    assert_eq!(windows.trigger(0, Start, "a", 100), TriggerOutcome::Opened);
    assert!(matches!(windows.step(), Some(WindowStep::Begin(_))));
    assert_eq!(windows.trigger(0, Start, "b", 110), TriggerOutcome::Opened);
    assert_eq!(windows.trigger(0, Start, "b", 111), TriggerOutcome::Ignored);
    assert_eq!(windows.trigger(0, Stop, "c", 112), TriggerOutcome::Ignored);
    assert_eq!(windows.trigger(0, Stop, "a", 120), TriggerOutcome::Stopped);
    assert!(windows.open().is_some_and(Group::waits_for_stop));
    assert_eq!(windows.trigger(0, Stop, "b", 130), TriggerOutcome::Stopped);
    assert_eq!(windows.open().map(|group| (group.from, group.to)), Some((95, 135)));
}

fn count_opened(outcomes: &[TriggerOutcome]) -> usize {
    outcomes.iter().filter(|outcome| **outcome == TriggerOutcome::Opened).count()
}

#[test]
fn the_number_of_recordings_that_a_lambda_starts_is_bounded() {
    let mut windows = machine(1_000_000, &[rules(5, 5, 0)]);
    let outcomes: Vec<_> =
        (0..=STARTED_MAX).map(|n| windows.trigger(0, Start, &n.to_string(), 100)).collect();
    assert_eq!(count_opened(&outcomes), STARTED_MAX);
    assert_eq!(outcomes.last(), Some(&TriggerOutcome::TooManyStarted));
}

#[test]
fn windows_beyond_the_waiting_limit_are_refused() {
    let mut windows = machine(LONG, &[rules(0, 0, 0)]);
    let outcomes: Vec<_> = (0..4097).map(|n| windows.trigger(0, Event, "x", 10 * n)).collect();
    assert!(outcomes[..4096].iter().all(|outcome| *outcome == TriggerOutcome::Opened));
    let expected = (TriggerOutcome::TooManyWaiting, TriggerOutcome::TooManyWaiting);
    assert_eq!((outcomes[4096], windows.trigger(0, Start, "y", 100_000)), expected);
    assert_eq!(windows.forget_waiting(), 4096);
}

#[test]
fn clips_wait_for_late_wakes_before_they_end() {
    let mut windows = machine(100, &[rules(10, 20, 0), rules(0, 0, 0)]);
    windows.set_grace(30);
    windows.pass(1000);
    windows.trigger(0, Event, "x", 1000);
    // It would be finished one preroll after its end.
    windows.pass(1030 + 30);
    assert!(drain(&mut windows).is_empty());
    // A window behind it waits as long.
    windows.trigger(1, Event, "x", 1060);
    windows.pass(1031 + 30);
    assert_eq!(drain(&mut windows).len(), 1);
    windows.pass(2000);
    assert_eq!(drain(&mut windows).len(), 1);
    windows.trigger(0, Start, "x", 2000);
    windows.pass(2090 + 30);
    assert!(matches!(windows.step(), Some(WindowStep::Begin(_))));
    assert_eq!(windows.step(), None, "it is full, and waits");
    windows.pass(2091 + 30);
    assert!(matches!(windows.step(), Some(WindowStep::Roll { boundary: 2090, .. })));
    // A late clip is one that nothing can join any more.
    windows.trigger(1, Event, "x", 2091 - 102);
    assert!(windows.step().is_some_and(|step| matches!(step, WindowStep::Late(..))));
    windows.set_grace(i64::MAX / 2);
    windows.trigger(1, Event, "x", 2091 - 102);
    assert_eq!(windows.step(), None);
}

#[test]
fn commands_and_triggers_end_only_what_is_their_own() {
    let mut windows = machine(1_000_000, &[rules(10, 10, 1000)]);
    windows.pass(100);
    assert_eq!(windows.trigger(0, Event, "x", 100), TriggerOutcome::Opened);
    let outcomes = [0, 1, 2].map(|at| windows.command(0, Event, "x", 100 + at));
    assert_eq!(outcomes, [TriggerOutcome::Opened; 3], "a cooldown is the lambda's");
    assert_eq!(windows.trigger(0, Event, "x", 103), TriggerOutcome::InCooldown);
    assert_eq!(windows.command(0, Start, "a", 105), TriggerOutcome::Opened);
    assert_eq!(windows.command(0, Start, "a", 106), TriggerOutcome::Ignored);
    assert_eq!(windows.trigger(0, Stop, "a", 107), TriggerOutcome::Ignored);
    assert_eq!(windows.trigger(0, Start, "a", 1200), TriggerOutcome::Opened);
    assert_eq!(windows.command(0, Stop, "a", 1300), TriggerOutcome::Stopped);
    assert_eq!(windows.command(0, Stop, "a", 1301), TriggerOutcome::Ignored);
    drain(&mut windows);
    assert!(windows.open().unwrap().waits_for_stop(), "the lambda's goes on");
    assert_eq!(windows.command(0, Start, "b", 1310), TriggerOutcome::Opened);
    assert!(windows.end(0, 1400));
    assert!(windows.open().unwrap().waits_for_stop(), "a command's outlives the lambda");
    assert!(!windows.end(0, 1401));
    assert_eq!(windows.command(0, Stop, "b", 1500), TriggerOutcome::Stopped);
    windows.pass(LONG);
    assert_eq!(spans(&drain(&mut windows)), [(90, 1510)]);
}

#[test]
fn a_lambda_at_its_limit_does_not_block_commands() {
    let mut windows = machine(1_000_000, &[rules(10, 10, 0)]);
    for n in 0..2 * STARTED_MAX {
        windows.trigger(0, Start, &n.to_string(), 100);
    }
    let outcomes: Vec<_> =
        (0..=STARTED_MAX).map(|n| windows.command(0, Start, &n.to_string(), 100)).collect();
    assert_eq!(count_opened(&outcomes), STARTED_MAX);
}

/// A window of a model: lambda, first and last instant.
pub type ModelWindow = (usize, i64, i64);

/// Computes groups of windows by brute force: all windows at once, then the connected ones. It has
/// no state, and ignores the order of arrival.
///
/// `rolls` are preroll, postroll and cooldown of each lambda. A trigger is a stamp, the lambda and
/// the kind.
pub fn model_groups(
    rolls: &[(i64, i64, i64)],
    triggers: &[(i64, usize, TriggerKind)],
) -> Vec<Vec<ModelWindow>> {
    use TriggerKind::{Event, Start, Stop};
    let mut windows = Vec::new();
    for (lambda, (preroll, postroll, cooldown)) in rolls.iter().enumerate() {
        let (mut opened, mut started) = (None, None);
        for (at, _, kind) in triggers.iter().filter(|(_, owner, _)| *owner == lambda) {
            let cool = opened.is_none_or(|opened: i64| *at >= opened + cooldown);
            match (kind, started) {
                (Stop, Some(from)) => {
                    windows.push((lambda, from, at + postroll));
                    started = None;
                }
                (Event, _) if cool => {
                    windows.push((lambda, at - preroll, at + postroll));
                    opened = Some(*at);
                }
                (Start, None) if cool => {
                    started = Some(at - preroll);
                    opened = Some(*at);
                }
                _ => {}
            }
        }
        windows.extend(started.map(|from| (lambda, from, i64::MAX)));
    }
    windows.sort_by_key(|(_, from, _)| *from);
    let mut groups: Vec<Vec<ModelWindow>> = Vec::new();
    let mut end = i64::MIN;
    for window in windows {
        match groups.last_mut() {
            Some(group) if window.1 <= end => group.push(window),
            _ => groups.push(vec![window]),
        }
        end = end.max(window.2);
    }
    groups
}

/// Pseudo-random numbers, the same in each run (SplitMix64).
pub struct SeededRandom(pub u64);

impl SeededRandom {
    pub fn below(&mut self, n: u64) -> i64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((z ^ (z >> 31)) % n) as i64
    }
}

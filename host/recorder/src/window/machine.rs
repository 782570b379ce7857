//! The state machine of all windows, and its next step.

use std::collections::BTreeSet;

use gleaner_lambda::TriggerKind;

use super::{Group, Window, WindowRules};

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum TriggerOutcome {
    /// The trigger opened a window, or began a recording within the window of another recording.
    Opened,
    /// The trigger ended a recording that was started.
    Stopped,
    /// The trigger came too soon after the last one that opened a window.
    InCooldown,
    /// A start while one of its label is open; a stop while none of its label is.
    Ignored,
    /// A start while [`STARTED_MAX`] are open.
    TooManyStarted,
    TooManyWaiting,
}

#[derive(Copy, Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum TriggeredBy {
    Lambda,
    /// A command, which is independent of recordings that the lambda started, and of its cooldown.
    Command,
}

#[derive(Debug, PartialEq, Eq)]
pub enum WindowStep {
    /// A clip begins, with these windows; [`Windows::open`] has their group.
    Begin(Vec<Window>),
    /// These windows have joined the open clip.
    Join {
        windows: Vec<Window>,
        /// The first instant up to now that they cover and the clip did not: only later entries
        /// have to be searched.
        fresh_from: Option<i64>,
    },
    /// The clip is full: it ends at `boundary`, and the next one continues after it. The open group
    /// is already that of the next; `before` is the one that ends.
    Roll {
        /// Last instant of the full clip.
        boundary: i64,
        before: Box<Group>,
    },
    /// No window can touch the open clip any more: it is complete.
    Finish(Box<Group>),
    /// A trigger came so late that its windows lie before the open clip: they become a separate
    /// clip now.
    Late(Vec<Window>, Box<Group>),
}

#[derive(Debug, Default)]
pub struct Windows {
    lambdas: Vec<WindowLambda>,
    longest_preroll_ns: i64,
    max_length_ns: i64,
    /// Time that steps are delayed, as wakes may come late.
    grace_ns: i64,
    pub(super) now: i64,
    open: Option<Group>,
    /// Windows that do not touch the open group. They wait at most for the longest preroll, unless
    /// they came late.
    pending: Vec<Window>,
}

#[derive(Debug)]
struct WindowLambda {
    rules: WindowRules,
    /// Anchor of the last trigger that opened a window.
    opened_at: Option<i64>,
    /// Recordings that were started and not stopped, by their labels. Together they are one window,
    /// which lasts until the last stop.
    started: BTreeSet<(TriggeredBy, String)>,
}

/// Maximum number of running recordings of one lambda. Commands may start as many again.
pub const STARTED_MAX: usize = 64;

/// Maximum number of windows that wait for an open clip to end. Otherwise a lambda with windows
/// that do not touch could fill the memory while a disk is slow.
const WAITING_MAX: usize = 4096;

/// Greatest lag of a late trigger behind the samples even if no window has a preroll.
const LATE_NS: i64 = 1_000_000_000;

impl Windows {
    /// Creates a state without lambdas and windows. A clip covers `max_length_ns` at most.
    pub fn new(max_length_ns: i64) -> Windows {
        Windows { max_length_ns, now: i64::MIN, ..Windows::default() }
    }

    /// Adds a lambda; they are numbered from 0.
    pub fn add(&mut self, rules: WindowRules) -> usize {
        self.longest_preroll_ns = self.longest_preroll_ns.max(rules.preroll_ns);
        self.lambdas.push(WindowLambda { rules, opened_at: None, started: BTreeSet::new() });
        self.lambdas.len() - 1
    }

    /// Returns the time from now back to which samples have to be kept.
    ///
    /// Let P be the longest preroll. A trigger whose anchor is now covers nothing before `now - P`.
    ///
    /// A window that lies behind the end `to` of the open clip waits, and begins after `to`. It
    /// waits until that clip is finished, which is once `now > to + P + grace`. Until then it
    /// begins after `now - P - grace`. (If time jumps past both limits, `Recorder::pass` takes the
    /// pending steps before it drops samples.)
    ///
    /// So P and the grace are enough for triggers that come at once. Another P and a second let a
    /// trigger be late by as much.
    pub fn retention_ns(&self) -> i64 {
        self.longest_preroll_ns
            .saturating_mul(2)
            .saturating_add(LATE_NS)
            .saturating_add(self.grace_ns)
    }

    /// Returns the instant before which nothing will be queried.
    pub fn horizon(&self) -> i64 {
        self.now.saturating_sub(self.retention_ns())
    }

    /// Returns the group of the open clip.
    pub fn open(&self) -> Option<&Group> {
        self.open.as_ref()
    }

    /// Returns whether a window of `lambda`, open or waiting, contains `at`.
    pub fn covers(&self, lambda: usize, at: i64) -> bool {
        let waits = |window: &Window| {
            window.lambda == lambda && window.from <= at && window.to.is_none_or(|to| at <= to)
        };
        self.open.as_ref().is_some_and(|open| open.covers(lambda, at))
            || self.pending.iter().any(waits)
    }

    /// Returns the last instant that fits into the open clip.
    pub fn limit(&self) -> i64 {
        self.open.as_ref().map_or(i64::MAX, |open| open.from.saturating_add(self.max_length_ns))
    }

    /// Advances time; it never goes back.
    pub fn pass(&mut self, now: i64) {
        self.now = self.now.max(now);
    }

    /// Applies a trigger of `lambda` in a wake at `anchor`. A stop ends the recording that was
    /// started with the same label.
    pub fn trigger(
        &mut self,
        lambda: usize,
        kind: TriggerKind,
        label: &str,
        anchor: i64,
    ) -> TriggerOutcome {
        self.apply(lambda, TriggeredBy::Lambda, kind, label, anchor)
    }

    /// Applies a command in the name of `lambda` at `anchor`. A stop ends only a recording that a
    /// command started.
    pub fn command(
        &mut self,
        lambda: usize,
        kind: TriggerKind,
        label: &str,
        anchor: i64,
    ) -> TriggerOutcome {
        self.apply(lambda, TriggeredBy::Command, kind, label, anchor)
    }

    fn apply(
        &mut self,
        lambda: usize,
        by: TriggeredBy,
        kind: TriggerKind,
        label: &str,
        anchor: i64,
    ) -> TriggerOutcome {
        let Some(state) = self.lambdas.get_mut(lambda) else { return TriggerOutcome::Ignored };
        let (rules, label) = (state.rules, (by, label.to_owned()));
        match kind {
            TriggerKind::Start if state.started.contains(&label) => return TriggerOutcome::Ignored,
            TriggerKind::Start if state.started_by(by) >= STARTED_MAX => {
                return TriggerOutcome::TooManyStarted;
            }
            TriggerKind::Stop if !state.started.remove(&label) => return TriggerOutcome::Ignored,
            TriggerKind::Stop => {
                if state.started.is_empty() {
                    self.stop(lambda, anchor.saturating_add(rules.postroll_ns));
                }
                return TriggerOutcome::Stopped;
            }
            TriggerKind::Event | TriggerKind::Start if self.pending.len() >= WAITING_MAX => {
                return TriggerOutcome::TooManyWaiting;
            }
            TriggerKind::Event | TriggerKind::Start => {}
        }
        if by == TriggeredBy::Lambda {
            if state
                .opened_at
                .is_some_and(|last| last.abs_diff(anchor) < rules.cooldown_ns.unsigned_abs())
            {
                return TriggerOutcome::InCooldown;
            }
            state.opened_at = Some(anchor);
        }
        if kind == TriggerKind::Start {
            let is_covered = !state.started.is_empty();
            state.started.insert(label);
            if is_covered {
                return TriggerOutcome::Opened;
            }
        }
        let to = (kind == TriggerKind::Event).then(|| anchor.saturating_add(rules.postroll_ns));
        self.wait(Window {
            lambda,
            anchor,
            from: anchor.saturating_sub(rules.preroll_ns),
            to,
            windows: 1,
        });
        TriggerOutcome::Opened
    }

    /// Joins overlapping windows of one lambda, so that a lambda that triggers in every wake does
    /// not fill the memory.
    fn wait(&mut self, window: Window) {
        let same = |other: &&mut Window| {
            other.lambda == window.lambda
                && other.to.is_some()
                && window.to.is_some()
                && other.touches(&window)
        };
        match self.pending.iter_mut().find(same) {
            Some(other) => {
                other.anchor = other.anchor.min(window.anchor);
                other.from = other.from.min(window.from);
                other.to = other.to.max(window.to);
                other.windows += 1;
            }
            None => self.pending.push(window),
        }
    }

    fn stop(&mut self, lambda: usize, to: i64) {
        // A late stop cannot take back what is already written: its window ends now.
        let (horizon, written) = (self.horizon(), to.max(self.now));
        if self.open.as_mut().is_some_and(|open| open.stop(lambda, written, horizon)) {
            return;
        }
        if let Some(window) =
            self.pending.iter_mut().find(|window| window.lambda == lambda && window.to.is_none())
        {
            window.to = Some(to.max(window.from));
        }
    }

    /// Returns the next step; `None` until time advances or a trigger comes.
    pub fn step(&mut self) -> Option<WindowStep> {
        let (horizon, due) = (self.horizon(), self.now.saturating_sub(self.grace_ns));
        let Some(open) = &mut self.open else {
            let first = (0..self.pending.len()).min_by_key(|index| self.pending[*index].from)?;
            let windows = take_group(&mut self.pending, first);
            self.open = Group::new(&windows, horizon);
            return Some(WindowStep::Begin(windows));
        };
        if !self.pending.is_empty() {
            let mut fresh_from = None;
            let mut joined = Vec::new();
            while let Some(index) = self.pending.iter().position(|window| open.touches(window)) {
                let window = self.pending.swap_remove(index);
                let to = window.to.unwrap_or(i64::MAX).min(self.now);
                let fresh = open.first_uncovered(window.lambda, window.from, to);
                fresh_from = fresh
                    .map(|fresh| fresh_from.map_or(fresh, |from: i64| from.min(fresh)))
                    .or(fresh_from);
                open.add(&window, horizon);
                joined.push(window);
            }
            if !joined.is_empty() {
                return Some(WindowStep::Join { windows: joined, fresh_from });
            }
            if let Some(index) = self
                .pending
                .iter()
                .position(|window| window.to.is_some_and(|to| to < open.begin && to < due))
            {
                let windows = take_group(&mut self.pending, index);
                let group = Group::new(&windows, horizon)?;
                return Some(WindowStep::Late(windows, Box::new(group)));
            }
        }
        let limit = open.from.saturating_add(self.max_length_ns);
        if limit < due && limit < open.to {
            let before = Box::new(open.clone());
            open.roll(limit);
            return Some(WindowStep::Roll { boundary: limit, before });
        }
        if due > open.to.saturating_add(self.longest_preroll_ns) {
            return self.open.take().map(|group| WindowStep::Finish(Box::new(group)));
        }
        None
    }

    /// Moves the begin of the open clip to `from`, as there is nothing to write before. Without
    /// this, a jump in time would cost a step for each clip that could have been in between.
    pub fn slide(&mut self, from: i64) {
        if let Some(open) = &mut self.open {
            open.from = open.from.max(from.min(open.to));
        }
    }

    /// Ends a lambda at `at`, and the recordings that it started, but not those of commands.
    /// Returns whether it had started any.
    pub fn end(&mut self, lambda: usize, at: i64) -> bool {
        let Some(state) =
            self.lambdas.get_mut(lambda).filter(|state| state.started_by(TriggeredBy::Lambda) > 0)
        else {
            return false;
        };
        state.started.retain(|(by, _)| *by != TriggeredBy::Lambda);
        if state.started.is_empty() {
            let to = at.saturating_add(state.rules.postroll_ns);
            self.stop(lambda, to);
        }
        true
    }

    /// Delays the end of clips by `grace_ns`, for late wakes.
    pub fn set_grace(&mut self, grace_ns: i64) {
        self.grace_ns = grace_ns;
    }

    pub fn grow_length(&mut self, max_length_ns: i64) {
        self.max_length_ns = max_length_ns;
    }

    /// Drops the waiting windows, and returns their number.
    pub fn forget_waiting(&mut self) -> u64 {
        self.pending.drain(..).map(|window| window.windows).sum()
    }

    /// Closes the open group at the end of the recording, and ends all recordings that were
    /// started.
    pub fn close(&mut self) -> Option<Group> {
        self.lambdas.iter_mut().for_each(|lambda| lambda.started.clear());
        self.open.take()
    }
}

impl WindowLambda {
    fn started_by(&self, by: TriggeredBy) -> usize {
        self.started.iter().filter(|(origin, _)| *origin == by).count()
    }
}

/// Removes the window at `index` and all that are connected with it.
fn take_group(pending: &mut Vec<Window>, index: usize) -> Vec<Window> {
    let mut group = vec![pending.swap_remove(index)];
    while let Some(index) =
        pending.iter().position(|window| group.iter().any(|other| other.touches(window)))
    {
        group.push(pending.swap_remove(index));
    }
    group
}

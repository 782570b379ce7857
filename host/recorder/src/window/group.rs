//! Groups of windows that overlap, and so share a clip.

use super::Window;
use super::intervals::Intervals;

/// Windows connected by overlaps: the content of one clip, or of several in turn if it is too long
/// for one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Group {
    /// Begin of the earliest window.
    pub begin: i64,
    /// Begin of the clip that is being written: later than `begin` once a clip of this group was
    /// full.
    pub from: i64,
    /// End of the latest window, inclusive; [`i64::MAX`] while one waits for its stop.
    pub to: i64,
    /// The lambda and the anchor that come first: they name the clip.
    pub first: (usize, i64),
    /// Lambdas with windows here, in the order in which they came.
    pub lambdas: Vec<usize>,
    /// The intervals of each lambda's windows; by lambda, shorter than the list of lambdas if the
    /// last ones have none.
    shares: Vec<Share>,
}

/// One lambda's part of a group.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
struct Share {
    ended: Intervals,
    /// Begin of the window that waits for its stop.
    started: Option<i64>,
    windows: u64,
}

impl Share {
    fn covers(&self, at: i64) -> bool {
        self.started.is_some_and(|from| from <= at) || self.ended.contains(at)
    }
}

impl Group {
    /// Creates a group of at least one window; `None` without windows. Instants before `horizon`
    /// will not be queried.
    pub(super) fn new(windows: &[Window], horizon: i64) -> Option<Group> {
        let first = windows.iter().min_by_key(|window| (window.anchor, window.lambda))?;
        let from = windows.iter().map(|window| window.from).min()?;
        let mut group = Group {
            begin: from,
            from,
            to: i64::MIN,
            first: (first.lambda, first.anchor),
            lambdas: Vec::new(),
            shares: Vec::new(),
        };
        windows.iter().for_each(|window| group.add(window, horizon));
        Some(group)
    }

    pub(super) fn add(&mut self, window: &Window, horizon: i64) {
        if self.shares.len() <= window.lambda {
            self.shares.resize_with(window.lambda + 1, Share::default);
        }
        let share = &mut self.shares[window.lambda];
        match window.to {
            Some(to) => share.ended.insert(window.from, to, horizon),
            None => share.started = Some(window.from),
        }
        share.windows += window.windows;
        if !self.lambdas.contains(&window.lambda) {
            self.lambdas.push(window.lambda);
        }
        // The clip that is being written reaches back as well: the previous ones are finished.
        if window.from < self.begin {
            self.begin = window.from;
            self.from = window.from;
        }
        self.to = self.to.max(window.to.unwrap_or(i64::MAX));
    }

    /// Ends the window of `lambda` that waits for its stop; `false` if there is none.
    pub(super) fn stop(&mut self, lambda: usize, to: i64, horizon: i64) -> bool {
        let Some(share) = self.shares.get_mut(lambda) else { return false };
        let Some(from) = share.started.take() else { return false };
        share.ended.insert(from, to.max(from), horizon);
        let end = |share: &Share| {
            if share.started.is_some() { Some(i64::MAX) } else { share.ended.end() }
        };
        self.to = self.shares.iter().filter_map(end).max().unwrap_or(to);
        true
    }

    /// Continues in a next clip, after `boundary`.
    pub fn roll(&mut self, boundary: i64) {
        self.from = boundary.saturating_add(1);
        for share in &mut self.shares {
            share.windows = share.ended.beyond(boundary) + u64::from(share.started.is_some());
        }
        let shares = &self.shares;
        self.lambdas.retain(|lambda| shares[*lambda].windows > 0);
    }

    /// Returns whether a window shares an instant with this group.
    pub(super) fn touches(&self, window: &Window) -> bool {
        window.from <= self.to && window.to.is_none_or(|to| self.begin <= to)
    }

    /// Returns whether a window of `lambda` contains `at`.
    pub fn covers(&self, lambda: usize, at: i64) -> bool {
        self.shares.get(lambda).is_some_and(|share| share.covers(at))
    }

    /// Returns the first instant of `from..=to` that no window of `lambda` contains.
    pub(super) fn first_uncovered(&self, lambda: usize, from: i64, to: i64) -> Option<i64> {
        if from > to {
            return None;
        }
        match self.shares.get(lambda) {
            Some(share) if share.started.is_some_and(|started| started <= from) => None,
            Some(share) => share.ended.first_outside(from, to),
            None => Some(from),
        }
    }

    /// Returns the number of windows of `lambda` in the current clip. In a clip that continues
    /// another, overlapping windows count as one.
    pub fn windows(&self, lambda: usize) -> u64 {
        self.shares.get(lambda).map_or(0, |share| share.windows)
    }

    pub fn waits_for_stop(&self) -> bool {
        self.to == i64::MAX
    }
}

//! The time that the models of a lambda may run, by the rate that it has stated: a token bucket.

/// A lambda may take this multiple of its stated time: that varies, and others run beside it.
pub(crate) const TOLERANCE: u64 = 2;
/// A lambda is beyond its demand for this multiple of the time of a run that was.
pub(crate) const BEYOND: u64 = 10;
/// A lambda states its busiest minute: that much may run at once, in ns, or one wake's time if that
/// is more.
const BURST_NS: u64 = 60_000_000_000;

#[derive(Debug, Default)]
pub(crate) struct RunPace {
    /// Time of models in a wake, and from wake to wake, in ns; `None` if no rate is stated.
    pub(crate) stated: Option<[u64; 2]>,
    /// Time at which the bucket is full again, in ns. It fills by the time of `TOLERANCE` wakes in
    /// that from wake to wake.
    full_at_ns: u64,
    /// Time at which it was last full, and the time of all runs since, in ns.
    since_ns: u64,
    ran_ns: u64,
}

impl RunPace {
    /// Returns the time from which the lambda may run models, in ns.
    pub(crate) fn begins_at(&self) -> u64 {
        let burst = self.stated.map_or(u64::MAX, |[_, period]| BURST_NS.max(period / TOLERANCE));
        self.full_at_ns.saturating_sub(burst)
    }

    /// Takes a run that has ended `now` out of the bucket.
    pub(crate) fn charge(&mut self, ran_ns: u64, now_ns: u64) {
        let Some([time, period]) = self.stated else { return };
        let began = now_ns.saturating_sub(ran_ns);
        if self.full_at_ns <= began {
            (self.full_at_ns, self.since_ns, self.ran_ns) = (began, began, 0);
        }
        self.ran_ns = self.ran_ns.saturating_add(ran_ns);
        let allowed = u128::from(time.saturating_mul(TOLERANCE).max(1));
        let fills = u64::try_from(u128::from(ran_ns) * u128::from(period) / allowed);
        // A busy machine may have made one run long.
        let most = ran_ns.saturating_mul(BEYOND).saturating_add(period);
        self.full_at_ns = self.full_at_ns.saturating_add(fills.map_or(most, |it| it.min(most)));
    }

    /// Returns why the lambda may not run models at this time, if so.
    pub(crate) fn refusal(&self, now_ns: u64) -> Option<String> {
        let [time, period] = self.stated.filter(|_| self.begins_at() > now_ns)?;
        let [time, ran] = [time, self.ran_ns].map(|ns| ns as f64 / 1e6);
        let [period, since] = [period, now_ns - self.since_ns].map(|ns| ns as f64 / 1e9);
        Some(format!(
            "waits, as its lambda is beyond its `[demand]` ({time:.1} ms of models in a wake and a \
             wake every {period:.1} s are stated, and {ran:.1} ms ran in {since:.1} s: state what \
             it needs, or run models less often)"
        ))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn twice_what_is_stated_for_a_minute_may_run_at_once_and_one_long_run_is_forgiven() {
        const MS: u64 = 1_000_000;
        let stated = Some([50 * MS, 10_000 * MS]);
        let mut pace = RunPace { stated, ..RunPace::default() };
        let (mut runs, mut now) = (0, 0);
        while pace.begins_at() <= now {
            (runs, now) = (runs + 1, now + 50 * MS);
            pace.charge(50 * MS, now);
        }
        // 6 wakes in a minute are stated. Of each run, the bucket recovers in 5 s.
        assert_eq!((runs, pace.begins_at()), (13, 5000 * MS));
        let mut pace = RunPace { stated, ..RunPace::default() };
        pace.charge(5000 * MS, 5000 * MS);
        assert_eq!(pace.begins_at(), 0, "by its rate alone, 440 s");
    }
}

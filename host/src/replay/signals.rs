//! Collects the data of a replay's report beside its results: values that the lambda read, costs of
//! its wakes, and camera pictures.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use gleaner_lambda::Decision;
use gleaner_lambda::manifest::ConfigValue;
use gleaner_lambda::signals::{Bin, Distribution, Signals};
use hdrhistogram::Histogram;

use super::pictures::{RecordedCamera, TriggerPictures};
use crate::api::curves::Curves;
use crate::api::data::{Topic, record_curves};
use crate::guest::Totals;
use crate::session_setup::{Output, OutputError};

const BINS_PER_DECADE: f64 = 12.0;

/// Largest value, to which greater ones are clamped: 13 days in ns, and more fuel than a wake may
/// have.
const MOST: u64 = 1 << 50;

pub(super) struct SignalCollector {
    curves: Arc<Curves>,
    run: Histogram<u64>,
    fuel: Histogram<u64>,
    pictures: TriggerPictures,
}

impl SignalCollector {
    /// A collector for a lambda over these inputs; create it before `init`.
    pub(super) fn of(inputs: &[Arc<Topic>], camera: Option<Arc<RecordedCamera>>) -> Self {
        let empty = || Histogram::new_with_max(MOST, 3).expect("three digits are valid");
        let pictures = TriggerPictures::new(inputs, camera);
        Self { curves: record_curves(inputs), run: empty(), fuel: empty(), pictures }
    }

    pub(super) fn wake(&mut self, decision: &Decision) {
        self.run.saturating_record(decision.run_ns);
        if let Some(fuel) = decision.fuel {
            self.fuel.saturating_record(fuel);
        }
        self.pictures.wake(decision);
    }

    /// Curves of the values that the lambda reads in this process.
    pub(super) fn curves(&self) -> &Curves {
        &self.curves
    }

    /// Writes the signals into the folder `out`, which is that of `output`.
    ///
    /// # Errors
    ///
    /// [`OutputError`] of the first file that cannot be written. If pictures cannot be written, the
    /// signals are still written.
    pub(super) fn write(
        self,
        out: &Path,
        output: &Output,
        config: &[(String, ConfigValue)],
        totals: Totals,
    ) -> Result<(), OutputError> {
        let Totals { curves, curves_omitted, .. } = totals;
        let triggered = self.pictures.wakes();
        let (written, failed) = match self.pictures.write(out) {
            Ok(written) => (written, Ok(())),
            // The signals are useful without pictures.
            Err(error) => ((Vec::new(), triggered), Err(error)),
        };
        let (pictures, pictures_omitted) = written;
        output.signals(&Signals {
            config: config.iter().cloned().collect::<BTreeMap<_, _>>(),
            curves,
            curves_omitted,
            run_ns: spread(&self.run),
            fuel: (!self.fuel.is_empty()).then(|| spread(&self.fuel)),
            pictures,
            pictures_omitted,
        })?;
        failed
    }
}

fn spread(of: &Histogram<u64>) -> Distribution {
    // A histogram rounds to three digits. Rounded up, a wake could seem to exceed its limit.
    let down = |value: u64| of.lowest_equivalent(value);
    let mut bins: Vec<Bin> = Vec::new();
    for value in of.iter_recorded() {
        let (from, to) = bin(down(value.value_iterated_to()));
        match bins.last_mut().filter(|bin| bin.from == from) {
            Some(bin) => bin.count += value.count_since_last_iteration(),
            None => bins.push(Bin { from, to, count: value.count_since_last_iteration() }),
        }
    }
    Distribution {
        count: of.len(),
        min: of.min(),
        p50: down(of.value_at_quantile(0.5)),
        p90: down(of.value_at_quantile(0.9)),
        p99: down(of.value_at_quantile(0.99)),
        max: down(of.max()),
        bins,
    }
}

/// The bin of `value`: lower bound, inclusive, and upper bound. Each number below 10 has its own.
fn bin(value: u64) -> (u64, u64) {
    if value < 10 {
        return (value, value + 1);
    }
    let step = ((value as f64).log10() * BINS_PER_DECADE).floor();
    let edge = |step: f64| 10_f64.powf(step / BINS_PER_DECADE).ceil() as u64;
    // Rounding may put an edge just above its own value.
    let step = if edge(step) > value { step - 1.0 } else { step };
    (edge(step), edge(step + 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bins_are_adjacent_and_contain_their_values() {
        let mut last = bin(0);
        assert_eq!(last, (0, 1));
        for value in 1..2_000_000 {
            let (from, to) = bin(value);
            assert!((from..to).contains(&value), "{value} is not in {from}..{to}");
            assert!((from, to) == last || from == last.1, "{last:?}, then {from}..{to}");
            last = (from, to);
        }
    }

    #[test]
    fn every_wake_is_in_one_bin() {
        let mut signals = SignalCollector::of(&[], None);
        for run_ns in [0, 1, 9, 10, 11, 500, 500, 1_000_000] {
            signals.run.saturating_record(run_ns);
        }
        let Distribution { count, min, max, bins, .. } = spread(&signals.run);
        assert_eq!((count, min, bins.iter().map(|bin| bin.count).sum::<u64>()), (8, 0, 8));
        assert!((999_000..=1_000_000).contains(&max), "{max}");
        assert!(bins.windows(2).all(|pair| pair[0].to <= pair[1].from));
    }
}

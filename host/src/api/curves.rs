//! Records the numbers that a lambda reads from its samples, for the report of a replay.
//!
//! This changes neither the data that a lambda sees nor its fuel. A live run records nothing.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_lambda::signals::{Curve, Signals};

use super::values::Column;

/// Maximum number of distinct paths without a curve that are counted.
const OMITTED_MAX: usize = 1000;

/// The curves of one lambda, for all of its inputs.
#[derive(Default)]
pub struct Curves(Mutex<CurveList>);

#[derive(Default)]
struct CurveList {
    kept: Vec<(CurveKey, Arc<CurveWriter>)>,
    omitted: BTreeSet<CurveKey>,
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct CurveKey {
    input: String,
    topic: String,
    path: String,
}

impl Curves {
    /// The writer of the curve of `path` in the messages of `topic`, which is `input`; `None` if
    /// there are too many.
    pub(super) fn curve_writer(
        &self,
        input: &str,
        topic: &str,
        path: String,
    ) -> Option<Arc<CurveWriter>> {
        let source = CurveKey { input: input.to_owned(), topic: topic.to_owned(), path };
        let mut list = self.lock();
        if let Some((_, writer)) = list.kept.iter().find(|(kept, _)| *kept == source) {
            return Some(Arc::clone(writer));
        }
        if list.kept.len() >= Signals::CURVES_MAX {
            if list.omitted.len() < OMITTED_MAX {
                list.omitted.insert(source);
            }
            return None;
        }
        let writer = Arc::new(CurveWriter::default());
        list.kept.push((source, Arc::clone(&writer)));
        Some(writer)
    }

    /// Returns the curves so far, without those of fields that are no numbers, and the number of
    /// fields that have no curve because there were too many.
    pub fn take(&self) -> (Vec<Curve>, u64) {
        let list = self.lock();
        let drawn =
            list.kept.iter().filter_map(|(source, writer)| writer.lock().curve(source)).collect();
        (drawn, list.omitted.len() as u64)
    }

    fn lock(&self) -> MutexGuard<'_, CurveList> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[derive(Default)]
pub(super) struct CurveWriter(Mutex<CurvePoints>);

/// Minimum and maximum of neighbouring samples. When a curve is full, each two points are merged: a
/// longer curve is coarser, evenly over its whole time.
#[derive(Default)]
struct CurvePoints {
    last_ns: Option<i64>,
    samples: u64,
    non_finite: u64,
    per_point: u64,
    /// Number of samples in the last point.
    in_last: u64,
    at_ns: Vec<i64>,
    min: Vec<f64>,
    max: Vec<f64>,
}

impl CurveWriter {
    /// Adds `value` of the sample of `at_ns`, unless this sample or a newer one was added before.
    pub(super) fn number(&self, at_ns: i64, value: f64) {
        self.lock().add(at_ns, value);
    }

    /// Adds a column, whose samples are oldest first.
    pub(super) fn column(&self, column: &Column) {
        let mut points = self.lock();
        let new = column
            .at_ns
            .partition_point(|at_ns| points.last_ns.is_some_and(|last_ns| *at_ns <= last_ns));
        for (at_ns, value) in column.at_ns.iter().zip(&column.values).skip(new) {
            points.add(*at_ns, *value);
        }
    }

    fn lock(&self) -> MutexGuard<'_, CurvePoints> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl CurvePoints {
    fn add(&mut self, at_ns: i64, value: f64) {
        if self.last_ns.is_some_and(|last_ns| at_ns <= last_ns) {
            return;
        }
        self.last_ns = Some(at_ns);
        self.samples += 1;
        if !value.is_finite() {
            self.non_finite += 1;
            return;
        }
        if let (Some(min), Some(max)) = (self.min.last_mut(), self.max.last_mut())
            && self.in_last < self.per_point
        {
            (*min, *max) = (min.min(value), max.max(value));
            self.in_last += 1;
            return;
        }
        if self.at_ns.len() >= Signals::POINTS_MAX {
            self.halve();
        }
        self.per_point = self.per_point.max(1);
        self.in_last = 1;
        self.at_ns.push(at_ns);
        self.min.push(value);
        self.max.push(value);
    }

    /// Merges each two points into one. All points are full then.
    fn halve(&mut self) {
        let half = self.at_ns.len() / 2;
        for point in 0..half {
            self.at_ns[point] = self.at_ns[2 * point];
            self.min[point] = self.min[2 * point].min(self.min[2 * point + 1]);
            self.max[point] = self.max[2 * point].max(self.max[2 * point + 1]);
        }
        self.at_ns.truncate(half);
        self.min.truncate(half);
        self.max.truncate(half);
        self.per_point *= 2;
    }

    fn curve(&self, source: &CurveKey) -> Option<Curve> {
        let CurveKey { input, topic, path } = source.clone();
        let Self { samples, non_finite, per_point, at_ns, min, max, .. } = self;
        (*samples > 0).then(|| Curve {
            input,
            topic,
            path,
            samples: *samples,
            non_finite: *non_finite,
            per_point: *per_point,
            at_ns: at_ns.clone(),
            min: min.clone(),
            max: max.clone(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source() -> CurveKey {
        CurveKey { input: "imu".to_owned(), topic: "/imu".to_owned(), path: "x".to_owned() }
    }

    #[test]
    fn a_long_curve_gets_coarser_and_loses_no_extreme() {
        let writer = CurveWriter::default();
        let samples = 5 * Signals::POINTS_MAX as i64 + 17;
        for n in 0..samples {
            writer.number(10 * n, if n == 7777 { 99.0 } else { f64::from((n % 3) as i32) });
        }
        let curve = writer.lock().curve(&source()).unwrap();
        assert_eq!((curve.samples, curve.per_point), (samples as u64, 8));
        assert_eq!(curve.at_ns.len(), (samples as usize).div_ceil(8));
        assert!(curve.at_ns.len() <= Signals::POINTS_MAX);
        let highest = curve.max.iter().position(|max| *max == 99.0).unwrap();
        assert_eq!(highest, 7777 / 8);
        assert!(curve.at_ns.iter().enumerate().all(|(point, at_ns)| *at_ns == 80 * point as i64));
        assert!(curve.min.iter().all(|min| *min == 0.0));
    }

    #[test]
    fn a_sample_that_is_read_twice_is_drawn_once() {
        let writer = CurveWriter::default();
        writer.column(&Column { at_ns: vec![1, 2, 3], values: vec![1.0, 2.0, 3.0] });
        writer.column(&Column { at_ns: vec![2, 3, 4], values: vec![2.0, 3.0, 4.0] });
        writer.number(4, 4.0);
        writer.number(1, 1.0);
        let curve = writer.lock().curve(&source()).unwrap();
        assert_eq!(
            (curve.at_ns, curve.max, curve.samples),
            (vec![1, 2, 3, 4], vec![1.0, 2.0, 3.0, 4.0], 4)
        );
    }

    #[test]
    fn non_finite_values_are_counted_and_not_drawn() {
        let writer = CurveWriter::default();
        for (at_ns, value) in [(1, f64::NAN), (2, f64::INFINITY), (3, 5.0)] {
            writer.number(at_ns, value);
        }
        let curve = writer.lock().curve(&source()).unwrap();
        assert_eq!((curve.samples, curve.non_finite, curve.at_ns), (3, 2, vec![3]));
        assert_eq!(CurveWriter::default().lock().curve(&source()), None);
    }
}

//! What a lambda read of its samples, number by number, for the report of a replay.
//!
//! Nothing here changes what a lambda sees or what it costs in fuel. Live nobody asks for it, and
//! nothing is kept.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_lambda::signals::{Curve, Signals};

use super::data::{Column, Topic};

/// Paths beyond those that have a curve which are told apart: more are not counted.
const LEFT_OUT_MAX: usize = 1000;

/// The curves of one lambda, for all of its inputs.
#[derive(Default)]
pub struct Curves(Mutex<List>);

#[derive(Default)]
struct List {
    kept: Vec<(Source, Arc<Pen>)>,
    left_out: BTreeSet<Source>,
}

/// What a curve is of.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Source {
    input: String,
    topic: String,
    path: String,
}

impl Curves {
    /// Curves of what is read of `inputs` from now on, of fields that are compiled from now on.
    pub fn of(inputs: &[Arc<Topic>]) -> Arc<Self> {
        let curves = Arc::new(Self::default());
        for topic in inputs {
            topic.keep(&curves);
        }
        curves
    }

    /// The curve of `path` in the messages of `topic`; none if there are too many.
    pub(super) fn pen(&self, topic: &Topic, path: String) -> Option<Arc<Pen>> {
        let source =
            Source { input: topic.name().to_owned(), topic: topic.ros_topic().to_owned(), path };
        let mut list = self.lock();
        if let Some((_, pen)) = list.kept.iter().find(|(kept, _)| *kept == source) {
            return Some(Arc::clone(pen));
        }
        if list.kept.len() >= Signals::CURVES_MAX {
            if list.left_out.len() < LEFT_OUT_MAX {
                list.left_out.insert(source);
            }
            return None;
        }
        let pen = Arc::new(Pen::default());
        list.kept.push((source, Arc::clone(&pen)));
        Some(pen)
    }

    /// The curves so far, without those of what is no number; and how many fields have none, since
    /// there were too many.
    pub fn take(&self) -> (Vec<Curve>, u64) {
        let list = self.lock();
        let drawn = list.kept.iter().filter_map(|(source, pen)| pen.lock().curve(source)).collect();
        (drawn, list.left_out.len() as u64)
    }

    fn lock(&self) -> MutexGuard<'_, List> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Draws one curve.
#[derive(Default)]
pub(super) struct Pen(Mutex<Points>);

/// Sums of neighbouring samples. When there is no room for a further one, each two become one: a
/// curve gets coarser as it gets longer, evenly over all of its time.
#[derive(Default)]
struct Points {
    last_ns: Option<i64>,
    samples: u64,
    non_finite: u64,
    per_point: u64,
    /// Samples in the last point.
    in_last: u64,
    at_ns: Vec<i64>,
    min: Vec<f64>,
    max: Vec<f64>,
}

impl Pen {
    /// The number of the sample of `at_ns` is `value`. What was read before, or of an older sample,
    /// is no news.
    pub(super) fn number(&self, at_ns: i64, value: f64) {
        self.lock().add(at_ns, value);
    }

    /// The same for a column, whose samples are oldest first.
    pub(super) fn column(&self, column: &Column) {
        let mut points = self.lock();
        let new = column
            .at_ns
            .partition_point(|at_ns| points.last_ns.is_some_and(|last_ns| *at_ns <= last_ns));
        for (at_ns, value) in column.at_ns.iter().zip(&column.values).skip(new) {
            points.add(*at_ns, *value);
        }
    }

    fn lock(&self) -> MutexGuard<'_, Points> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Points {
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

    /// Each two points become one. All are full then.
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

    fn curve(&self, source: &Source) -> Option<Curve> {
        let Source { input, topic, path } = source.clone();
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

    fn source() -> Source {
        Source { input: "imu".to_owned(), topic: "/imu".to_owned(), path: "x".to_owned() }
    }

    #[test]
    fn a_long_curve_gets_coarser_and_loses_no_extreme() {
        let pen = Pen::default();
        let samples = 5 * Signals::POINTS_MAX as i64 + 17;
        for n in 0..samples {
            pen.number(10 * n, if n == 7777 { 99.0 } else { f64::from((n % 3) as i32) });
        }
        let curve = pen.lock().curve(&source()).unwrap();
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
        let pen = Pen::default();
        pen.column(&Column { at_ns: vec![1, 2, 3], values: vec![1.0, 2.0, 3.0] });
        pen.column(&Column { at_ns: vec![2, 3, 4], values: vec![2.0, 3.0, 4.0] });
        pen.number(4, 4.0);
        pen.number(1, 1.0);
        let curve = pen.lock().curve(&source()).unwrap();
        assert_eq!(
            (curve.at_ns, curve.max, curve.samples),
            (vec![1, 2, 3, 4], vec![1.0, 2.0, 3.0, 4.0], 4)
        );
    }

    #[test]
    fn what_is_not_finite_is_counted_and_not_drawn() {
        let pen = Pen::default();
        for (at_ns, value) in [(1, f64::NAN), (2, f64::INFINITY), (3, 5.0)] {
            pen.number(at_ns, value);
        }
        let curve = pen.lock().curve(&source()).unwrap();
        assert_eq!((curve.samples, curve.non_finite, curve.at_ns), (3, 2, vec![3]));
        assert_eq!(Pen::default().lock().curve(&source()), None);
    }
}

//! The promises of round trips, against a bare reader and against programs without Gleaner.

use gleaner_bench::{Figure, Series, SeriesGroup, quantile};

use super::node::NodeSide;
use super::workload::Workload;

/// Most that an empty lambda takes, against the bare reader.
const EMPTY: f64 = 1.5;
/// Socket buffer from which on images are not lost, in bytes.
const TUNED: u64 = 4 << 20;

/// Statistics that are compared: name, value, and the goal of the ratio.
type Ratio = (&'static str, fn(&[f64]) -> f64, f64);

const OF_FFT: [Ratio; 4] =
    [("median", median, 0.5), ("mean", mean, 1.0), ("p95", p95, 1.0), ("p99", p99, 0.75)];

/// Adds the rows of a group.
pub(super) fn of_group(
    workload: Workload,
    granted: u64,
    group: &SeriesGroup,
    figures: &mut Vec<Figure>,
) {
    let of_images = if granted >= TUNED { 0.75 } else { 1.0 };
    let of_images: [Ratio; 2] = [("mean", mean, of_images), ("p95", p95, of_images)];
    let (others, ratios): (&[&str], &[Ratio]) = match workload {
        Workload::Empty | Workload::EmptyAwake => (&[NodeSide::BARE], &[("median", median, EMPTY)]),
        Workload::ImuFft | Workload::ImuSpectrum => {
            (&[NodeSide::STAND_IN, NodeSide::RCLPY], &OF_FFT)
        }
        Workload::Brake720 | Workload::Brake1080 => {
            (&[NodeSide::STAND_IN, NodeSide::RCLPY], &of_images)
        }
        Workload::Detector => return add_processed(group, figures),
    };
    for series in group.series.iter().filter(|series| is_ours(series)) {
        let Series { name, values, reception, .. } = series;
        let missing = reception.map_or(f64::NAN, |it| it.sent as f64 - it.answered as f64);
        let row = format!("{}, {name}: samples without an answer", group.name);
        figures.push(judged(&row, "samples", 0.0, missing, &[series]));
        let compared = group.series.iter().filter(|other| others.contains(&other.name.as_str()));
        for other in compared {
            for (what, of, goal) in ratios {
                let row = format!("{}, {name}, against the {}: {what}", group.name, other.name);
                let ratio = of(values) / of(&other.values);
                figures.push(judged(&row, "times", *goal, ratio, &[series, other]));
            }
        }
    }
}

/// Returns a row whose goal is `most` or less, if the series that it is of are valid.
fn judged(name: &str, unit: &str, most: f64, value: f64, of: &[&Series]) -> Figure {
    if of.iter().all(|series| series.invalid.is_empty()) {
        Figure::at_most(name, unit, most, &[value])
    } else {
        Figure::without_goal(name, unit, &[value])
    }
}

fn median(values: &[f64]) -> f64 {
    gleaner_bench::median(values).unwrap_or(f64::NAN)
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len() as f64
}

fn p95(values: &[f64]) -> f64 {
    quantile(values, 0.95)
}

fn p99(values: &[f64]) -> f64 {
    quantile(values, 0.99)
}

/// Adds the frames that each side processed. One that takes longer than a period of the camera
/// skips some.
fn add_processed(group: &SeriesGroup, figures: &mut Vec<Figure>) {
    for series in &group.series {
        let share = series.reception.map_or(f64::NAN, |it| it.answered as f64 / it.sent as f64);
        let row = format!("{}, {}: frames processed of published", group.name, series.name);
        figures.push(Figure::without_goal(&row, "%", &[100.0 * share]));
    }
}

/// Returns whether a series is that of a lambda in the product.
fn is_ours(series: &Series) -> bool {
    series.name.starts_with("lambda") && !series.name.ends_with("without checks")
}

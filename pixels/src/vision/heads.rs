//! Outputs of detectors: the objects that a model may have seen, and their boxes.

use crate::vision::layout::{BINS, BOX, DetectorLayout, Form, SIDES};

/// An object that passed the minimum score.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Candidate {
    pub(crate) score: f32,
    pub(crate) class: u32,
    pub(crate) anchor: usize,
}

/// Left, upper, right and lower edge in pixels of the tensor.
pub(crate) type Edges = [f32; 4];

/// Values of an output, which has as many as its form needs.
#[derive(Debug, Clone, Copy)]
pub(crate) struct DetectorHead<'a> {
    pub(crate) form: Form,
    pub(crate) values: &'a [f32],
    /// Size of the tensor in pixels.
    pub(crate) input: (u32, u32),
}

impl<'a> DetectorHead<'a> {
    /// Returns the objects of `classes`, which the model has, with at least `min_score`: of each
    /// anchor, the class with the highest score; of equal scores, the first class.
    ///
    /// # Errors
    ///
    /// A number that was read as a score, and is none.
    pub(crate) fn candidates(
        &self,
        classes: &Classes<'_>,
        min_score: f32,
    ) -> Result<Vec<Candidate>, f32> {
        let mut candidates = Vec::new();
        let mut add = |anchor, score: f32, class| {
            if score >= min_score {
                candidates.push(Candidate { score, class, anchor });
            }
        };
        if self.form.by_number {
            let (scores, classes) = self.best_by_number(classes)?;
            for (anchor, (score, class)) in scores.into_iter().zip(classes).enumerate() {
                add(anchor, score, class);
            }
            return Ok(candidates);
        }
        for (anchor, row) in self.values.chunks_exact(self.form.numbers).enumerate() {
            if let Some((score, class)) = self.best_of(row, classes, min_score)? {
                add(anchor, score, class);
            }
        }
        Ok(candidates)
    }

    /// Returns the highest score of a row of numbers, and its class.
    fn best_of(
        &self,
        row: &[f32],
        classes: &Classes<'_>,
        min_score: f32,
    ) -> Result<Option<(f32, u32)>, f32> {
        match self.form.layout {
            DetectorLayout::Ultralytics => classes.best(&row[BOX..]),
            DetectorLayout::Yolox => {
                let objectness = checked(row[BOX])?;
                // No score of a class exceeds 1, so most rows end here.
                if objectness < min_score {
                    return Ok(None);
                }
                let best = classes.best(&row[BOX + 1..])?;
                Ok(best.map(|(score, class)| (objectness * score, class)))
            }
            DetectorLayout::Nanodet => classes.best(&row[..row.len() - SIDES * BINS]),
            DetectorLayout::NmsFree => {
                let score = checked(row[BOX])?;
                let class = class_of(row[BOX + 1]).filter(|class| classes.contains(*class));
                Ok(class.map(|class| (score, class)))
            }
        }
    }

    /// Returns the highest score of each anchor and its class, where the scores of a class are next
    /// to each other. Only rows of wanted classes are read.
    fn best_by_number(&self, classes: &Classes<'_>) -> Result<(Vec<f32>, Vec<u32>), f32> {
        let mut best = vec![f32::NEG_INFINITY; self.form.anchors];
        let mut best_classes = vec![0; self.form.anchors];
        let mut refused = None;
        classes.each(self.form.classes.unwrap_or(0), |class| {
            let scores = self.row(BOX + class as usize);
            let mut are_scores = true;
            for ((best, best_class), score) in best.iter_mut().zip(&mut best_classes).zip(scores) {
                // All are written in any case: a CPU does that for several anchors at once.
                let is_better = *score > *best;
                *best = if is_better { *score } else { *best };
                *best_class = if is_better { class } else { *best_class };
                are_scores &= is_score(*score);
            }
            if !are_scores {
                refused = refused.or(scores.iter().copied().find(|score| !is_score(*score)));
            }
        });
        refused.map_or(Ok((best, best_classes)), Err)
    }

    /// Returns number `number` of all anchors, where these are next to each other.
    fn row(&self, number: usize) -> &'a [f32] {
        &self.values[number * self.form.anchors..][..self.form.anchors]
    }

    /// Returns the edges of the box of an anchor. They may be any numbers, even NaN.
    pub(crate) fn edges(&self, anchor: usize) -> Edges {
        let row = &self.values[anchor * self.form.numbers..][..self.form.numbers];
        let cell = || self.cell(anchor).unwrap_or((f32::NAN, f32::NAN, f32::NAN));
        match self.form.layout {
            DetectorLayout::Ultralytics if self.form.by_number => {
                around([0, 1, 2, 3].map(|number| self.row(number)[anchor]))
            }
            DetectorLayout::Ultralytics => around([row[0], row[1], row[2], row[3]]),
            DetectorLayout::Yolox => {
                let (x, y, stride) = cell();
                let centre = [(row[0] + x) * stride, (row[1] + y) * stride];
                around([centre[0], centre[1], row[2].exp() * stride, row[3].exp() * stride])
            }
            DetectorLayout::Nanodet => {
                let (x, y, stride) = cell();
                let bins = &row[row.len() - SIDES * BINS..];
                let [left, top, right, bottom] =
                    [0, 1, 2, 3].map(|side| distance(&bins[side * BINS..][..BINS]) * stride);
                // Unlike in other detectors, the point of a cell is its corner.
                let (x, y) = (x * stride, y * stride);
                [x - left, y - top, x + right, y + bottom]
            }
            DetectorLayout::NmsFree => [row[0], row[1], row[2], row[3]],
        }
    }

    /// Returns column, row and stride of the cell with this index: the grids follow each other.
    fn cell(&self, anchor: usize) -> Option<(f32, f32, f32)> {
        let mut index = anchor;
        for stride in self.form.strides {
            let columns = self.input.0.div_ceil(*stride) as usize;
            let cells = columns * self.input.1.div_ceil(*stride) as usize;
            if index < cells {
                return Some(((index % columns) as f32, (index / columns) as f32, *stride as f32));
            }
            index -= cells;
        }
        None
    }
}

/// Wanted classes, which the model has.
#[derive(Debug, Clone)]
pub(crate) enum Classes<'a> {
    All,
    /// Sorted, each once.
    Some(&'a [u32]),
}

impl Classes<'_> {
    /// Calls `f` with each class below `count`, in ascending order.
    fn each(&self, count: u32, f: impl FnMut(u32)) {
        match self {
            Self::All => (0..count).for_each(f),
            Self::Some(classes) => classes.iter().copied().for_each(f),
        }
    }

    fn contains(&self, class: u32) -> bool {
        match self {
            Self::All => true,
            Self::Some(classes) => classes.binary_search(&class).is_ok(),
        }
    }

    /// Returns the highest of `scores`, which begin with class 0, and its class.
    fn best(&self, scores: &[f32]) -> Result<Option<(f32, u32)>, f32> {
        let mut best = None;
        let mut add = |score: f32, class: u32| -> Result<(), f32> {
            let score = checked(score)?;
            if best.is_none_or(|(highest, _)| score > highest) {
                best = Some((score, class));
            }
            Ok(())
        };
        match self {
            Self::All => {
                scores.iter().zip(0..).try_for_each(|(score, class)| add(*score, class))?;
            }
            Self::Some(classes) => classes
                .iter()
                .filter_map(|class| scores.get(*class as usize).map(|score| (*score, *class)))
                .try_for_each(|(score, class)| add(score, class))?,
        }
        Ok(best)
    }
}

/// Returns whether a number can be a score; NaN cannot.
fn is_score(value: f32) -> bool {
    (0.0..=1.0).contains(&value)
}

/// Returns a score, or the number as the error.
fn checked(value: f32) -> Result<f32, f32> {
    if is_score(value) { Ok(value) } else { Err(value) }
}

fn class_of(value: f32) -> Option<u32> {
    // Up to here a float has every integer.
    const LAST: f32 = 16_777_215.0;
    let class = value.round();
    (0.0..=LAST).contains(&class).then_some(class as u32)
}

/// Returns the edges of a box by centre and size.
fn around([x, y, width, height]: [f32; 4]) -> Edges {
    let (right, down) = (width / 2.0, height / 2.0);
    [x - right, y - down, x + right, y + down]
}

/// Returns the mean of the distribution over the distances 0, 1, 2 ..., whose logits are `bins`.
fn distance(bins: &[f32]) -> f32 {
    let highest = bins.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let (mut sum, mut weighted) = (0.0, 0.0);
    for (index, bin) in bins.iter().enumerate() {
        let weight = (bin - highest).exp();
        sum += weight;
        weighted += weight * index as f32;
    }
    weighted / sum
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_distance_is_the_mean_of_its_distribution() {
        assert_eq!(distance(&[0.0; 8]), 3.5);
        let mut bins = [-1000.0; 8];
        bins[5] = 80.0;
        assert_eq!(distance(&bins), 5.0);
        // ln 3: three quarters at 2, one at 1.
        let bins = [-900.0, 0.0, 3.0_f32.ln(), -900.0];
        assert!((distance(&bins) - 1.75).abs() < 1e-6);
        assert!(distance(&[f32::NAN; 8]).is_nan());
        assert!(distance(&[f32::INFINITY; 8]).is_nan());
    }

    #[test]
    fn a_class_is_a_whole_number() {
        assert_eq!(class_of(2.0), Some(2));
        assert_eq!(class_of(1.999_999), Some(2));
        for value in [-1.0, f32::NAN, f32::INFINITY, 1e20] {
            assert_eq!(class_of(value), None, "{value}");
        }
    }

    #[test]
    fn cells_of_all_grids_follow_each_other() {
        let form = DetectorLayout::Yolox.form(&[1, 84, 6], (64, 64)).unwrap();
        let head = DetectorHead { form, values: &[], input: (64, 64) };
        assert_eq!(head.cell(0), Some((0.0, 0.0, 8.0)));
        assert_eq!(head.cell(9), Some((1.0, 1.0, 8.0)));
        assert_eq!(head.cell(64), Some((0.0, 0.0, 16.0)));
        assert_eq!(head.cell(83), Some((1.0, 1.0, 32.0)));
        assert_eq!(head.cell(84), None);
    }
}

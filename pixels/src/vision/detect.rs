//! Detections: boxes in pixels of the frame from the output of a detector.

use std::cmp::Ordering;

use crate::vision::error::{VisionError, shape_text};
use crate::vision::heads::{Candidate, Classes, DetectorHead, Edges};
use crate::vision::layout::DetectorLayout;
use crate::vision::placement::Placed;

pub const MAX_DETECTIONS: u32 = 1024;

/// Largest number of objects whose boxes are compared; of more, those with the highest scores.
pub const MAX_CANDIDATES: usize = 4096;

/// Pixels below which all boxes of a model end that are not in pixels.
const NORMALISED_MAX: f32 = 2.0;

/// An output of a model, in row-major order.
#[derive(Debug, Clone, Copy)]
pub struct OutputView<'a> {
    pub shape: &'a [u32],
    pub values: &'a [f32],
}

/// Requirements for detections.
#[derive(Debug, Clone, PartialEq)]
pub struct Wanted {
    /// Classes to return, in any order; none for all.
    pub classes: Option<Vec<u32>>,
    /// Minimum score, 0 to 1.
    pub min_score: f32,
    /// Overlap (intersection over union), 0 to 1, above which the detection with the lower score of
    /// the same class is dropped. Detectors without NMS ignore it.
    pub max_iou: f32,
    /// Largest number of detections, clamped to [`MAX_DETECTIONS`].
    pub max_count: u32,
}

impl Wanted {
    /// Checks the numbers.
    ///
    /// # Errors
    ///
    /// [`VisionError::Fraction`].
    pub fn check(&self) -> Result<(), VisionError> {
        for (name, value) in [("min-score", self.min_score), ("max-iou", self.max_iou)] {
            if !(0.0..=1.0).contains(&value) {
                return Err(VisionError::Fraction { name, value });
            }
        }
        Ok(())
    }
}

/// An object that a detector found; its box is in pixels of the frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Detection {
    /// Class index of the model.
    pub class: u32,
    /// Confidence, 0 to 1.
    pub score: f32,
    /// Left edge.
    pub x: f32,
    /// Upper edge.
    pub y: f32,
    /// Width; above 0.
    pub width: f32,
    /// Height; above 0.
    pub height: f32,
}

/// Returns the objects in the outputs of a model, whose input was prepared with the result
/// `placed`, by score, highest first; of equal scores, in the order of the output.
///
/// An anchor of the model gives at most one object: of its best class among the wanted ones. Of
/// overlapping objects of a class, the one with the highest score stays. Boxes are clipped to the
/// frame; those without an area there, and those with a number that is not finite, are dropped.
/// At most the [`MAX_CANDIDATES`] best objects are compared, so that no output takes long.
///
/// # Errors
///
/// [`VisionError::OutputShape`] and [`VisionError::OutputLength`] for outputs that do not fit
/// `layout`, [`VisionError::Score`] and [`VisionError::Normalised`] for numbers that do not,
/// [`VisionError::Class`], [`VisionError::Fraction`], and [`VisionError::Placed`].
pub fn detect(
    layout: DetectorLayout,
    outputs: &[OutputView<'_>],
    placed: &Placed,
    wanted: &Wanted,
) -> Result<Vec<Detection>, VisionError> {
    wanted.check()?;
    if !placed.is_valid() {
        return Err(VisionError::Placed);
    }
    let head = head(layout, outputs, (placed.tensor_width, placed.tensor_height))?;
    let listed = wanted.classes.as_ref().map(|classes| {
        let mut classes = classes.clone();
        classes.sort_unstable();
        classes.dedup();
        classes
    });
    if let (Some(last), Some(classes)) =
        (listed.as_ref().and_then(|listed| listed.last()), head.form.classes)
        && *last >= classes
    {
        return Err(VisionError::Class { class: *last, classes });
    }
    let classes = listed.as_deref().map_or(Classes::All, Classes::Some);
    let layout = layout.name();
    let mut candidates = head
        .candidates(&classes, wanted.min_score)
        .map_err(|value| VisionError::Score { layout, value })?;
    keep_best(&mut candidates, MAX_CANDIDATES);
    if are_normalised(&head, &candidates) {
        return Err(VisionError::Normalised { layout, limit: NORMALISED_MAX });
    }
    Ok(select(&head, &candidates, placed, wanted))
}

/// Returns whether there are objects, and the boxes of all end where boxes from 0 to 1 do.
fn are_normalised(head: &DetectorHead<'_>, candidates: &[Candidate]) -> bool {
    if !matches!(head.form.layout, DetectorLayout::Ultralytics | DetectorLayout::NmsFree) {
        return false;
    }
    // Rows of padding have the score 0.
    let mut objects = candidates.iter().filter(|candidate| candidate.score > 0.0).peekable();
    let ends_early = |candidate: &Candidate| {
        let [_, _, right, bottom] = head.edges(candidate.anchor);
        right.max(bottom) <= NORMALISED_MAX
    };
    objects.peek().is_some() && objects.all(ends_early)
}

fn head<'a>(
    layout: DetectorLayout,
    outputs: &[OutputView<'a>],
    input: (u32, u32),
) -> Result<DetectorHead<'a>, VisionError> {
    let text = |output: &OutputView<'_>| shape_text(output.shape.iter().copied().map(Some));
    let [output] = outputs else {
        let shapes: Vec<String> = outputs.iter().take(8).map(text).collect();
        return Err(layout.refusal(input, shapes.join(", ")));
    };
    let form = layout.form(output.shape, input)?;
    if form.anchors.checked_mul(form.numbers) != Some(output.values.len()) {
        let found = output.values.len();
        return Err(VisionError::OutputLength { shape: text(output), found });
    }
    Ok(DetectorHead { form, values: output.values, input })
}

/// Sorts `candidates`, best first, after dropping all but the `count` best.
fn keep_best(candidates: &mut Vec<Candidate>, count: usize) {
    // No two are equal, so the order does not depend on the algorithm.
    let order = |a: &Candidate, b: &Candidate| -> Ordering {
        b.score.total_cmp(&a.score).then(a.anchor.cmp(&b.anchor))
    };
    if candidates.len() > count {
        candidates.select_nth_unstable_by(count, order);
        candidates.truncate(count);
    }
    candidates.sort_unstable_by(order);
}

/// An object that stays, for comparison with later ones.
struct KeptBox {
    class: u32,
    edges: Edges,
    area: f32,
}

/// Returns the detections among `candidates`, which are sorted.
fn select(
    head: &DetectorHead<'_>,
    candidates: &[Candidate],
    placed: &Placed,
    wanted: &Wanted,
) -> Vec<Detection> {
    let max_count = wanted.max_count.min(MAX_DETECTIONS) as usize;
    let overlaps_matter = head.form.layout != DetectorLayout::NmsFree;
    let mut kept: Vec<KeptBox> = Vec::new();
    let mut detections = Vec::new();
    for candidate in candidates {
        if detections.len() == max_count {
            break;
        }
        let edges = head.edges(candidate.anchor);
        let area = (edges[2] - edges[0]) * (edges[3] - edges[1]);
        let Some(detection) = in_frame(candidate, edges, placed) else {
            continue;
        };
        if !area.is_finite() {
            continue;
        }
        let new = KeptBox { class: candidate.class, edges, area };
        if overlaps_matter && kept.iter().any(|kept| overlap_exceeds(kept, &new, wanted.max_iou)) {
            continue;
        }
        kept.push(new);
        detections.push(detection);
    }
    detections
}

/// Returns whether both are of one class, and overlap by more than `max_iou`.
fn overlap_exceeds(a: &KeptBox, b: &KeptBox, max_iou: f32) -> bool {
    if a.class != b.class {
        return false;
    }
    let shared = |side: usize| {
        (a.edges[side + 2].min(b.edges[side + 2]) - a.edges[side].max(b.edges[side])).max(0.0)
    };
    let intersection = shared(0) * shared(1);
    let union = a.area + b.area - intersection;
    intersection > max_iou * union
}

/// Returns the detection of a box in pixels of the tensor, unless it has no area in the frame.
fn in_frame(
    candidate: &Candidate,
    [left, top, right, bottom]: Edges,
    placed: &Placed,
) -> Option<Detection> {
    // False for NaN as well.
    if !(left < right && top < bottom) {
        return None;
    }
    let (left, top) = placed.to_frame(left, top);
    let (right, bottom) = placed.to_frame(right, bottom);
    if ![left, top, right, bottom].iter().all(|edge| edge.is_finite()) {
        return None;
    }
    let (frame_width, frame_height) = (placed.frame_width as f32, placed.frame_height as f32);
    let (x, y) = (left.clamp(0.0, frame_width), top.clamp(0.0, frame_height));
    let width = right.clamp(0.0, frame_width) - x;
    let height = bottom.clamp(0.0, frame_height) - y;
    (width > 0.0 && height > 0.0).then_some(Detection {
        class: candidate.class,
        score: candidate.score,
        x,
        y,
        width,
        height,
    })
}

//! Families of detectors: the form of their input and of their output.

use gleaner_rules::text::shortened;

use crate::vision::error::{VisionError, shape_text};
use crate::vision::export::ExportNote;
use crate::vision::placement::Placement;
use crate::vision::prepare::Preprocess;

/// Numbers of a box, in front of the scores.
pub(crate) const BOX: usize = 4;

/// Sides of a box, each with a distribution of its distance in NanoDet-Plus.
pub(crate) const SIDES: usize = 4;

/// Distances in such a distribution, 0 to 7: `reg_max` is 7.
pub(crate) const BINS: usize = 8;

/// Numbers of a row of an NMS-free detector: box, score, class.
const NMS_FREE_ROW: u32 = 6;

const STRIDES: &[u32] = &[8, 16, 32];

/// Strides of the models P2 and P6 of Ultralytics, whose metadata has the largest.
const P2_STRIDES: &[u32] = &[4, 8, 16, 32];
const P6_STRIDES: &[u32] = &[8, 16, 32, 64];

const RT_DETR_ROWS: u32 = 300;

/// Anchors of a cell in YOLOv5 and YOLOv7.
const YOLO_V5_ANCHORS: u64 = 3;

/// The family of a detector, which determines its input and the meaning of its output.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum DetectorLayout {
    /// YOLOv8, YOLO11 and others of Ultralytics: one output [1, 4 + classes, anchors], or the same
    /// transposed, of boxes by centre and size in pixels of the tensor, and scores of the classes.
    /// There is an anchor for each cell of grids with strides 8, 16 and 32, and 4 or 64 if the
    /// metadata has the largest stride.
    Ultralytics,
    /// YOLOX, exported without `--decode_in_inference`: one output [1, cells, 5 + classes] of boxes
    /// relative to cells of grids with strides 8, 16 and 32, objectness, and scores of the classes.
    Yolox,
    /// YOLOv10 and others that need no NMS: one output [1, rows, 6] of corners in
    /// pixels of the tensor, score and class.
    NmsFree,
    /// NanoDet-Plus: one output [1, cells, classes + 32] of scores of the classes and distributions
    /// of four distances, for grids with strides 8, 16, 32 and 64, or without the last.
    Nanodet,
}

/// Form of the output of a detector, after all its lengths have been checked.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Form {
    pub(crate) layout: DetectorLayout,
    /// Cells, anchors or rows.
    pub(crate) anchors: usize,
    /// Numbers of an anchor.
    pub(crate) numbers: usize,
    /// Number of classes; none if the model may return any.
    pub(crate) classes: Option<u32>,
    /// True if the numbers of an anchor are not next to each other, but the anchors are.
    pub(crate) by_number: bool,
    pub(crate) strides: &'static [u32],
}

impl DetectorLayout {
    pub const ALL: [Self; 4] = [Self::Ultralytics, Self::Yolox, Self::NmsFree, Self::Nanodet];

    /// Returns the name in a manifest.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Ultralytics => "ultralytics",
            Self::Yolox => "yolox",
            Self::NmsFree => "nms-free",
            Self::Nanodet => "nanodet",
        }
    }

    /// Returns the layout of this name.
    ///
    /// # Errors
    ///
    /// [`VisionError::UnknownLayout`] with the list of known names.
    pub fn from_name(name: &str) -> Result<Self, VisionError> {
        Self::ALL.into_iter().find(|layout| layout.name() == name).ok_or_else(|| {
            VisionError::UnknownLayout {
                name: shortened(name),
                known: Self::ALL.map(Self::name).join(", "),
            }
        })
    }

    /// Returns the conversion of frames to the input of a model of this family, whose shape is
    /// `input`: [1, 3, height, width] or [1, height, width, 3].
    ///
    /// Sources: `demo/ONNXRuntime` of YOLOX, `ultralytics/data/augment.py`, and the configurations
    /// `nanodet-plus-m*` of NanoDet, each as its models are trained.
    ///
    /// # Errors
    ///
    /// [`VisionError::InputShape`] for another shape, [`VisionError::DynamicInput`] for a side that
    /// is not fixed, and [`VisionError::TensorSize`].
    pub fn preprocess(self, input: &[Option<u32>]) -> Result<Preprocess, VisionError> {
        let layout = self.name();
        let found = || shape_text(input.iter().copied());
        let (height, width, channels_last) = match *input {
            [None | Some(1), Some(3), height, width] => (height, width, false),
            [None | Some(1), height, width, Some(3)] => (height, width, true),
            _ => return Err(VisionError::InputShape { layout, found: found() }),
        };
        let (Some(height), Some(width)) = (height, width) else {
            return Err(VisionError::DynamicInput { layout, found: found() });
        };
        let (placement, bgr, scale) = match self {
            Self::Ultralytics | Self::NmsFree => (Placement::Centre, false, 1.0 / 255.0),
            Self::Yolox => (Placement::Corner, true, 1.0),
            Self::Nanodet => (Placement::Stretch, true, 1.0),
        };
        let (mean, deviation) = match self {
            Self::Nanodet => ([103.53, 116.28, 123.675], [57.375, 57.12, 58.395]),
            _ => ([0.0; 3], [1.0; 3]),
        };
        let how = Preprocess {
            width,
            height,
            placement,
            fill: 114,
            bgr,
            channels_last,
            bytes: false,
            scale,
            mean,
            deviation,
        };
        how.check()?;
        Ok(how)
    }

    /// Checks the outputs of a model of this family, whose input has `width` x `height` pixels and
    /// whose export wrote `note`, and returns the number of its classes, if the shape shows it.
    /// Lengths that are not fixed pass; [`detect`](crate::vision::detect()) checks them for each
    /// result.
    ///
    /// # Errors
    ///
    /// [`VisionError::OtherModel`] for one that is known to be of another family, and
    /// [`VisionError::OutputShape`] with the shapes of both.
    pub fn check(
        self,
        outputs: &[&[Option<u32>]],
        (width, height): (u32, u32),
        note: &ExportNote,
    ) -> Result<Option<u32>, VisionError> {
        let fixed = |shape: &[Option<u32>]| shape.iter().copied().collect::<Option<Vec<u32>>>();
        let shapes = outputs.iter().filter_map(|shape| fixed(shape)).collect::<Vec<_>>();
        let of_shape = || self.foreign_shape(&shapes, (width, height)).map(str::to_owned);
        if let Some(kind) = note.foreign_kind().or_else(of_shape) {
            return Err(VisionError::OtherModel { layout: self.name(), kind });
        }
        let is_proven = |form: &Form| {
            self != Self::Ultralytics
                || form.strides == STRIDES
                || note.stride == form.strides.last().copied()
        };
        let form = match *outputs {
            [shape] => match fixed(shape) {
                Some(shape) => self.form_of(&shape, (width, height)).filter(is_proven),
                None if matches!(*shape, [None | Some(1), _, _]) => return Ok(None),
                None => None,
            },
            _ => None,
        };
        let texts = outputs.iter().take(8).map(|shape| shape_text(shape.iter().copied()));
        form.map(|form| form.classes)
            .ok_or_else(|| self.refusal((width, height), texts.collect::<Vec<_>>().join(", ")))
    }

    /// Returns the kind of a model that no layout decodes, if the shapes of its outputs show it.
    fn foreign_shape(self, shapes: &[Vec<u32>], input: (u32, u32)) -> Option<&'static str> {
        let shape = match shapes {
            [first, masks] if first.len() == 3 && masks.len() == 4 => {
                return Some("a segmentation model");
            }
            [shape] => shape,
            _ => return None,
        };
        let [1, rows, columns] = shape[..] else { return None };
        let [usual, p6] = [STRIDES, P6_STRIDES].map(|strides| cells(strides, input));
        let is_v5 = [usual, p6].map(|cells| YOLO_V5_ANCHORS * cells).contains(&rows.into());
        let is_ultralytics = [rows, columns].map(u64::from).contains(&usual);
        if columns > 5 && is_v5 {
            return Some("YOLOv5 or YOLOv7, with three anchors in each cell");
        }
        let is_rt_detr = self == Self::Ultralytics && rows == RT_DETR_ROWS && !is_ultralytics;
        (is_rt_detr && columns > NMS_FREE_ROW).then_some("RT-DETR, with 300 rows")
    }

    pub(crate) fn form(self, shape: &[u32], input: (u32, u32)) -> Result<Form, VisionError> {
        let text = || shape_text(shape.iter().copied().map(Some));
        self.form_of(shape, input).ok_or_else(|| self.refusal(input, text()))
    }

    pub(crate) fn refusal(self, (width, height): (u32, u32), found: String) -> VisionError {
        let [usual, all] = [STRIDES, P6_STRIDES].map(|strides| cells(strides, (width, height)));
        let expected = match self {
            Self::Ultralytics => format!("[1, 4 + classes, {usual}], or transposed"),
            Self::Yolox => format!("[1, {usual}, 5 + classes]"),
            Self::NmsFree => "[1, rows, 6]".to_owned(),
            Self::Nanodet => format!("[1, {all}, classes + 32] or [1, {usual}, classes + 32]"),
        };
        let found = if found.is_empty() { "no output".to_owned() } else { found };
        VisionError::OutputShape { layout: self.name(), expected, width, height, found }
    }

    fn form_of(self, shape: &[u32], input: (u32, u32)) -> Option<Form> {
        let [1, rows, columns] = *shape else {
            return None;
        };
        let strides_of = |length: u32| {
            let is_it = |strides: &&[u32]| cells(strides, input) == u64::from(length);
            self.grids().iter().copied().find(is_it)
        };
        // An output has a row for each number, or, transposed, for each anchor.
        let by_number = self == Self::Ultralytics
            && (strides_of(columns).is_some() || strides_of(rows).is_none());
        let (anchors, numbers) = if by_number { (columns, rows) } else { (rows, columns) };
        let scores = numbers.checked_sub(match self {
            Self::Ultralytics => 4,
            Self::Yolox => 5,
            Self::NmsFree => NMS_FREE_ROW,
            Self::Nanodet => 32,
        })?;
        let (strides, classes): (&'static [u32], Option<u32>) = match self {
            Self::NmsFree => (&[], None),
            _ => (strides_of(anchors)?, Some(scores)),
        };
        if classes.is_none() != (scores == 0) {
            return None;
        }
        let (anchors, numbers) = (anchors as usize, numbers as usize);
        Some(Form { layout: self, anchors, numbers, classes, by_number, strides })
    }

    /// Returns the strides of the grids that a model of this family may have.
    fn grids(self) -> &'static [&'static [u32]] {
        match self {
            Self::Ultralytics => &[STRIDES, P2_STRIDES, P6_STRIDES],
            Self::Yolox => &[STRIDES],
            Self::NmsFree => &[],
            // Older ones lack the last grid.
            Self::Nanodet => &[P6_STRIDES, STRIDES],
        }
    }
}

fn cells(strides: &[u32], (width, height): (u32, u32)) -> u64 {
    let grid =
        |stride: &u32| u64::from(width.div_ceil(*stride)) * u64::from(height.div_ceil(*stride));
    strides.iter().map(grid).fold(0, u64::saturating_add)
}

#[cfg(test)]
mod tests {
    use super::DetectorLayout::{Nanodet, NmsFree, Ultralytics, Yolox};
    use super::*;

    /// Checks outputs of fixed shapes for an input of `side` x `side` pixels.
    fn check(
        layout: DetectorLayout,
        shapes: &[&[u32]],
        side: u32,
        note: &[(&str, &str)],
    ) -> Result<Option<u32>, String> {
        let fixed = |shape: &&[u32]| shape.iter().copied().map(Some).collect::<Vec<_>>();
        let shapes: Vec<_> = shapes.iter().map(fixed).collect();
        let shapes: Vec<_> = shapes.iter().map(Vec::as_slice).collect();
        let note = ExportNote::of(note.iter().copied());
        layout.check(&shapes, (side, side), &note).map_err(|error| error.to_string())
    }

    fn refusal(layout: DetectorLayout, shapes: &[&[u32]]) -> String {
        check(layout, shapes, 416, &[]).unwrap_err()
    }

    #[test]
    fn layouts_are_found_by_name() {
        for layout in DetectorLayout::ALL {
            assert_eq!(DetectorLayout::from_name(layout.name()), Ok(layout));
        }
        assert_eq!(
            DetectorLayout::from_name("yolo").unwrap_err().to_string(),
            "layout `yolo` is not known; known are ultralytics, yolox, nms-free, nanodet"
        );
        let long = DetectorLayout::from_name(&"y".repeat(10_000)).unwrap_err().to_string();
        assert!(long.len() < 200, "{long}");
    }

    #[test]
    fn the_input_determines_size_and_order() {
        let how = Yolox.preprocess(&[Some(1), Some(3), Some(320), Some(416)]).unwrap();
        assert_eq!((how.width, how.height, how.channels_last, how.bgr), (416, 320, false, true));
        assert_eq!((how.placement, how.fill, how.scale), (Placement::Corner, 114, 1.0));
        let how = Ultralytics.preprocess(&[None, Some(320), Some(416), Some(3)]).unwrap();
        assert_eq!((how.width, how.height, how.channels_last, how.bgr), (416, 320, true, false));
        assert_eq!((how.placement, how.scale), (Placement::Centre, 1.0 / 255.0));
        let how = Nanodet.preprocess(&[Some(1), Some(3), Some(416), Some(416)]).unwrap();
        assert_eq!(
            (how.placement, how.mean[0], how.deviation[2]),
            (Placement::Stretch, 103.53, 58.395)
        );
    }

    #[test]
    fn another_input_is_refused() {
        let error = |input: &[Option<u32>]| Yolox.preprocess(input).unwrap_err().to_string();
        assert_eq!(
            error(&[Some(1), Some(1), Some(28), Some(28)]),
            "layout `yolox` needs one input [1, 3, height, width] or [1, height, width, 3]; \
             the model has [1, 1, 28, 28]"
        );
        assert!(error(&[]).ends_with("the model has []"));
        assert!(error(&[Some(8), Some(3), Some(64), Some(64)]).contains("[8, 3, 64, 64]"));
        assert_eq!(
            error(&[None, Some(3), None, None]),
            "layout `yolox` needs an input of fixed size; the model has [?, 3, ?, ?]: \
             export it with a fixed size, such as 640x640"
        );
        assert_eq!(
            error(&[Some(1), Some(3), Some(0), Some(9000)]),
            "tensor of 9000x0 pixels: each side must be 1 to 8192"
        );
    }

    #[test]
    fn the_outputs_show_the_number_of_classes() {
        let classes = |layout, shape: [u32; 3]| check(layout, &[&shape], 416, &[]).unwrap();
        assert_eq!(classes(Yolox, [1, 3549, 85]), Some(80));
        assert_eq!(classes(Ultralytics, [1, 84, 3549]), Some(80));
        assert_eq!(classes(Ultralytics, [1, 3549, 84]), Some(80));
        assert_eq!(classes(NmsFree, [1, 300, 6]), None);
        assert_eq!(classes(NmsFree, [1, 0, 6]), None);
        assert_eq!(classes(Nanodet, [1, 3598, 112]), Some(80));
        assert_eq!(classes(Nanodet, [1, 3549, 33]), Some(1));
        let dynamic: &[Option<u32>] = &[None, Some(84), None];
        let none = ExportNote::default();
        assert_eq!(Ultralytics.check(&[dynamic], (416, 416), &none), Ok(None));
    }

    #[test]
    fn other_outputs_are_refused_with_both_shapes() {
        assert_eq!(
            refusal(Yolox, &[&[1, 2100, 85]]),
            "layout `yolox` needs one output [1, 3549, 5 + classes] for an input of 416x416; \
             the model has [1, 2100, 85]"
        );
        assert_eq!(
            refusal(Ultralytics, &[&[1, 84, 3549], &[1, 7]]),
            "layout `ultralytics` needs one output [1, 4 + classes, 3549], or transposed for an \
             input of 416x416; the model has [1, 84, 3549], [1, 7]"
        );
        assert!(refusal(NmsFree, &[]).ends_with("the model has no output"));
        for layout in DetectorLayout::ALL {
            for lengths in [
                &[][..],
                &[1],
                &[1, 0, 0],
                &[0, 3549, 85],
                &[1, u32::MAX, u32::MAX],
                &[1, 4, 3549],
                &[1, 3549, 4],
                &[2, 3549, 85],
                &[1, 3549, 85, 1],
            ] {
                let message = refusal(layout, &[lengths]);
                assert!(message.contains(&format!("{lengths:?}")), "{layout:?} {message}");
            }
        }
    }

    #[test]
    fn models_of_other_families_are_refused_by_name() {
        let check =
            |layout, shapes: &[&[u32]], note: &[(&str, &str)]| check(layout, shapes, 640, note);
        let head = [("task", "detect"), ("head", "RTDETRDecoder")];
        for (layout, shapes, note, kind) in [
            (Ultralytics, &[&[1, 25200, 85][..]][..], &[][..], "YOLOv5 or YOLOv7"),
            (Ultralytics, &[&[1, 25_500, 85]], &[], "YOLOv5 or YOLOv7"),
            (Ultralytics, &[&[1, 300, 84]], &[], "RT-DETR"),
            (NmsFree, &[&[1, 300, 6]], &head, "RT-DETR"),
            (Ultralytics, &[&[1, 300, 84]], &head, "RT-DETR"),
            (Ultralytics, &[&[1, 56, 8400]], &[("task", "pose")], "for task `pose`"),
            (Ultralytics, &[&[1, 20, 8400]], &[("task", "obb")], "for task `obb`"),
            (Ultralytics, &[&[1, 116, 8400], &[1, 32, 160, 160]], &[], "a segmentation model"),
        ] {
            let message = check(layout, shapes, note).unwrap_err();
            assert!(message.contains(kind) && message.contains("call `run`"), "{message}");
        }
        assert_eq!(check(Ultralytics, &[&[1, 84, 8400]], &[("task", "detect")]), Ok(Some(80)));
        assert_eq!(check(NmsFree, &[&[1, 300, 6]], &[("end2end", "True")]), Ok(None));
        // Grids with strides 4 to 32, and 8 to 64: 640x640 gives 34000 and 8500 cells.
        for (anchors, stride) in [(34_000, "32"), (8500, "64")] {
            let shape: &[&[u32]] = &[&[1, 84, anchors]];
            assert_eq!(check(Ultralytics, shape, &[("stride", stride)]), Ok(Some(80)));
            assert!(check(Ultralytics, shape, &[]).unwrap_err().contains("8400"));
        }
    }
}

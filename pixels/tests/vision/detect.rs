//! Detections in small outputs, against boxes worked out by hand.

use gleaner_pixels::vision::DetectorLayout::{Nanodet, NmsFree, Ultralytics, Yolox};
use gleaner_pixels::vision::{
    Detection, DetectorLayout, MAX_CANDIDATES, OutputView, Placed, VisionError, Wanted, detect,
};

/// A frame of 128x64 pixels in a tensor of 64x64: half as large, with 16 rows of border above.
const PLACED: Placed = Placed {
    scale_x: 0.5,
    scale_y: 0.5,
    left: 0.0,
    top: 16.0,
    frame_width: 128,
    frame_height: 64,
    tensor_width: 64,
    tensor_height: 64,
};

/// Cells of the strides 8, 16 and 32 in a tensor of 64x64.
const CELLS: usize = 84;

fn all() -> Wanted {
    Wanted { classes: None, min_score: 0.25, max_iou: 0.5, max_count: 100 }
}

fn run(
    layout: DetectorLayout,
    shape: &[u32],
    values: &[f32],
    wanted: &Wanted,
) -> Result<Vec<Detection>, VisionError> {
    detect(layout, &[OutputView { shape, values }], &PLACED, wanted)
}

fn boxes(detections: &[Detection]) -> Vec<(u32, [f32; 4])> {
    detections
        .iter()
        .map(|found| (found.class, [found.x, found.y, found.width, found.height]))
        .collect()
}

/// An output of Ultralytics with three classes; each row has the numbers of an anchor.
fn ultralytics(rows: &[[f32; 7]]) -> (Vec<f32>, Vec<f32>) {
    let mut by_anchor = vec![0.0; CELLS * 7];
    for (anchor, row) in rows.iter().enumerate() {
        by_anchor[anchor * 7..][..7].copy_from_slice(row);
    }
    let by_number =
        (0..7).flat_map(|number| by_anchor.iter().skip(number).step_by(7).copied()).collect();
    (by_number, by_anchor)
}

#[track_caller]
fn run_ultralytics(rows: &[[f32; 7]], wanted: &Wanted) -> Vec<Detection> {
    let (by_number, by_anchor) = ultralytics(rows);
    let layout = Ultralytics;
    let found = run(layout, &[1, 7, CELLS as u32], &by_number, wanted).unwrap();
    assert_eq!(run(layout, &[1, CELLS as u32, 7], &by_anchor, wanted).unwrap(), found);
    found
}

#[test]
fn ultralytics_gives_centre_and_size() {
    let found = run_ultralytics(
        &[
            [32.0, 32.0, 16.0, 8.0, 0.1, 0.5, 0.2],
            [10.0, 40.0, 4.0, 4.0, 0.75, 0.7, 0.0],
            [10.0, 20.0, 4.0, 4.0, 0.2, 0.2, 0.2],
        ],
        &all(),
    );
    // Left 24, upper 28; twice that, after the border of 16 rows.
    assert_eq!(boxes(&found), [(0, [16.0, 44.0, 8.0, 8.0]), (1, [48.0, 24.0, 32.0, 16.0])]);
    assert_eq!((found[0].score, found[1].score), (0.75, 0.5));
}

#[test]
fn only_wanted_classes_are_read() {
    let rows = [
        [32.0, 32.0, 16.0, 8.0, 0.9, 0.5, 0.4],
        // Only what is read must be a score.
        [10.0, 40.0, 4.0, 4.0, f32::NAN, 0.0, 0.3],
        [20.0, 40.0, 4.0, 4.0, 0.9, 0.0, 0.0],
    ];
    let classes = |classes: &[u32]| {
        let wanted = Wanted { classes: Some(classes.to_vec()), ..all() };
        let found = run_ultralytics(&rows, &wanted);
        found.iter().map(|found| (found.class, found.score)).collect::<Vec<_>>()
    };
    assert_eq!(classes(&[2]), [(2, 0.4), (2, 0.3)]);
    assert_eq!(classes(&[2, 1, 2]), [(1, 0.5), (2, 0.3)]);
    assert_eq!(classes(&[]), []);
    let (values, _) = ultralytics(&rows);
    let wanted = Wanted { classes: Some(vec![1, 3]), ..all() };
    let error = run(Ultralytics, &[1, 7, 84], &values, &wanted).unwrap_err();
    assert_eq!(error.to_string(), "class 3 is wanted; the model has classes 0 to 2");
}

#[test]
fn of_overlapping_objects_of_a_class_the_best_stays() {
    let rows = [
        // Shifted by a third: 2/3 of each is shared, so the overlap is 0.5.
        [30.0, 32.0, 12.0, 12.0, 0.5, 0.0, 0.0],
        [34.0, 32.0, 12.0, 12.0, 0.9, 0.0, 0.0],
        // In the place of the best, but of another class.
        [34.0, 32.0, 12.0, 12.0, 0.0, 0.8, 0.0],
        // Overlaps only with the first.
        [26.0, 32.0, 12.0, 12.0, 0.4, 0.0, 0.0],
    ];
    let scores = |max_iou: f32| -> Vec<f32> {
        let found = run_ultralytics(&rows, &Wanted { max_iou, ..all() });
        found.iter().map(|found| found.score).collect()
    };
    assert_eq!(scores(0.5), [0.9, 0.8, 0.5, 0.4]);
    // What was dropped drops nothing.
    assert_eq!(scores(0.49), [0.9, 0.8, 0.4]);
    assert_eq!(scores(0.0), [0.9, 0.8]);
    assert_eq!(scores(1.0), [0.9, 0.8, 0.5, 0.4]);
}

#[test]
fn of_equal_scores_the_first_of_the_output_comes_first() {
    let row = |x: f32, class: usize| {
        let mut row = [x, 32.0, 4.0, 4.0, 0.0, 0.0, 0.0];
        row[4 + class] = 0.5;
        row
    };
    let rows: Vec<_> = (0..12).map(|at| row(4.0 + 5.0 * at as f32, at % 3)).collect();
    let found = run_ultralytics(&rows, &all());
    let expected: Vec<f32> = (0..12).map(|at| 4.0 + 10.0 * at as f32).collect();
    assert_eq!(found.iter().map(|found| found.x).collect::<Vec<_>>(), expected);
    // Of two equal classes of an anchor, too.
    let found = run_ultralytics(&[[32.0, 32.0, 4.0, 4.0, 0.1, 0.5, 0.5]], &all());
    assert_eq!(found[0].class, 1);
    let found = run_ultralytics(&rows, &Wanted { max_count: 2, ..all() });
    assert_eq!(found.len(), 2);
    assert!(run_ultralytics(&rows, &Wanted { max_count: 0, ..all() }).is_empty());
}

#[test]
fn boxes_are_clipped_to_the_frame() {
    let found = run_ultralytics(
        &[
            // Beyond all four sides.
            [32.0, 32.0, 200.0, 200.0, 0.9, 0.0, 0.0],
            // Only in the border above the frame.
            [32.0, 8.0, 10.0, 16.0, 0.8, 0.0, 0.0],
            // Without a width, and with a negative one.
            [32.0, 32.0, 0.0, 8.0, 0.8, 0.0, 0.0],
            [32.0, 32.0, -4.0, -8.0, 0.8, 0.0, 0.0],
            // In part to the right of it.
            [62.0, 32.0, 8.0, 8.0, 0.7, 0.0, 0.0],
        ],
        &all(),
    );
    assert_eq!(boxes(&found), [(0, [0.0, 0.0, 128.0, 64.0]), (0, [116.0, 24.0, 12.0, 16.0])]);
}

#[test]
fn numbers_that_are_not_finite_are_dropped() {
    let mut rows = Vec::new();
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, f32::MIN] {
        for at in 0..4 {
            let mut row = [32.0, 32.0, 4.0, 4.0, 0.9, 0.0, 0.0];
            row[at] = bad;
            rows.push(row);
        }
    }
    assert_eq!(run_ultralytics(&rows, &all()), []);
}

#[test]
fn a_number_that_is_no_score_is_a_fault_with_its_value() {
    for value in [f32::NAN, f32::INFINITY, 1.000_001, 7.0, -0.25] {
        let (by_number, by_anchor) = ultralytics(&[[32.0, 32.0, 4.0, 4.0, 0.9, value, 0.0]]);
        let yolox = [&[0.5, 0.5, 0.0, 0.0, 0.9, value, 0.0], &[0.0; 83 * 7][..]].concat();
        let objectness = [&[0.5, 0.5, 0.0, 0.0, value, 0.0, 0.0], &[0.0; 83 * 7][..]].concat();
        let nms_free = [10.0, 20.0, 30.0, 40.0, value, 0.0];
        let nanodet = [&[value, 0.0], &[0.0; 84 * 34 - 2][..]].concat();
        for (layout, shape, values) in [
            (Ultralytics, [1, 7, 84], &by_number[..]),
            (Ultralytics, [1, 84, 7], &by_anchor),
            (Yolox, [1, 84, 7], &yolox),
            (Yolox, [1, 84, 7], &objectness),
            (NmsFree, [1, 1, 6], &nms_free),
            (Nanodet, [1, 84, 34], &nanodet),
        ] {
            let message = run(layout, &shape, values, &all()).unwrap_err().to_string();
            let expected = format!("the model returned {value} as a score of layout `");
            assert!(message.starts_with(&expected), "{message}");
        }
    }
}

#[test]
fn boxes_that_are_not_in_pixels_are_a_fault() {
    // RT-DETR: centre and size from 0 to 1, as fractions of the input.
    let rows = [[0.5, 0.5, 0.2, 0.1, 0.9, 2.0], [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]];
    let shape = [1, 2, 6];
    let run = |rows: &[[f32; 6]; 2], min_score| {
        let wanted = Wanted { min_score, ..all() };
        run(NmsFree, &shape, rows.as_flattened(), &wanted)
    };
    let message = run(&rows, 0.25).unwrap_err().to_string();
    assert!(message.starts_with("all boxes that the model returned end below 2 pixels"));
    assert_eq!(run(&rows, 0.95), Ok(vec![]), "no object");
    assert_eq!(run(&[[0.0; 6]; 2], 0.0), Ok(vec![]), "padding");
}

#[test]
fn yolox_gives_boxes_relative_to_cells() {
    let mut values = vec![0.0; CELLS * 7];
    let mut set = |cell: usize, row: [f32; 7]| values[cell * 7..][..7].copy_from_slice(&row);
    // Column 3, row 4 of the grid of 8x8: centre (3.5, 4.25) * 8, size (8, 16).
    set(4 * 8 + 3, [0.5, 0.25, 0.0, 2.0_f32.ln(), 0.5, 0.5, 0.9]);
    // Column 1, row 2 of the grid of 4x4 with stride 16: centre (24, 40), size 16.
    set(64 + 2 * 4 + 1, [0.5, 0.5, 0.0, 0.0, 0.9, 0.8, 0.1]);
    // Column 1, row 0 of the grid of 2x2 with stride 32: below the score, as 0.6 * 0.4 = 0.24.
    set(64 + 16 + 1, [0.5, 0.5, 0.0, 0.0, 0.6, 0.4, 0.0]);
    // Not finite after `exp`.
    set(0, [0.5, 0.5, 1000.0, 0.0, 0.9, 0.9, 0.9]);
    let found = run(Yolox, &[1, 84, 7], &values, &all()).unwrap();
    assert_eq!(boxes(&found)[0], (0, [32.0, 32.0, 32.0, 32.0]));
    let (class, found_box) = boxes(&found)[1];
    assert_eq!(class, 1);
    for (found, expected) in found_box.iter().zip([48.0, 20.0, 16.0, 32.0]) {
        assert!((found - expected).abs() < 1e-4, "{found_box:?}");
    }
    assert_eq!(found.iter().map(|found| found.score).collect::<Vec<_>>(), [0.9 * 0.8, 0.5 * 0.9]);
}

#[test]
fn nms_free_gives_corners_and_keeps_overlaps() {
    let values = [
        [10.0, 20.0, 30.0, 40.0, 0.5, 2.0],
        [10.0, 20.0, 30.0, 40.0, 0.9, 2.0],
        [0.0, 16.0, 64.0, 48.0, 0.6, 0.0],
        [0.0, 16.0, 64.0, 48.0, 0.2, 0.0],
        [0.0, 16.0, 64.0, 48.0, 0.8, -1.0],
        [0.0, 16.0, 64.0, 48.0, 0.8, f32::NAN],
    ];
    let run = |wanted: &Wanted| run(NmsFree, &[1, 6, 6], values.as_flattened(), wanted).unwrap();
    assert_eq!(
        boxes(&run(&all())),
        [(2, [20.0, 8.0, 40.0, 40.0]), (0, [0.0, 0.0, 128.0, 64.0]), (2, [20.0, 8.0, 40.0, 40.0])]
    );
    // The model may return any class.
    let wanted = Wanted { classes: Some(vec![0, 70_000]), ..all() };
    assert_eq!(boxes(&run(&wanted)), [(0, [0.0, 0.0, 128.0, 64.0])]);
    let none = detect(NmsFree, &[OutputView { shape: &[1, 0, 6], values: &[] }], &PLACED, &all());
    assert_eq!(none, Ok(vec![]));
}

#[test]
fn nanodet_gives_distances_to_the_corner_of_a_cell() {
    // With and without the grid of stride 64.
    for cells in [85, 84] {
        let mut values = vec![0.0; cells * 34];
        let mut set = |cell: usize, class: usize, score: f32, distances: [usize; 4]| {
            let row = &mut values[cell * 34..][..34];
            row[class] = score;
            for (bins, distance) in row[2..].chunks_exact_mut(8).zip(distances) {
                bins.fill(-200.0);
                bins[distance] = 10.0;
            }
        };
        // Column 4, row 3 of the grid with stride 8: the point (32, 24).
        set(3 * 8 + 4, 1, 0.75, [1, 0, 2, 3]);
        // Column 1, row 1 of the grid with stride 32: the point (32, 32).
        set(83, 0, 0.5, [1, 0, 0, 1]);
        let found = run(Nanodet, &[1, cells as u32, 34], &values, &all()).unwrap();
        // Left 24, upper 24, right 48, lower 48; and left 0, upper 32, right 32, lower 64, of which
        // the frame ends at 48.
        assert_eq!(boxes(&found), [(1, [48.0, 16.0, 48.0, 48.0]), (0, [0.0, 32.0, 64.0, 32.0])]);
    }
}

#[test]
fn outputs_that_do_not_fit_are_refused_with_both_shapes() {
    let refusal = |layout, shape: &[u32], count: usize| {
        run(layout, shape, &vec![0.9; count], &all()).unwrap_err().to_string()
    };
    assert_eq!(
        refusal(Nanodet, &[1, 85, 32], 2720),
        "layout `nanodet` needs one output [1, 85, classes + 32] or [1, 84, classes + 32] \
         for an input of 64x64; the model has [1, 85, 32]"
    );
    assert_eq!(
        refusal(Ultralytics, &[1, 80, 84], 80 * 84 - 1),
        "output [1, 80, 84] of the model has 6719 values"
    );
    for shape in [[1, u32::MAX, 84], [1, 84, 1 << 31], [1, 84, 5]] {
        assert!(refusal(Ultralytics, &shape, 12).ends_with("has 12 values"));
    }
    let error = detect(Yolox, &[], &PLACED, &all()).unwrap_err().to_string();
    assert!(error.ends_with("the model has no output"), "{error}");
}

#[test]
fn options_out_of_range_are_refused() {
    let refusal = |wanted: &Wanted, placed: &Placed| {
        detect(Yolox, &[], placed, wanted).unwrap_err().to_string()
    };
    assert_eq!(
        refusal(&Wanted { min_score: f32::NAN, ..all() }, &PLACED),
        "min-score is NaN; it must be 0 to 1"
    );
    assert_eq!(
        refusal(&Wanted { max_iou: 1.5, ..all() }, &PLACED),
        "max-iou is 1.5; it must be 0 to 1"
    );
    for placed in [
        Placed { scale_x: 0.0, ..PLACED },
        Placed { scale_y: f32::NAN, ..PLACED },
        Placed { left: f32::INFINITY, ..PLACED },
        Placed { tensor_width: 0, ..PLACED },
    ] {
        assert!(refusal(&all(), &placed).starts_with("placement of the frame"));
    }
}

#[test]
fn of_many_objects_only_the_best_are_compared() {
    let count = 3 * MAX_CANDIDATES;
    let mut values = Vec::new();
    for at in 0..count {
        let score = 0.3 + 0.6 * at as f32 / count as f32;
        values.extend([10.0, 20.0, 30.0, 40.0, score, 0.0]);
    }
    let wanted = Wanted { max_count: u32::MAX, ..all() };
    let shape = [1, count as u32, 6];
    let found = run(NmsFree, &shape, &values, &wanted).unwrap();
    assert_eq!(found.len(), 1024);
    assert_eq!(found[0].score, values[(count - 1) * 6 + 4]);
    assert!(found.is_sorted_by(|a, b| a.score >= b.score));
    // The one in another place has a low score, and is not among the best.
    for row in values.chunks_exact_mut(6) {
        row[4] = 0.9;
    }
    values[(count - 1) * 6..].copy_from_slice(&[50.0, 20.0, 60.0, 40.0, 0.3, 1.0]);
    let found = run(NmsFree, &shape, &values, &wanted).unwrap();
    assert!(found.iter().all(|found| found.class == 0));
}

//! Fuzzes the way of a frame through a model: the check of the model's file, a lambda's request to
//! run it and the reply, the frame as a tensor, and the boxes in the outputs of a detector.
//!
//! An input is a byte for the mode, and then a file, or the fields of the others.

use gleaner_inference::inspect::{ModelSignature, inspect};
use gleaner_inference::places::{PlacedInput, check_inputs};
use gleaner_pixels::vision::{
    Detection, DetectorLayout, MAX_DETECTIONS, OutputView, Placed, Placement, Preparer, Preprocess,
    Wanted, detect,
};
use gleaner_protocol::inference::{
    Element, MAX_DIMENSIONS, MAX_TENSOR_BYTES, ModelCall, ModelReply, ModelRequest, ModelResult,
    TENSOR_ALIGNMENT, TensorInfo, TensorPlace,
};
use gleaner_rules::pixels::{Encoding, View};

use crate::budget;
use crate::image::ENCODINGS;
use crate::input::FuzzInput;

pub mod mode {
    /// A file follows.
    pub const FILE: u8 = 0;
    /// A byte for the region follows, then a request as JSON.
    pub const REQUEST: u8 = 1;
    /// Layout, placement, requirements and shapes follow, then values.
    pub const OUTPUT: u8 = 2;
    /// Encoding and size of a frame and the fields of its conversion follow, then pixels.
    pub const FRAME: u8 = 3;
    /// A reply as JSON follows.
    pub const REPLY: u8 = 4;
}

/// Largest number of inputs, and of outputs, of an accepted model.
const TENSORS_MAX: usize = 256;

/// Regions for inputs: a small one, and the largest, in which inputs may be too large together.
const REGIONS: [u64; 2] = [4096, MAX_TENSOR_BYTES];

/// Limit on values of an output, and on pixels of a tensor, so that an input takes little time.
const VALUES_MAX: usize = 16 << 10;

/// Checks a file, a request, outputs, a frame or a reply. Returns whether it was accepted.
pub fn check(data: &[u8]) -> bool {
    let mut input = FuzzInput(data);
    match input.u8() {
        mode::REQUEST => request(&mut input),
        mode::OUTPUT => output(&mut input),
        mode::FRAME => frame(&mut input),
        mode::REPLY => reply(input.0),
        _ => file(input.0),
    }
}

/// Checks a model's file: what is accepted is within all bounds, and an unknown field changes
/// nothing.
fn file(model: &[u8]) -> bool {
    // The name of a constant or operator may have five bytes in the file, and has 40 in memory, and
    // as many again while their set grows.
    let memory = (64 << 10) + 64 * model.len();
    let signature = match budget::within(memory, || inspect(model)) {
        Ok(signature) => signature,
        Err(error) => {
            let message = budget::within(memory, || error.to_string());
            assert!(message.len() <= 512 + 2 * model.len(), "a message of {}", message.len());
            return false;
        }
    };
    let ModelSignature { inputs, outputs, rten: _, metadata } = &signature;
    assert!(inputs.len() <= TENSORS_MAX && outputs.len() <= TENSORS_MAX);
    assert!(
        metadata.iter().map(|(key, value)| key.len() + value.len()).sum::<usize>() <= model.len()
    );
    assert!(outputs.iter().all(|output| output.has_shape || output.tensor.shape.is_empty()));
    let outputs: Vec<&TensorInfo> = outputs.iter().map(|output| &output.tensor).collect();
    for infos in [inputs.iter().collect(), outputs] {
        for (index, info) in infos.iter().enumerate() {
            assert!(info.shape.len() <= MAX_DIMENSIONS && !info.shape.contains(&Some(0)), "{info}");
            assert!(infos[..index].iter().all(|other| other.name != info.name), "{}", info.name);
        }
    }
    let unknown_field = [0xc2, 0x3e, 0x00];
    let longer = [model, &unknown_field].concat();
    assert_eq!(inspect(&longer), Ok(signature), "with an unknown field");
    true
}

/// The inputs of a model: a picture, a list of any length, and a number.
fn needed() -> [TensorInfo; 3] {
    let info = |name: &str, element, shape: &[Option<u32>]| {
        let (name, shape) = (name.to_owned(), shape.to_vec());
        TensorInfo { name, element, shape }
    };
    [
        info("images", Element::Float32, &[Some(1), Some(3), None, Some(4)]),
        info("list", Element::Int64, &[None]),
        info("size", Element::Uint8, &[]),
    ]
}

/// Checks a request: it can be sent again, and its inputs fit the model and the region.
fn request(input: &mut FuzzInput) -> bool {
    let region = REGIONS[usize::from(input.u8()) % REGIONS.len()];
    let memory = (16 << 10) + 64 * input.0.len();
    let parsed: Result<ModelRequest, _> =
        budget::within(memory, || serde_json::from_slice(input.0));
    let Ok(request) = parsed else { return false };
    let again = serde_json::to_vec(&request).expect("it was parsed");
    assert_eq!(serde_json::from_slice::<ModelRequest>(&again).ok().as_ref(), Some(&request));
    let ModelCall::Run { inputs: given, .. } = &request.call else { return true };
    let needed = needed();
    match budget::within(memory, || check_inputs(&needed, given, region)) {
        Ok(placed) => {
            assert_eq!((placed.len(), given.len()), (needed.len(), needed.len()));
            for (info, placed) in needed.iter().zip(&placed) {
                accepted(info, given, placed, region);
            }
            let bytes = placed.iter().map(|placed| u128::from(placed.bytes)).sum::<u128>();
            assert!(bytes <= u128::from(MAX_TENSOR_BYTES), "{bytes} bytes of inputs");
            true
        }
        Err(error) => {
            let message = budget::within(memory, || error.to_string());
            assert!(message.len() <= 512 + 8 * input.0.len(), "a message of {}", message.len());
            false
        }
    }
}

/// Checks a reply, as a lambda's process reads it: it can be sent again, and the size of an output
/// is exact, or refused.
fn reply(json: &[u8]) -> bool {
    let memory = (16 << 10) + 64 * json.len();
    let parsed: Result<ModelReply, _> = budget::within(memory, || serde_json::from_slice(json));
    let Ok(reply) = parsed else { return false };
    let again = serde_json::to_vec(&reply).expect("it was parsed");
    assert_eq!(serde_json::from_slice::<ModelReply>(&again).ok().as_ref(), Some(&reply));
    let Ok(ModelResult::Ran { outputs, .. }) = &reply.result else { return true };
    for output in outputs {
        let lengths = output.shape.iter().map(|length| u128::from(*length));
        let exact = lengths.fold(output.element.size() as u128, u128::saturating_mul);
        let fits = output.shape.len() <= MAX_DIMENSIONS && exact <= u128::from(MAX_TENSOR_BYTES);
        let bytes = output.bytes().map(u128::from);
        // A length of 0 after others that overflow may be refused.
        assert!(bytes.is_none_or(|bytes| fits && bytes == exact), "{output:?}: {bytes:?}");
        assert!(bytes.is_some() || !fits || exact == 0, "{output:?}");
    }
    true
}

/// Checks an accepted input against the one that the model needs, and those that were given.
fn accepted(info: &TensorInfo, given: &[TensorPlace], placed: &PlacedInput, region: u64) {
    let PlacedInput { element, shape, offset, bytes } = placed;
    let mut same_name = given.iter().filter(|place| place.name == info.name);
    let place = same_name.next().expect("an input that was not given");
    assert!(same_name.next().is_none(), "`{}` is given twice", info.name);
    assert_eq!((&place.element, &place.shape, place.offset), (element, shape, *offset));
    assert_eq!((*element, shape.len()), (info.element, info.shape.len()));
    let mut lengths = info.shape.iter().zip(shape);
    assert!(lengths.all(|(needed, length)| needed.is_none_or(|needed| needed == *length)));
    let elements = shape.iter().map(|length| u128::from(*length)).product::<u128>();
    assert!(elements > 0 && elements * element.size() as u128 == u128::from(*bytes));
    assert!(u128::from(*offset) + u128::from(*bytes) <= u128::from(region), "{placed:?}");
    assert!(offset.is_multiple_of(TENSOR_ALIGNMENT), "{placed:?}");
}

/// Decodes outputs of a detector, and checks the boxes.
fn output(input: &mut FuzzInput) -> bool {
    let layout = DetectorLayout::ALL[usize::from(input.u8()) % DetectorLayout::ALL.len()];
    let [tensor_width, tensor_height, frame_width, frame_height] =
        std::array::from_fn(|_| input.u32());
    let [scale_x, scale_y, left, top] = std::array::from_fn(|_| input.f32());
    let placed = Placed {
        scale_x,
        scale_y,
        left,
        top,
        frame_width,
        frame_height,
        tensor_width,
        tensor_height,
    };
    let (min_score, max_iou, max_count) = (input.f32(), input.f32(), input.u32());
    // The first bit: classes are given; the others: how many.
    let classes = input.u8();
    let classes = (classes & 1 == 1).then(|| (0..classes >> 1).map(|_| input.u32()).collect());
    let wanted = Wanted { classes, min_score, max_iou, max_count };
    let shapes: Vec<Vec<u32>> =
        (0..input.u8() % 3).map(|_| (0..input.u8() % 5).map(|_| input.u32()).collect()).collect();
    let pattern: Vec<f32> =
        input.0.as_chunks().0.iter().map(|it| f32::from_le_bytes(*it)).collect();
    let values: Vec<Vec<f32>> = shapes.iter().map(|shape| values(shape, &pattern)).collect();
    let views: Vec<OutputView<'_>> =
        shapes.iter().zip(&values).map(|(shape, values)| OutputView { shape, values }).collect();
    // A candidate has 24 bytes for each anchor, which has at least 5 values, and a shape may have
    // anchors without values.
    let count = values.iter().map(Vec::len).sum::<usize>();
    let memory = (160 << 10) + 32 * count;
    let found = budget::within(memory, || detect(layout, &views, &placed, &wanted));
    let found = match found {
        Ok(found) => found,
        Err(error) => {
            let message = error.to_string();
            assert!(message.len() <= 1 << 10, "a message of {}", message.len());
            return false;
        }
    };
    assert!(found.len() <= max_count.min(MAX_DETECTIONS) as usize, "{} boxes", found.len());
    assert!(found.is_sorted_by(|a, b| a.score >= b.score), "{found:?}");
    found.iter().for_each(|detection| on_frame(detection, &placed, &wanted));
    assert_eq!(detect(layout, &views, &placed, &wanted).ok(), Some(found), "again");
    true
}

/// Returns as many values as a shape needs, from `pattern` over and over; of a shape that needs too
/// many, the pattern.
fn values(shape: &[u32], pattern: &[f32]) -> Vec<f32> {
    let needed = shape.iter().try_fold(1_usize, |all, length| all.checked_mul(*length as usize));
    match needed.filter(|needed| *needed <= VALUES_MAX && !pattern.is_empty()) {
        Some(needed) => pattern.iter().copied().cycle().take(needed).collect(),
        None => pattern.to_vec(),
    }
}

fn on_frame(detection: &Detection, placed: &Placed, wanted: &Wanted) {
    let Detection { class, score, x, y, width, height } = *detection;
    assert!([score, x, y, width, height].iter().all(|number| number.is_finite()), "{detection:?}");
    assert!((wanted.min_score.min(1.0)..=1.0).contains(&score), "{detection:?}");
    assert!(x >= 0.0 && y >= 0.0 && width > 0.0 && height > 0.0, "{detection:?}");
    for (start, length, side) in [(x, width, placed.frame_width), (y, height, placed.frame_height)]
    {
        // The side as a float, and the sum, are rounded.
        let limit = f64::from(side) * (1.0 + 2.0 * f64::from(f32::EPSILON));
        assert!(f64::from(start) + f64::from(length) <= limit, "{detection:?} in {placed:?}");
    }
    if let Some(classes) = &wanted.classes {
        assert!(classes.contains(&class), "{detection:?}");
    }
}

/// Converts a frame to a tensor, twice.
fn frame(input: &mut FuzzInput) -> bool {
    let encoding = ENCODINGS[usize::from(input.u8()) % ENCODINGS.len()];
    let encoding = Encoding::from_ros(encoding).expect("these are names of ROS");
    let (frame_width, frame_height, step) = (input.u8(), input.u8(), input.u16());
    let how = preprocess(input);
    let pixels = input.0;
    let view =
        View::new(frame_width.into(), frame_height.into(), step.into(), encoding, false, pixels);
    let (Ok(view), Ok(size)) = (view, how.size()) else { return false };
    let area = how.width as usize * how.height as usize;
    assert_eq!(size, 3 * area * if how.bytes { 1 } else { size_of::<f32>() });
    if area > VALUES_MAX {
        return false;
    }
    // Two rows of 8 bytes for a pixel, one of 4, the columns with 28, and a converted row.
    let memory = (16 << 10) + 64 * how.width as usize + 8 * view.width() as usize;
    let prepare = |preparer: &mut Preparer, before: u8| {
        let mut out = vec![before; size];
        let placed = budget::within(memory, || preparer.prepare_into(&view, &how, None, &mut out));
        placed.map(|placed| (placed, out))
    };
    let mut preparer = Preparer::new();
    let first = prepare(&mut preparer, 0xaa);
    assert!(first == prepare(&mut preparer, 0x55), "a tensor depends on the one before");
    let Ok((placed, tensor)) = first else {
        assert!(encoding.is_raw() || encoding == Encoding::Mono16, "{first:?}");
        return false;
    };
    assert_eq!((placed.frame_width, placed.frame_height), (view.width(), view.height()));
    assert_eq!((placed.tensor_width, placed.tensor_height), (how.width, how.height));
    // Every corner of the frame is in the tensor, but for the rounding of a thin frame to a pixel.
    let [width, height] = [how.width, how.height].map(|side| side as f32 + 1.0);
    let (right, bottom) = placed.to_tensor(view.width() as f32, view.height() as f32);
    assert!((0.0..width).contains(&placed.left) && (0.0..height).contains(&placed.top));
    assert!(right > placed.left && right < width && bottom > placed.top && bottom < height);
    let plain = how.bytes && how.channels_last && !how.bgr && encoding == Encoding::Rgb8;
    if plain && (how.width, how.height) == (view.width(), view.height()) {
        let rows = (0..view.height()).flat_map(|y| view.row(y));
        assert!(rows.eq(&tensor), "a tensor of the frame's size has other pixels");
    }
    true
}

fn preprocess(input: &mut FuzzInput) -> Preprocess {
    let (width, height) = (u32::from(input.u16()), u32::from(input.u16()));
    let placements = [Placement::Stretch, Placement::Centre, Placement::Corner];
    let (placement, fill, flags) = (input.u8(), input.u8(), input.u8());
    Preprocess {
        width,
        height,
        placement: placements[usize::from(placement) % placements.len()],
        fill,
        bgr: flags & 1 == 1,
        channels_last: flags & 2 == 2,
        bytes: flags & 4 == 4,
        scale: input.f32(),
        mean: std::array::from_fn(|_| input.f32()),
        deviation: std::array::from_fn(|_| input.f32()),
    }
}

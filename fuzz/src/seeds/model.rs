//! Seeds: small ONNX models, requests to run one and replies, outputs of each kind of detector, and
//! frames with their conversion.

use gleaner_protocol::inference::{
    Element, ModelCall, ModelFault, ModelFaultKind, ModelReply, ModelRequest, ModelResult,
    TensorInfo, TensorPlace,
};

use crate::image::ENCODINGS;
use crate::model::mode;
use gleaner_test_support::onnx::{
    self, ANY, BOOL, FLOAT32, INT64, Proto, constant, graph, node, value, value_of,
};

/// Dictionary: names of operators, keys of requests, and texts with a meaning.
pub const WORDS: &[&str] = &[
    "Add",
    "Loop",
    "ai.onnx",
    "com.microsoft",
    "location",
    "{\"id\":1,\"deadline_ns\":null,\"regions\":[0,0],\"call\":",
    "{\"open\":{\"model\":\"m\"}}}",
    "{\"reserve\":{\"bytes\":64}}}",
    "{\"run\":{\"model\":\"m\",\"inputs\":[",
    "{\"name\":\"size\",\"element\":\"uint8\",\"shape\":[],\"offset\":0}",
    "\"name\":",
    "\"shape\":[",
    "\"offset\":",
    "\"images\"",
    "\"list\"",
    "\"size\"",
    "\"float32\"",
    "\"int64\"",
    "\"uint8\"",
    "4294967295",
    "18446744073709551615",
    // Infinity and NaN as floats, 0.5, 1, and a number that overflows when it is multiplied.
    "\0\0\u{0}\u{3f}",
    "\0\0\0\u{7f}",
];

pub fn all() -> Vec<Vec<u8>> {
    let files = models().into_iter().map(|file| with_mode(mode::FILE, &file));
    let requests = requests().into_iter().map(|request| {
        let json = serde_json::to_vec(&request).expect("a request is JSON");
        with_mode(mode::REQUEST, &[&[0][..], &json].concat())
    });
    let outputs = outputs().into_iter().map(|output| with_mode(mode::OUTPUT, &output));
    let frames = (0..ENCODINGS.len()).filter_map(frame).map(|it| with_mode(mode::FRAME, &it));
    let replies = replies().into_iter().map(|reply| {
        let json = serde_json::to_vec(&reply).expect("a reply is JSON");
        with_mode(mode::REPLY, &json)
    });
    files.chain(requests).chain(outputs).chain(frames).chain(replies).collect()
}

fn replies() -> Vec<ModelReply> {
    let place = |shape: &[u32], offset| {
        let (name, shape) = ("boxes".to_owned(), shape.to_vec());
        TensorPlace { name, element: Element::Float32, shape, offset }
    };
    let outputs = vec![place(&[1, 3549, 85], 0), place(&[0, 6], 1_206_720)];
    let info = TensorInfo {
        name: "images".to_owned(),
        element: Element::Uint8,
        shape: vec![Some(1), None],
    };
    let opened = ModelResult::Opened {
        inputs: vec![info.clone()],
        outputs: vec![info],
        runtime: "rten 0.27.0, cpu, 1 thread".to_owned(),
        metadata: vec![("task".to_owned(), "detect".to_owned())],
    };
    let fault = ModelFault::new(ModelFaultKind::TooSlow, "model `m` is still running");
    let results = [
        Ok(ModelResult::Started),
        Ok(opened),
        Ok(ModelResult::Ran { outputs, run_ns: 7 }),
        Err(fault),
    ];
    let reply = |(id, result)| ModelReply { id, region: id, result };
    (0..).zip(results).map(reply).collect()
}

fn with_mode(mode: u8, rest: &[u8]) -> Vec<u8> {
    [&[mode], rest].concat()
}

fn models() -> Vec<Vec<u8>> {
    let one = |name| value(name, FLOAT32, &[1]);
    let old = graph(
        &[node("Add", &["x", "w"], &["y"], &[])],
        &[constant("w", FLOAT32, &[1], &[0; 4])],
        &[one("x"), one("w")],
        &[value_of("y", &Proto::default().number(1, FLOAT32))],
    );
    let sparse = Proto::default().message(1, &constant("w", FLOAT32, &[1], &[0; 4]));
    let sparse = sparse.message(2, &constant("at", INT64, &[1], &[0; 8])).number(3, 9);
    let relu = onnx::unary("Relu", FLOAT32, &[1, 3, ANY, 8]);
    let function = Proto::default().text(1, "f").message(7, &node("Relu", &["x"], &["y"], &[]));
    let with_function = Proto(relu.clone()).message(25, &function).0;
    // As programs write it: a name, a producer, and a type of a value between two nodes.
    let produced = Proto::default().number(1, 8).text(2, "pytorch").text(3, "2.4.0");
    let inner = graph(
        &[node("Not", &["x"], &["v"], &[]), node("Not", &["v"], &["y"], &[])],
        &[],
        &[value("x", BOOL, &[ANY, 2])],
        &[value("y", BOOL, &[ANY, 2])],
    );
    let inner = inner.message(13, &value("v", BOOL, &[ANY, 2])).message(15, &sparse);
    let opset = Proto::default().text(1, "ai.onnx").number(2, 17);
    let produced = produced.message(7, &inner).message(8, &opset);
    let others = [onnx::product(), onnx::endless(&[1]), onnx::as_many_as_requested()];
    [relu, with_function, onnx::model(&old), produced.0].into_iter().chain(others).collect()
}

fn requests() -> Vec<ModelRequest> {
    let place = |name: &str, element, shape: &[u32], offset| {
        let (name, shape) = (name.to_owned(), shape.to_vec());
        TensorPlace { name, element, shape, offset }
    };
    let inputs = vec![
        place("size", Element::Uint8, &[], 4032),
        place("images", Element::Float32, &[1, 3, 2, 4], 0),
        place("list", Element::Int64, &[9], 128),
    ];
    let model = || "m".to_owned();
    let calls = [
        ModelCall::Open { model: model() },
        ModelCall::Reserve { bytes: 4096 },
        ModelCall::Run { model: model(), inputs },
    ];
    let deadlines = [None, Some(1), Some(u64::MAX)];
    let numbered = calls.into_iter().zip(deadlines).zip(1..);
    let request = |((call, deadline_ns), id)| {
        let regions = [id - 1, u64::MAX];
        ModelRequest { id, deadline_ns, regions, call }
    };
    numbered.map(request).collect()
}

/// Returns an element of an output: boxes in pixels, scores from 0 to 1.
fn value_at(layout: u8, shape: [u32; 3], at: usize) -> f32 {
    let is_transposed = layout == 0 && shape[1] == 6;
    let column = if is_transposed { at / shape[2] as usize } else { at % shape[2] as usize };
    match layout {
        2 => [1.0, 2.0, 20.0, 24.0, 0.75, 0.0][column],
        0 | 1 if column < 4 => [9.0, 8.0, 6.0, 5.0][column],
        _ => [0.75, 0.0, 0.5, 0.875, 1.0][at % 5],
    }
}

/// Outputs of a detector whose input has 32x32 pixels, and 21 cells with strides 8, 16 and 32.
fn outputs() -> Vec<Vec<u8>> {
    let shapes: [(u8, [u32; 3]); 7] = [
        (0, [1, 6, 21]),
        (0, [1, 21, 6]),
        (1, [1, 21, 7]),
        (2, [1, 9, 6]),
        (2, [1, 0, 6]),
        (3, [1, 21, 34]),
        (3, [1, 22, 33]),
    ];
    let output = |(layout, shape): (u8, [u32; 3])| {
        let mut bytes = vec![layout];
        [32_u32, 32, 64, 48].iter().for_each(|side| bytes.extend(side.to_le_bytes()));
        [0.5_f32, 0.5, 0.0, 4.0].iter().for_each(|number| bytes.extend(number.to_le_bytes()));
        [0.25_f32, 0.5].iter().for_each(|fraction| bytes.extend(fraction.to_le_bytes()));
        bytes.extend(9_u32.to_le_bytes());
        // The second seed of a layout wants class 0.
        if shape[1] == 22 || shape[2] == 6 {
            bytes.push(1 << 1 | 1);
            bytes.extend(0_u32.to_le_bytes());
        } else {
            bytes.push(0);
        }
        bytes.extend([1, shape.len() as u8]);
        shape.iter().for_each(|length| bytes.extend(length.to_le_bytes()));
        let elements: u32 = shape.iter().product();
        for at in 0..elements {
            bytes.extend(value_at(layout, shape, at as usize).to_le_bytes());
        }
        bytes
    };
    shapes.map(output).to_vec()
}

/// A frame of 4x3 pixels, in an encoding of which a tensor can be made.
fn frame(encoding: usize) -> Option<Vec<u8>> {
    let bytes_per_pixel = match ENCODINGS[encoding] {
        "rgb8" | "bgr8" => 3,
        "rgba8" | "bgra8" => 4,
        "mono8" => 1,
        "uyvy" | "yuyv" => 2,
        _ => return None,
    };
    let mut seed = vec![encoding as u8, 4, 3];
    seed.extend((4 * bytes_per_pixel as u16).to_le_bytes());
    // Every second one stays as large, and becomes bytes with the channels last.
    let is_plain = encoding.is_multiple_of(2);
    let sides = if is_plain { [4_u16, 3] } else { [9, 11] };
    sides.iter().for_each(|side| seed.extend(side.to_le_bytes()));
    let flags = if is_plain { 2 | 4 } else { encoding as u8 % 4 };
    seed.extend([encoding as u8, 114, flags]);
    let numbers = [1.0_f32 / 255.0, 0.5, 0.25, 0.0, 1.0, 0.5, 2.0];
    numbers.iter().for_each(|number| seed.extend(number.to_le_bytes()));
    seed.extend((0..12 * bytes_per_pixel).map(|at| (at * 7 % 251) as u8));
    Some(seed)
}

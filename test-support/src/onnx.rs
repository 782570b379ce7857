//! Writes small ONNX models: messages of protobuf, by hand.

use gleaner_protocol::inference::Element;

/// Types of elements, by their number in ONNX.
pub const FLOAT32: i64 = 1;
pub const UINT8: i64 = 2;
pub const INT8: i64 = 3;
pub const INT16: i64 = 5;
pub const INT32: i64 = 6;
pub const INT64: i64 = 7;
pub const STRING: i64 = 8;
pub const BOOL: i64 = 9;
pub const FLOAT16: i64 = 10;
pub const FLOAT64: i64 = 11;

pub fn number_of(element: Element) -> i64 {
    match element {
        Element::Float32 => FLOAT32,
        Element::Float16 => FLOAT16,
        Element::Float64 => FLOAT64,
        Element::Int8 => INT8,
        Element::Int16 => INT16,
        Element::Int32 => INT32,
        Element::Int64 => INT64,
        Element::Uint8 => UINT8,
        Element::Boolean => BOOL,
    }
}

/// A length that may be any.
pub const ANY: i64 = -1;

/// A protobuf message.
#[derive(Clone, Default)]
pub struct Proto(pub Vec<u8>);

impl Proto {
    fn varint(&mut self, mut value: u64) {
        while value >= 0x80 {
            self.0.push(value as u8 | 0x80);
            value >>= 7;
        }
        self.0.push(value as u8);
    }

    pub fn number(mut self, field: u64, value: i64) -> Proto {
        self.varint(field << 3);
        self.varint(value as u64);
        self
    }

    pub fn bytes(mut self, field: u64, bytes: &[u8]) -> Proto {
        self.varint(field << 3 | 2);
        self.varint(bytes.len() as u64);
        self.0.extend_from_slice(bytes);
        self
    }

    pub fn text(self, field: u64, text: &str) -> Proto {
        self.bytes(field, text.as_bytes())
    }

    pub fn message(self, field: u64, message: &Proto) -> Proto {
        self.bytes(field, &message.0)
    }

    pub fn messages(self, field: u64, messages: &[Proto]) -> Proto {
        messages.iter().fold(self, |proto, message| proto.message(field, message))
    }
}

/// Returns an input or output that is a tensor.
pub fn value(name: &str, element: i64, shape: &[i64]) -> Proto {
    let dimensions: Vec<Proto> = shape
        .iter()
        .map(|length| match *length {
            ANY => Proto::default().text(2, "any"),
            length => Proto::default().number(1, length),
        })
        .collect();
    let shape = Proto::default().messages(1, &dimensions);
    value_of(name, &Proto::default().number(1, element).message(2, &shape))
}

/// Returns an input or output of a type of tensor.
pub fn value_of(name: &str, tensor: &Proto) -> Proto {
    Proto::default().text(1, name).message(2, &Proto::default().message(1, tensor))
}

pub fn node(operator: &str, inputs: &[&str], outputs: &[&str], attributes: &[Proto]) -> Proto {
    let named = inputs.iter().fold(Proto::default(), |proto, name| proto.text(1, name));
    let named = outputs.iter().fold(named, |proto, name| proto.text(2, name));
    named.text(4, operator).messages(5, attributes)
}

pub fn graph_attribute(name: &str, graph: &Proto) -> Proto {
    Proto::default().text(1, name).message(6, graph).number(20, 5)
}

pub fn number_attribute(name: &str, number: i64) -> Proto {
    Proto::default().text(1, name).number(3, number).number(20, 2)
}

pub fn numbers_attribute(name: &str, numbers: &[i64]) -> Proto {
    let attribute = Proto::default().text(1, name);
    numbers.iter().fold(attribute, |proto, number| proto.number(8, *number)).number(20, 7)
}

pub fn constant(name: &str, element: i64, shape: &[i64], bytes: &[u8]) -> Proto {
    let dimensions = shape.iter().fold(Proto::default(), |proto, length| proto.number(1, *length));
    dimensions.number(2, element).text(8, name).bytes(9, bytes)
}

/// Returns a constant whose data is in another file.
pub fn external(name: &str, location: &str) -> Proto {
    let entry = Proto::default().text(1, "location").text(2, location);
    let tensor = Proto::default().number(1, 1).number(2, FLOAT32).text(8, name);
    tensor.message(13, &entry).number(14, 1)
}

pub fn graph(nodes: &[Proto], constants: &[Proto], inputs: &[Proto], outputs: &[Proto]) -> Proto {
    let nodes = Proto::default().messages(1, nodes).text(2, "test");
    nodes.messages(5, constants).messages(11, inputs).messages(12, outputs)
}

pub fn model(graph: &Proto) -> Vec<u8> {
    model_with_opset(graph, 17)
}

/// Returns a model that needs a version of the standard operators.
pub fn model_with_opset(graph: &Proto, version: i64) -> Vec<u8> {
    let opset = Proto::default().number(2, version);
    Proto::default().number(1, 8).message(7, graph).message(8, &opset).0
}

/// Returns a model with one node, whose input is `x` and whose output is `y`.
pub fn unary(operator: &str, element: i64, shape: &[i64]) -> Vec<u8> {
    with_node(node(operator, &["x"], &["y"], &[]), element, shape)
}

fn with_node(node: Proto, element: i64, shape: &[i64]) -> Vec<u8> {
    model(&graph(&[node], &[], &[value("x", element, shape)], &[value("y", element, shape)]))
}

/// Returns a model that adds `x` to itself.
pub fn doubled(element: i64, shape: &[i64]) -> Vec<u8> {
    with_node(node("Add", &["x", "x"], &["y"], &[]), element, shape)
}

/// Returns a model of an endless loop. Its input has any length, so that it does not run at its
/// start.
pub fn endless(shape: &[i64]) -> Vec<u8> {
    let body = graph(
        &[
            node("Identity", &["more"], &["more_out"], &[]),
            node("Add", &["v", "v"], &["v_out"], &[]),
        ],
        &[],
        &[value("i", INT64, &[]), value("more", BOOL, &[]), value("v", FLOAT32, shape)],
        &[value("more_out", BOOL, &[]), value("v_out", FLOAT32, shape)],
    );
    model(&graph(
        &[node("Loop", &["", "forever", "x"], &["y"], &[graph_attribute("body", &body)])],
        &[constant("forever", BOOL, &[], &[1])],
        &[value("x", FLOAT32, shape)],
        &[value("y", FLOAT32, shape)],
    ))
}

/// Returns a model with as many elements as its input requests.
pub fn as_many_as_requested() -> Vec<u8> {
    model(&graph(
        &[node("ConstantOfShape", &["x"], &["y"], &[])],
        &[],
        &[value("x", INT64, &[1])],
        &[value("y", FLOAT32, &[ANY])],
    ))
}

/// Returns a model that multiplies `x` of shape [?, 3] by a constant of shape [3, 2].
pub fn product() -> Vec<u8> {
    let weights: Vec<u8> =
        [1_f32, 2., 3., 4., 5., 6.].iter().flat_map(|it| it.to_le_bytes()).collect();
    model(&graph(
        &[node("MatMul", &["x", "w"], &["y"], &[])],
        &[constant("w", FLOAT32, &[3, 2], &weights)],
        &[value("x", FLOAT32, &[ANY, 3])],
        &[value("y", FLOAT32, &[ANY, 2])],
    ))
}

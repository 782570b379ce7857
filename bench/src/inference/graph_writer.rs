//! Writes graphs of convolutions with random weights, as ONNX files.

use gleaner_test_support::onnx::{self, FLOAT32, INT64, Proto, node};

/// A graph that grows node by node.
pub(super) struct GraphWriter {
    nodes: Vec<Proto>,
    constants: Vec<Proto>,
    weights: SeededNormal,
    names: usize,
    /// Number of weights and biases.
    pub(super) parameters: usize,
}

/// A value of a graph: a square picture, of [1, channels, side, side].
#[derive(Clone)]
pub(super) struct Picture {
    pub(super) name: String,
    pub(super) channels: usize,
    pub(super) side: usize,
}

/// Form of a convolution whose output has the side of its input, divided by `stride`.
#[derive(Clone, Copy)]
pub(super) struct ConvForm {
    pub(super) channels: usize,
    pub(super) kernel: usize,
    pub(super) stride: usize,
    pub(super) groups: usize,
    /// Mean of the biases.
    pub(super) bias: f32,
    /// Factor of the weights.
    pub(super) gain: f32,
}

/// Returns the form of a convolution with stride 1, in one group.
pub(super) fn plain(channels: usize, kernel: usize) -> ConvForm {
    ConvForm { channels, kernel, stride: 1, groups: 1, bias: 0.0, gain: 1.0 }
}

/// Normally distributed numbers, the same on every machine: sums of uniform ones, by SplitMix64.
struct SeededNormal(u64);

impl SeededNormal {
    fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^= mixed >> 31;
        // Four uniform numbers of 16 bits: their sum has the variance of 65,536² / 3.
        let sum: u64 = [0, 16, 32, 48].iter().map(|shift| mixed >> shift & 0xffff).sum();
        (sum as f32 - 131_070.0) * (3.0_f32.sqrt() / 65_536.0)
    }

    /// Numbers of this mean and deviation, as bytes.
    fn bytes(&mut self, count: usize, mean: f32, deviation: f32) -> Vec<u8> {
        (0..count).flat_map(|_| (mean + deviation * self.next()).to_le_bytes()).collect()
    }
}

/// Returns an attribute that is a list of integers.
pub(super) fn integers(name: &str, numbers: &[usize]) -> Proto {
    let listed = Proto::default().text(1, name);
    numbers.iter().fold(listed, |proto, number| proto.number(8, *number as i64)).number(20, 7)
}

/// Returns an attribute that is a text.
pub(super) fn text(name: &str, value: &str) -> Proto {
    Proto::default().text(1, name).text(4, value).number(20, 3)
}

/// Returns an attribute with the axis of an operator.
pub(super) fn axis(number: i64) -> Proto {
    onnx::number_attribute("axis", number)
}

impl GraphWriter {
    pub(super) fn new(seed: u64) -> Self {
        let (nodes, constants) = (Vec::new(), Vec::new());
        Self { nodes, constants, weights: SeededNormal(seed), names: 0, parameters: 0 }
    }

    fn name(&mut self) -> String {
        self.names += 1;
        format!("v{}", self.names)
    }

    /// Adds a node with one output; returns its name.
    pub(super) fn node(&mut self, operator: &str, inputs: &[&str], attributes: &[Proto]) -> String {
        let output = self.name();
        self.nodes.push(node(operator, inputs, &[&output], attributes));
        output
    }

    /// Adds a node with one output of this name.
    pub(super) fn last(&mut self, operator: &str, inputs: &[&str], name: &str, how: &[Proto]) {
        self.nodes.push(node(operator, inputs, &[name], how));
    }

    /// Splits a value along an axis into pieces of these lengths.
    pub(super) fn split<const N: usize>(
        &mut self,
        value: &str,
        along: i64,
        lengths: [usize; N],
    ) -> [String; N] {
        let lengths = self.shape(&lengths.map(|length| length as i64));
        let outputs = [(); N].map(|()| self.name());
        let names = outputs.each_ref().map(String::as_str);
        self.nodes.push(node("Split", &[value, &lengths], &names, &[axis(along)]));
        outputs
    }

    /// Adds a constant of floats.
    pub(super) fn floats(&mut self, shape: &[i64], values: &[f32]) -> String {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        self.constant(FLOAT32, shape, &bytes)
    }

    /// Adds a constant list of integers, such as a shape.
    pub(super) fn shape(&mut self, lengths: &[i64]) -> String {
        let bytes: Vec<u8> = lengths.iter().flat_map(|length| length.to_le_bytes()).collect();
        self.constant(INT64, &[lengths.len() as i64], &bytes)
    }

    fn constant(&mut self, element: i64, shape: &[i64], bytes: &[u8]) -> String {
        let name = self.name();
        self.constants.push(onnx::constant(&name, element, shape, bytes));
        name
    }

    /// Changes the shape of a value.
    pub(super) fn reshape(&mut self, value: &str, shape: &[i64]) -> String {
        let shape = self.shape(shape);
        self.node("Reshape", &[value, &shape], &[])
    }

    /// Adds a convolution without activation.
    pub(super) fn conv(&mut self, from: &Picture, form: ConvForm) -> Picture {
        let ConvForm { channels, kernel, stride, groups, bias, gain } = form;
        let fan_in = from.channels / groups * kernel * kernel;
        let count = channels * fan_in;
        // As He et al. for rectifiers. A SiLU passes less than half of a small variance; the
        // variance of the biases keeps it from vanishing, and nothing makes it grow.
        let deviation = gain * (2.0 / fan_in as f32).sqrt();
        let weights = self.weights.bytes(count, 0.0, deviation);
        let biases = self.weights.bytes(channels, bias, 0.5);
        self.parameters += count + channels;
        let lengths = [channels, from.channels / groups, kernel, kernel].map(|it| it as i64);
        let weights = self.constant(FLOAT32, &lengths, &weights);
        let biases = self.constant(FLOAT32, &[channels as i64], &biases);
        let attributes = [
            integers("kernel_shape", &[kernel; 2]),
            integers("strides", &[stride; 2]),
            integers("pads", &[kernel / 2; 4]),
            onnx::number_attribute("group", groups as i64),
        ];
        let name = self.node("Conv", &[&from.name, &weights, &biases], &attributes);
        Picture { name, channels, side: from.side / stride }
    }

    /// Adds a convolution with SiLU.
    pub(super) fn conv_silu(&mut self, from: &Picture, form: ConvForm) -> Picture {
        let conv = self.conv(from, form);
        let sigmoid = self.node("Sigmoid", &[&conv.name], &[]);
        let name = self.node("Mul", &[&conv.name, &sigmoid], &[]);
        Picture { name, ..conv }
    }

    pub(super) fn add(&mut self, a: &Picture, b: &Picture) -> Picture {
        Picture {
            name: self.node("Add", &[&a.name, &b.name], &[]),
            channels: a.channels,
            side: a.side,
        }
    }

    /// Puts the channels of pictures of one size behind each other.
    pub(super) fn concat(&mut self, parts: &[Picture]) -> Picture {
        let names: Vec<&str> = parts.iter().map(|part| part.name.as_str()).collect();
        let name = self.node("Concat", &names, &[axis(1)]);
        let channels = parts.iter().map(|part| part.channels).sum();
        Picture { name, channels, side: parts[0].side }
    }

    /// Returns the first and the second half of the channels.
    pub(super) fn halves(&mut self, from: &Picture) -> [Picture; 2] {
        let channels = from.channels / 2;
        self.split(&from.name, 1, [channels; 2]).map(|name| Picture { name, channels, ..*from })
    }

    /// Appends a max-pooling node of 5x5.
    pub(super) fn max_pool(&mut self, from: &Picture) -> Picture {
        let attributes = [
            integers("kernel_shape", &[5; 2]),
            integers("strides", &[1; 2]),
            integers("pads", &[2; 4]),
        ];
        Picture { name: self.node("MaxPool", &[&from.name], &attributes), ..*from }
    }

    /// Doubles the size.
    pub(super) fn upsample(&mut self, from: &Picture) -> Picture {
        let scales = self.floats(&[4], &[1.0, 1.0, 2.0, 2.0]);
        let attributes = [
            text("mode", "nearest"),
            text("coordinate_transformation_mode", "asymmetric"),
            text("nearest_mode", "floor"),
        ];
        let name = self.node("Resize", &[&from.name, "", &scales], &attributes);
        Picture { name, side: 2 * from.side, ..*from }
    }

    /// Returns the file of a model with one input and one output.
    pub(super) fn finish(self, input: (&str, &[i64]), output: (&str, &[i64])) -> Vec<u8> {
        let value = |(name, shape): (&str, &[i64])| onnx::value(name, FLOAT32, shape);
        let (inputs, outputs) = ([value(input)], [value(output)]);
        onnx::model(&onnx::graph(&self.nodes, &self.constants, &inputs, &outputs))
    }
}

//! Graphs of the shape of YOLO11, with random weights: for measurements, as the licence of the
//! trained models (AGPL-3.0) does not allow Gleaner to ship them.
//!
//! Blocks, channels and repetitions are those of the published architecture: a backbone of
//! convolutions and `C3k2` blocks, pooling (`SPPF`), attention (`C2PSA`), a neck that mixes three
//! sizes, and a head that predicts boxes as distributions of distances. Written from that
//! description, not from the code.

use super::graph_writer::{ConvForm, GraphWriter, Picture, axis, integers, plain};

/// Width and height of the input in pixels.
const SIDE: usize = 640;

/// Number of classes.
const CLASSES: usize = 80;

/// Distances in the distribution of each side of a box.
const BINS: usize = 16;

/// Scale of the architecture.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum GraphScale {
    /// 2.6 million parameters.
    N,
    /// 20 million parameters.
    M,
}

impl GraphScale {
    /// Returns the number of channels of a layer that has `nominal` at full width.
    fn channels(self, nominal: usize) -> usize {
        match self {
            Self::N => nominal.min(1024) / 4,
            Self::M => nominal.min(512),
        }
    }

    /// Returns the factor of the last weights of the scores with which few of them are high, as in
    /// a trained model. Values vary more behind more channels.
    fn gain(self) -> f32 {
        match self {
            Self::N => 0.2,
            Self::M => 0.06,
        }
    }

    /// Returns whether each `C3k2` contains `C3k` blocks, not only the deep ones.
    fn is_deep(self) -> bool {
        self == Self::M
    }
}

/// A model of this scale, as a file, and its number of parameters.
pub fn yolo_shaped(scale: GraphScale) -> (Vec<u8>, usize) {
    let mut graph = YoloWriter { scale, writer: GraphWriter::new(11 + scale as u64) };
    let levels = graph.levels();
    graph.head(&levels);
    let parameters = graph.writer.parameters;
    let side = SIDE as i64;
    let output = [1, (4 + CLASSES) as i64, anchors(&levels) as i64];
    let file = graph.writer.finish(("images", &[1, 3, side, side]), ("output0", &output));
    (file, parameters)
}

fn anchors(levels: &[Picture]) -> usize {
    levels.iter().map(|level| level.side * level.side).sum()
}

struct YoloWriter {
    scale: GraphScale,
    writer: GraphWriter,
}

impl YoloWriter {
    /// Backbone and neck: pictures of 1/8, 1/16 and 1/32 of the input's size.
    fn levels(&mut self) -> [Picture; 3] {
        let input = Picture { name: "images".to_owned(), channels: 3, side: SIDE };
        let half = self.down(&input, 64);
        let quarter = self.down(&half, 128);
        let quarter = self.c3k2(&quarter, 256, false, 4);
        let eighth = self.down(&quarter, 256);
        let eighth = self.c3k2(&eighth, 512, false, 4);
        let sixteenth = self.down(&eighth, 512);
        let sixteenth = self.c3k2(&sixteenth, 512, true, 2);
        let deepest = self.down(&sixteenth, 1024);
        let deepest = self.c3k2(&deepest, 1024, true, 2);
        let deepest = self.pooled(&deepest);
        let deepest = self.attentive(&deepest);

        let mixed = self.writer.upsample(&deepest);
        let mixed = self.writer.concat(&[mixed, sixteenth]);
        let middle = self.c3k2(&mixed, 512, false, 2);
        let mixed = self.writer.upsample(&middle);
        let mixed = self.writer.concat(&[mixed, eighth]);
        let large = self.c3k2(&mixed, 256, false, 2);
        let mixed = self.down(&large, 256);
        let mixed = self.writer.concat(&[mixed, middle]);
        let middle = self.c3k2(&mixed, 512, false, 2);
        let mixed = self.down(&middle, 512);
        let mixed = self.writer.concat(&[mixed, deepest]);
        let small = self.c3k2(&mixed, 1024, true, 2);
        [large, middle, small]
    }

    /// A convolution that halves the size.
    fn down(&mut self, from: &Picture, nominal: usize) -> Picture {
        let channels = self.scale.channels(nominal);
        self.writer.conv_silu(from, ConvForm { stride: 2, ..plain(channels, 3) })
    }

    /// Two halves of the channels, one of them also through a block, and mixed. The block has
    /// `1 / share` of the channels.
    fn c3k2(&mut self, from: &Picture, nominal: usize, is_deep: bool, share: usize) -> Picture {
        let channels = self.scale.channels(nominal);
        let inner = channels / share;
        let both = self.writer.conv_silu(from, plain(2 * inner, 1));
        let [first, second] = self.writer.halves(&both);
        let block = if is_deep || self.scale.is_deep() {
            self.c3k(&second)
        } else {
            self.bottleneck(&second, inner / 2)
        };
        let all = self.writer.concat(&[first, second, block]);
        self.writer.conv_silu(&all, plain(channels, 1))
    }

    fn c3k(&mut self, from: &Picture) -> Picture {
        let inner = from.channels / 2;
        let mut deep = self.writer.conv_silu(from, plain(inner, 1));
        for _ in 0..2 {
            deep = self.bottleneck(&deep, inner);
        }
        let direct = self.writer.conv_silu(from, plain(inner, 1));
        let both = self.writer.concat(&[deep, direct]);
        self.writer.conv_silu(&both, plain(from.channels, 1))
    }

    fn bottleneck(&mut self, from: &Picture, inner: usize) -> Picture {
        let narrow = self.writer.conv_silu(from, plain(inner, 3));
        let wide = self.writer.conv_silu(&narrow, plain(from.channels, 3));
        self.writer.add(from, &wide)
    }

    /// `SPPF`: the largest values of ever larger squares.
    fn pooled(&mut self, from: &Picture) -> Picture {
        let mut pools = vec![self.writer.conv_silu(from, plain(from.channels / 2, 1))];
        for step in 0..3 {
            pools.push(self.writer.max_pool(&pools[step]));
        }
        let all = self.writer.concat(&pools);
        self.writer.conv_silu(&all, plain(from.channels, 1))
    }

    /// `C2PSA`: half of the channels through attention.
    fn attentive(&mut self, from: &Picture) -> Picture {
        let both = self.writer.conv_silu(from, plain(from.channels, 1));
        let [direct, half] = self.writer.halves(&both);
        let attended = self.attention(&half);
        let seen = self.writer.add(&half, &attended);
        let wide = self.writer.conv_silu(&seen, plain(2 * half.channels, 1));
        let narrow = self.writer.conv(&wide, plain(half.channels, 1));
        let seen = self.writer.add(&seen, &narrow);
        let all = self.writer.concat(&[direct, seen]);
        self.writer.conv_silu(&all, plain(from.channels, 1))
    }

    /// Attention of all cells to all others, with heads of 64 channels.
    fn attention(&mut self, from: &Picture) -> Picture {
        const HEAD: usize = 64;
        const KEY: usize = HEAD / 2;
        let heads = from.channels / HEAD;
        let cells = (from.side * from.side) as i64;
        let qkv = self.writer.conv(from, plain(from.channels + 2 * heads * KEY, 1));
        let shape = [1, heads as i64, (2 * KEY + HEAD) as i64, cells];
        let qkv = self.writer.reshape(&qkv.name, &shape);
        let [query, key, value] = self.writer.split(&qkv, 2, [KEY, KEY, HEAD]);
        let swap = integers("perm", &[0, 1, 3, 2]);
        let query = self.writer.node("Transpose", &[&query], std::slice::from_ref(&swap));
        let weights = self.writer.node("MatMul", &[&query, &key], &[]);
        let scale = self.writer.floats(&[], &[(KEY as f32).sqrt().recip()]);
        let weights = self.writer.node("Mul", &[&weights, &scale], &[]);
        let weights = self.writer.node("Softmax", &[&weights], &[axis(-1)]);
        let weights = self.writer.node("Transpose", &[&weights], &[swap]);
        let seen = self.writer.node("MatMul", &[&value, &weights], &[]);
        let shape = [1, from.channels as i64, from.side as i64, from.side as i64];
        let seen = Picture { name: self.writer.reshape(&seen, &shape), ..from.clone() };
        let value = Picture { name: self.writer.reshape(&value, &shape), ..from.clone() };
        let depthwise = ConvForm { groups: from.channels, ..plain(from.channels, 3) };
        let position = self.writer.conv(&value, depthwise);
        let seen = self.writer.add(&seen, &position);
        self.writer.conv(&seen, plain(from.channels, 1))
    }

    /// The head: boxes by centre and size in pixels of the input, and scores.
    fn head(&mut self, levels: &[Picture; 3]) {
        let anchors = anchors(levels) as i64;
        let of_boxes = (levels[0].channels / 4).max(4 * BINS);
        let of_scores = levels[0].channels.max(CLASSES);
        let mut rows = Vec::new();
        for level in levels {
            let boxes = self.writer.conv_silu(level, plain(of_boxes, 3));
            let boxes = self.writer.conv_silu(&boxes, plain(of_boxes, 3));
            let boxes = self.writer.conv(&boxes, plain(4 * BINS, 1));
            let scores = self.separable(level, of_scores);
            let scores = self.separable(&scores, of_scores);
            let last = ConvForm { bias: -4.0, gain: self.scale.gain(), ..plain(CLASSES, 1) };
            let scores = self.writer.conv(&scores, last);
            let both = self.writer.concat(&[boxes, scores]);
            let shape = [1, both.channels as i64, (both.side * both.side) as i64];
            rows.push(self.writer.reshape(&both.name, &shape));
        }
        let rows: Vec<&str> = rows.iter().map(String::as_str).collect();
        let all = self.writer.node("Concat", &rows, &[axis(2)]);
        let [boxes, scores] = self.writer.split(&all, 1, [4 * BINS, CLASSES]);
        let boxes = self.distances(&boxes, anchors);
        let boxes = self.boxes(&boxes, levels);
        let scores = self.writer.node("Sigmoid", &[&scores], &[]);
        self.writer.last("Concat", &[&boxes, &scores], "output0", &[axis(1)]);
    }

    /// A convolution of each channel alone, and one of all channels.
    fn separable(&mut self, from: &Picture, channels: usize) -> Picture {
        let depthwise = ConvForm { groups: from.channels, ..plain(from.channels, 3) };
        let each = self.writer.conv_silu(from, depthwise);
        self.writer.conv_silu(&each, plain(channels, 1))
    }

    /// The means of the distributions of distances: [1, 4, anchors].
    fn distances(&mut self, boxes: &str, anchors: i64) -> String {
        let shaped = self.writer.reshape(boxes, &[1, 4, BINS as i64, anchors]);
        let swap = integers("perm", &[0, 2, 1, 3]);
        let shaped = self.writer.node("Transpose", &[&shaped], &[swap]);
        let shares = self.writer.node("Softmax", &[&shaped], &[axis(1)]);
        let bins: Vec<f32> = (0..BINS).map(|bin| bin as f32).collect();
        let bins = self.writer.floats(&[1, BINS as i64, 1, 1], &bins);
        // rten 0.27 refuses a convolution without its strides, although they have a default.
        let how = [integers("kernel_shape", &[1; 2]), integers("strides", &[1; 2])];
        let means = self.writer.node("Conv", &[&shares, &bins], &how);
        self.writer.reshape(&means, &[1, 4, anchors])
    }

    /// Centre and size in pixels of boxes that are given by distances from the cells' centres.
    fn boxes(&mut self, distances: &str, levels: &[Picture; 3]) -> String {
        let (mut across, mut down, mut strides) = (Vec::new(), Vec::new(), Vec::new());
        for level in levels {
            for cell in 0..level.side * level.side {
                across.push((cell % level.side) as f32 + 0.5);
                down.push((cell / level.side) as f32 + 0.5);
                strides.push((SIDE / level.side) as f32);
            }
        }
        let count = strides.len() as i64;
        let centres = self.writer.floats(&[1, 2, count], &[across, down].concat());
        let strides = self.writer.floats(&[1, 1, count], &strides);
        let two = self.writer.floats(&[], &[2.0]);
        let [before, after] = self.writer.split(distances, 1, [2, 2]);
        let start = self.writer.node("Sub", &[&centres, &before], &[]);
        let end = self.writer.node("Add", &[&centres, &after], &[]);
        let sum = self.writer.node("Add", &[&start, &end], &[]);
        let middle = self.writer.node("Div", &[&sum, &two], &[]);
        let size = self.writer.node("Sub", &[&end, &start], &[]);
        let boxes = self.writer.node("Concat", &[&middle, &size], &[axis(1)]);
        self.writer.node("Mul", &[&boxes, &strides], &[])
    }
}

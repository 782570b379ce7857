//! The parts that a sample passes on its way into a lambda, one by one: `cargo xtask bench parts`.
//!
//! Each is measured alone, in a loop, with its data in the cache. So the numbers compare two
//! versions of a part; they are no latencies of a vehicle.
#![allow(unsafe_code)]

use bench_kernels::Work;
use divan::counter::BytesCount;
use divan::{Bencher, black_box};
use gleaner_buffers::shared::{
    ControlPage, META_WORDS, PinLimits, SharedLayout, SharedReader, SharedWriter, in_process,
};
use gleaner_buffers::{HeapRegion, Pool, RingReader, RingWriter, ring};
use gleaner_messages::{Definitions, Endian, FieldPath};
use gleaner_pixels::vision::{DetectorLayout, OutputView, Placed, Preparer, Wanted, detect};
use gleaner_rules::pixels::{Encoding, View};

/// Bytes of an IMU sample.
const IMU: usize = 324;
/// Samples of a window of one second at 100 Hz.
const WINDOW: usize = 100;

fn main() {
    divan::main();
}

/// A ring in the memory of the process, as in a replay, with samples of an IMU.
fn own_ring() -> (RingWriter<u64>, RingReader<u64>) {
    let (depth, slots) = (512, 1024);
    let bytes = Pool::<u64>::bytes_needed(slots, IMU).expect("it fits");
    let region = HeapRegion::zeroed(bytes).expect("there is memory");
    let pool = Pool::new(region, slots, IMU).expect("a pool");
    let (mut writer, reader) = ring(pool, depth).expect("a ring");
    for value in 0..depth as u64 {
        publish_own(&mut writer, value);
    }
    (writer, reader)
}

fn publish_own(writer: &mut RingWriter<u64>, value: u64) {
    let mut draft = writer.draft(IMU).expect("a free slot");
    draft.fill(value as u8);
    assert!(writer.publish(draft, value).is_ok(), "the draft is of this ring");
}

/// A ring in shared memory, as the ingress has it, with samples of an IMU.
fn shared_ring() -> (SharedWriter, SharedReader) {
    let limits = PinLimits { first_word: 0, windows: 2, window: WINDOW as u16, singles: 2 };
    let depth = 512;
    let layout = SharedLayout { depth, slots: depth + limits.quota() + 1, slot_bytes: IMU as u64 };
    let (memory, reading) = in_process(layout).expect("a ring");
    let (mut writer, control) = (SharedWriter::new(memory), ControlPage::on_heap());
    writer.attach(control.clone(), limits).expect("a first reader");
    // SAFETY: the page is attached with these limits, and nothing else stores to it.
    let reader = unsafe { SharedReader::new(&reading, control, limits) }.expect("a reader");
    for value in 0..u64::from(depth) {
        publish_shared(&mut writer, value);
    }
    (writer, reader)
}

fn publish_shared(writer: &mut SharedWriter, value: u64) {
    writer.draft(IMU).expect("a free slot").fill(value as u8);
    writer.publish(&[value; META_WORDS]).expect("a draft");
}

#[divan::bench]
fn own_ring_publish(bencher: Bencher<'_, '_>) {
    let (mut writer, _reader) = own_ring();
    bencher.bench_local(|| publish_own(&mut writer, black_box(7)));
}

#[divan::bench]
fn own_ring_newest(bencher: Bencher<'_, '_>) {
    let (_writer, reader) = own_ring();
    bencher.bench_local(|| reader.newest().map(|lease| *lease.meta()));
}

#[divan::bench]
fn own_ring_window(bencher: Bencher<'_, '_>) {
    let (_writer, reader) = own_ring();
    let mut leases = Vec::new();
    bencher.bench_local(|| {
        reader.last(WINDOW, &mut leases);
        leases.len()
    });
}

#[divan::bench]
fn shared_ring_publish(bencher: Bencher<'_, '_>) {
    let (mut writer, _reader) = shared_ring();
    bencher.bench_local(|| publish_shared(&mut writer, black_box(7)));
}

#[divan::bench]
fn shared_ring_newest(bencher: Bencher<'_, '_>) {
    let (_writer, reader) = shared_ring();
    bencher.bench_local(|| reader.newest_before(u64::MAX).expect("a hold").is_some());
}

#[divan::bench]
fn shared_ring_window(bencher: Bencher<'_, '_>) {
    let (_writer, reader) = shared_ring();
    bencher.bench_local(|| reader.last_before(u64::MAX, WINDOW as u32).expect("a hold").is_some());
}

/// A camera's slot of 1080p, filled and published.
#[divan::bench]
fn slot_of_an_image(bencher: Bencher<'_, '_>) {
    const BYTES: usize = 1920 * 1080 * 3;
    let bytes = Pool::<u64>::bytes_needed(4, BYTES).expect("it fits");
    let region = HeapRegion::zeroed(bytes).expect("there is memory");
    let pool = Pool::new(region, 4, BYTES).expect("a pool");
    let (mut writer, _reader) = ring(pool, 2).expect("a ring");
    let image = vec![7; BYTES];
    bencher.counter(BytesCount::new(BYTES)).bench_local(|| {
        let mut draft = writer.draft(BYTES).expect("a free slot");
        draft.copy_from_slice(black_box(&image));
        writer.publish(draft, 0).is_ok()
    });
}

/// A number at a fixed place, and one behind a text and an array of texts.
#[divan::bench(args = ["fixed", "numbers[2]", "behind"])]
fn field(bencher: Bencher<'_, '_>, path: &str) {
    let text = "float64 fixed\nstring name\nfloat64[] numbers\nstring[] labels\nfloat64 behind\n";
    let definitions = Definitions::parse("bench_msgs/msg/Fields", text).expect("definitions");
    let field = FieldPath::compile(&definitions, path).expect("a field");
    let mut cdr = 1.5_f64.to_le_bytes().to_vec();
    let text = |cdr: &mut Vec<u8>, text: &str| {
        cdr.resize(cdr.len().next_multiple_of(4), 0);
        cdr.extend((text.len() as u32 + 1).to_le_bytes());
        cdr.extend(text.as_bytes());
        cdr.push(0);
    };
    text(&mut cdr, "the name of something");
    cdr.resize(cdr.len().next_multiple_of(4), 0);
    cdr.extend(3_u32.to_le_bytes());
    cdr.resize(cdr.len().next_multiple_of(8), 0);
    (0..3).for_each(|number| cdr.extend(f64::from(number).to_le_bytes()));
    cdr.extend(8_u32.to_le_bytes());
    (0..8).for_each(|_| text(&mut cdr, "label"));
    cdr.resize(cdr.len().next_multiple_of(8), 0);
    cdr.extend(2.5_f64.to_le_bytes());
    bencher.bench_local(|| {
        field.number(black_box(&cdr), Endian::Little).expect("the message has this field")
    });
}

/// A frame of 1080p in a tensor of 640x640, with its border.
#[divan::bench]
fn letterbox(bencher: Bencher<'_, '_>) {
    let (width, height) = (1920, 1080);
    let pixels = vec![90; (width * height * 3) as usize];
    let view =
        View::new(width, height, width * 3, Encoding::Bgr8, false, &pixels).expect("a frame");
    let shape = [Some(1), Some(3), Some(640), Some(640)];
    let how = DetectorLayout::Ultralytics.preprocess(&shape).expect("an input");
    let (mut preparer, mut tensor) = (Preparer::new(), Vec::new());
    bencher.bench_local(|| {
        preparer.prepare(black_box(&view), &how, &mut tensor).expect("a tensor").scale_x
    });
}

/// Boxes of 8,400 anchors in 80 classes, of which some hundreds overlap.
#[divan::bench]
fn non_maximum_suppression(bencher: Bencher<'_, '_>) {
    const ANCHORS: usize = 8400;
    const ROWS: usize = 84;
    let mut values = vec![0.0_f32; ROWS * ANCHORS];
    for anchor in 0..ANCHORS {
        let place = (anchor % 80) as f32 * 8.0;
        for (row, value) in [place, place * 0.7, 40.0, 60.0].into_iter().enumerate() {
            values[row * ANCHORS + anchor] = value;
        }
        if anchor.is_multiple_of(20) {
            values[(4 + anchor % 80) * ANCHORS + anchor] = 0.5 + (anchor % 400) as f32 / 1000.0;
        }
    }
    let placed = Placed {
        scale_x: 1.0 / 3.0,
        scale_y: 1.0 / 3.0,
        left: 0.0,
        top: 140.0,
        frame_width: 1920,
        frame_height: 1080,
        tensor_width: 640,
        tensor_height: 640,
    };
    let wanted = Wanted { classes: None, min_score: 0.25, max_iou: 0.45, max_count: 300 };
    let shape = [1, ROWS as u32, ANCHORS as u32];
    bencher.bench_local(|| {
        let output = OutputView { shape: &shape, values: black_box(&values) };
        detect(DetectorLayout::Ultralytics, &[output], &placed, &wanted).expect("boxes").len()
    });
}

/// Kernels of the SDK, natively; `cargo xtask bench kernels` compares them with a component.
#[divan::bench(args = ["spectrum-256-f64", "spectrum-1024-f64", "luma", "histogram", "downscale"])]
fn kernel(bencher: Bencher<'_, '_>, name: &str) {
    let mut work = Work::new(name).expect("a kernel");
    bencher.bench_local(|| work.round().expect("a result"));
}

//! Seeds: programs of `driver`, one for each of its calls, and some longer ones.

use gleaner_test_support::operations::Operation::{Append, ScratchGet, ScratchPut, Start};
use gleaner_test_support::operations::Operation::{
    AsFrame, Event, Field, Histogram, Last, Log, MeanLuma, Resize, ToGray,
};
use gleaner_test_support::operations::{DriverStep, Extra, Operation, setup};

use crate::calls::{WAKE, program};

/// Dictionary of programs: paths, names of inputs, and arguments. Calls that need earlier calls are
/// in the seeds.
pub const WORDS: &[&str] = &[
    "WAKE",
    "program",
    "raw",
    "coded",
    "data[3]",
    "width",
    "header.frame_id",
    "header.stamp.sec",
    // All samples of an input.
    "\u{1}\u{7f}\u{7f}\0\0",
    // A frame in another size.
    "\0\0 \u{10}",
    // Too much memory, and the longest text.
    "\0\0\u{7f}\0",
    "\0\0\0\u{4}\0",
];

pub fn all() -> Vec<Vec<u8>> {
    let operations = || {
        Operation::ALL
            .iter()
            .map(|operation| DriverStep::Call(*operation).with(arguments(*operation)))
    };
    let extras = Extra::ALL.map(|extra| DriverStep::Extra(extra).with(extra_arguments(extra)));
    let prelude = prelude();
    let mut seeds: Vec<_> =
        operations().chain(extras).map(|step| wake(&[&prelude[..], &step].concat())).collect();
    let each: Vec<_> = operations().flatten().collect();
    let made =
        program(&[(Resize, &[0, 0, 60, 50]), (Resize, &[1, 0, 9, 9]), (ToGray, &[0])]).repeat(9);
    let forget = |frame| DriverStep::Extra(Extra::ForgetFrame).with(&[frame]);
    let last = program(&[(Resize, &[1, 0, 0, 0])]);
    let frames = [&prelude[..], &made, &forget(3), &forget(0), &last].concat();
    let scratch = program(&[
        (ScratchPut, &[0, 0, 0, 2, 0]),
        (ScratchPut, &[1, 0, 0, 2, 0]),
        (Append, &[2, 255, 255]),
        (ScratchGet, &[1, 1, 0, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0]),
    ]);
    let trigger = |n| DriverStep::Call(Event).with(&[1, b'a' + n, 0, 0, 0, 0, 0, 0, 240, 63]);
    let triggers: Vec<u8> = (0..20).flat_map(trigger).collect();
    let long = [255, 0, 0, 31, 0];
    let logging = [
        DriverStep::Call(Log).with(&[1]),
        DriverStep::Extra(Extra::Print).with(&[]),
        DriverStep::Call(Start).with(&[]),
    ];
    let texts = logging.map(|step| [&step[..], &long].concat()).concat();
    let panic = DriverStep::Extra(Extra::Panic).with(&[0xba, 3, b'n', b'o', b'!']);
    let exit = DriverStep::Extra(Extra::Exit).with(&[0xba, 3]);
    let memory = DriverStep::Extra(Extra::Allocate).with(&[255, 255, 127, 0]);
    let much = program(&[(Histogram, &[0, 0]), (Last, &[1, 4, 0, 0, 0])]).repeat(70);
    let fuel = [&prelude[..], &much].concat();
    let others = [0x12_u8, 0x51, 2, 3, 4, 0x88, 4, 9, 9, 9, 9];
    let glance = program(&[(AsFrame, &[0]), (MeanLuma, &[2, 0])]);
    let kept = [wake(&frames), wake(&glance), wake(&panic), wake(&prelude)].join(WAKE);
    let changed = [
        vec![1, 0x12, 200, 0, 3],
        vec![0x5e, 30, 1, 8, 0, 255, 40, 0, 9, 3, 0, 1],
        vec![0x83, 1, 2, 3, 2],
    ];
    let light = DriverStep::Call(Histogram).with(&[0, 0]);
    seeds.extend(changed.map(|pictures| [&pictures[..], &prelude, &light].concat()));
    for program in
        [&each[..], &frames, &scratch, &triggers, &texts, &panic, &exit, &memory, &fuel, &others]
    {
        seeds.push(wake(program));
    }
    seeds.push(kept);
    seeds.push(
        [wake(&scratch), wake(&memory), wake(&scratch), wake(&exit), wake(&triggers)].join(WAKE),
    );
    seeds
}

/// [`setup`], plus a field and the frame of the coded camera.
fn prelude() -> Vec<u8> {
    [setup(), program(&[(Field, &[2, 0, 5]), (AsFrame, &[1])])].concat()
}

/// A wake with the first picture of each kind.
fn wake(program: &[u8]) -> Vec<u8> {
    [&[0, 0], program].concat()
}

/// Arguments of the operation's most expensive call; dummy arguments if it has none.
fn arguments(operation: Operation) -> &'static [u8] {
    operation.price().calls().map_or(&[0, 0, 8, 0, 0, 0], |[_, (arguments, _)]| arguments)
}

/// Arguments of a step that is not a call.
fn extra_arguments(extra: Extra) -> &'static [u8] {
    match extra {
        Extra::Reset | Extra::Wasi => &[],
        Extra::ForgetTopic | Extra::ForgetField | Extra::ForgetSample | Extra::ForgetFrame => &[1],
        Extra::ForgetTensor => &[0],
        Extra::EventWithTexts => {
            &[1, b'k', 0, 0, 0, 0, 0, 0, 224, 63, 1, b't', 4, b't', b'e', b'x', b't']
        }
        Extra::EventWithMany => &[9],
        Extra::ColumnAtOnce => &[1, 2],
        Extra::ScratchPutText | Extra::Print | Extra::PrintError => &[4, b'w', b'o', b'r', b'd'],
        Extra::Allocate => &[1, 4, 0, 0],
        Extra::Panic | Extra::Exit => &[0],
    }
}

//! Programs of `driver`: one for each of its calls, and some that go on for longer.

use crate::calls::WAKE;

/// Words of programs: calls that need others before them, paths, and names of inputs.
pub const WORDS: &[&str] = &[
    "WAKE",
    "program",
    "raw",
    "coded",
    "data[3]",
    "width",
    "header.frame_id",
    "header.stamp.sec",
    // Both cameras.
    "\0\u{1}\0\u{2}",
    // The newest sample of an input, and its picture.
    "\u{5}\u{1}\u{11}\u{1}",
    "\u{5}\u{2}\u{11}\u{2}",
    // All samples of an input.
    "\u{6}\u{1}\u{7f}\u{7f}\0\0",
    // Fields, and a column.
    "\t\u{1}\u{2}",
    "\t\u{2}\u{4}",
    "\n\0\0\u{4}\0\0\0",
    // A picture in another size, and in grey.
    "\u{18}\0 \u{10}",
    "\u{19}\0",
    // Too much memory, and as much as may be said.
    ",\0\0\u{7f}\0",
    "0\0\0\0\u{4}\0",
];

/// Both cameras, a field of each, their newest samples, and their pictures. What comes first is the program itself.
const LOOKED: &[u8] = &[0, 0, 0, 1, 0, 2, 9, 0, 0, 9, 1, 2, 9, 2, 4, 5, 1, 5, 2, 17, 1, 17, 2];

const CALLS: u8 = 54;

/// All seeds.
pub fn all() -> Vec<Vec<u8>> {
    let mut seeds: Vec<_> = (0..CALLS).map(|call| wake(&[LOOKED, &arguments(call)].concat())).collect();
    let each: Vec<_> = (0..CALLS).filter(|call| !(39..=47).contains(call)).flat_map(arguments).collect();
    let frames: Vec<u8> = [LOOKED, &[24, 0, 60, 50, 24, 1, 9, 9, 25, 0].repeat(9), &[42, 3, 42, 0, 23, 1]].concat();
    let scratch = [[48, 0, 0, 0, 2, 0], [48, 1, 0, 0, 2, 0], [49, 2, 255, 255, 52, 0], [51, 1, 1, 0, 0, 0]].concat();
    let triggers: Vec<u8> = (0..20).flat_map(|n| [27, 1, b'a' + n, 0, 0, 0, 0, 0, 0, 240, 63]).collect();
    let texts = [[32, 1, 255, 0, 0, 31, 0], [33, 255, 0, 0, 31, 0, 53], [28, 255, 0, 0, 31, 0, 3]].concat();
    let (panic, exit, memory) = ([46, 0xba, 3, b'n', b'o', b'!'], [47, 0xba, 3], [44, 255, 255, 127, 0]);
    let fuel = [LOOKED, &[22, 0, 0, 6, 1, 4, 0, 0, 0].repeat(70)].concat();
    let others = [0x12_u8, 0x51, 2, 3, 4, 0x88, 4, 9, 9, 9, 9];
    let kept = [wake(&frames), wake(&[17, 0, 21, 2, 0]), wake(&panic), wake(LOOKED)].join(WAKE);
    let changed = [vec![1, 0x12, 200, 0, 3], vec![0x5e, 30, 1, 8, 0, 255, 40, 0, 9, 3, 0, 1], vec![0x83, 1, 2, 3, 2]];
    seeds.extend(changed.map(|pictures| [&pictures[..], LOOKED, &[22, 0, 0]].concat()));
    for program in [&each[..], &frames, &scratch, &triggers, &texts, &panic, &exit, &memory, &fuel, &others] {
        seeds.push(wake(program));
    }
    seeds.push(kept);
    seeds.push([wake(&scratch), wake(&memory), wake(&scratch), wake(&exit), wake(&triggers)].join(WAKE));
    seeds
}

/// A wake with the first picture of each kind.
fn wake(program: &[u8]) -> Vec<u8> {
    [&[0, 0], program].concat()
}

/// A call, with arguments that name what [`LOOKED`] made.
fn arguments(call: u8) -> Vec<u8> {
    let text = |text: &str| [&[call, text.len() as u8][..], text.as_bytes()].concat();
    match call {
        1 => text("coded"),
        8 => [&[call, 1][..], &text("header.stamp.sec")[1..]].concat(),
        // The topic and its field.
        10 | 11 => vec![call, 1, 1, 3, 0, 0, 0, 0, 0, 0, 0],
        // The sample and its field.
        14 | 15 => vec![call, 1, 1],
        // A part of the picture.
        21 | 22 => vec![call, 0, 2, 3, 4, 9, 9],
        27 => [&text("dark")[..], &0.5_f64.to_le_bytes()].concat(),
        28 => [&text("k")[..], &0.5_f64.to_le_bytes(), &text("t")[1..], &text("text")[1..]].concat(),
        30 | 31 | 33 | 34 | 35 | 50 => text("word"),
        32 => [&[call, 1][..], &text("word")[1..]].concat(),
        37 => vec![call, 0, 8, 0, 0, 0, 8, 0, 0, 0, 100],
        46 | 47 => vec![call, 0],
        _ => vec![call, 1, 4, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0],
    }
}

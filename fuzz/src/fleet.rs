//! Fuzzes the messages between vehicles and the cloud: frames with their compressed parts,
//! enrolments, reports of clips, and orders for them.
//!
//! An input is a byte for the mode, then the bytes.

use gleaner_fleet::clips::{
    CLIP_FACTS_MAX, CLIP_MAX, CLIP_PART, ClipFacts, ClipId, ClipOrders, ClipReport,
};
use gleaner_fleet::{Body, Enrolment, Frame, LINES_MAX, decompress, desired_digest};

use crate::budget;
use crate::input::FuzzInput;

pub mod mode {
    /// A frame follows.
    pub const FRAME: u8 = 0;
    /// An enrolment follows.
    pub const ENROLMENT: u8 = 1;
    /// A report of clips follows.
    pub const CLIPS: u8 = 2;
    /// Orders for clips follow.
    pub const ORDERS: u8 = 3;
}

/// Memory budget: frames of these lengths have at most some thousand parts.
const MEMORY: usize = 2 << 20;
/// Memory budget of a compressed part: what it may have, twice while it grows, and the window.
const COMPRESSED: usize = 4 * LINES_MAX as usize;

/// Decodes the input. What is accepted is encoded and decoded again.
pub fn check(data: &[u8]) -> bool {
    let mut input = FuzzInput(data);
    match input.u8() {
        mode::ENROLMENT => enrolment(input.0),
        mode::CLIPS => clips(input.0),
        mode::ORDERS => orders(input.0),
        _ => frame(input.0),
    }
}

fn frame(bytes: &[u8]) -> bool {
    let Ok(frame) = budget::within(MEMORY, || Frame::decoded(bytes)) else { return false };
    let Some(body) = frame.body else { return false };
    let again = Frame::decoded(&Frame::encoded(body.clone())).expect("it was encoded here");
    assert_eq!(again.body.as_ref(), Some(&body));
    match body {
        Body::Desired(desired) => {
            let digest = desired_digest(&desired.deployments);
            let mut other = desired.deployments;
            other.push(Default::default());
            assert_ne!(desired_digest(&other), digest);
        }
        Body::Reported(reported) => part(&reported.status),
        Body::Records(records) => part(&records.lines),
        _ => {}
    }
    true
}

fn part(bytes: &[u8]) {
    if let Ok(whole) = budget::within(COMPRESSED, || decompress(bytes)) {
        assert!(whole.len() as u64 <= LINES_MAX);
    }
}

fn enrolment(bytes: &[u8]) -> bool {
    let Ok(enrolment) = budget::within(MEMORY, || Enrolment::parse(bytes)) else { return false };
    let text = serde_json::to_vec(&enrolment).expect("it is plain data");
    assert_eq!(Enrolment::parse(&text), Ok(enrolment));
    true
}

fn clips(bytes: &[u8]) -> bool {
    let report = budget::within(MEMORY, || serde_json::from_slice::<ClipReport>(bytes));
    let Ok(report) = report else { return false };
    for facts in report.clips.iter().filter(|facts| facts.check().is_ok()) {
        let text = serde_json::to_vec(facts).expect("they are plain data");
        assert!(text.len() <= CLIP_FACTS_MAX && facts.bytes <= CLIP_MAX);
        let again: ClipFacts = serde_json::from_slice(&text).expect("they were written here");
        assert_eq!(again, *facts);
        let mut short = again;
        short.shorten();
        assert_eq!(short.check(), Ok(()), "shorter, they still fit");
        let id = ClipId::new(facts.name.clone(), "car-7").expect("both are names");
        assert_eq!(id.to_string().parse(), Ok(id));
    }
    true
}

fn orders(bytes: &[u8]) -> bool {
    let orders = budget::within(MEMORY, || serde_json::from_slice::<ClipOrders>(bytes));
    let Ok(orders) = orders else { return false };
    for wanted in &orders.wanted {
        // A part that a vehicle would send lies within the file.
        let length = ClipFacts::piece_length(wanted.bytes, wanted.from.unwrap_or(0));
        assert!(length.is_none_or(|it| it <= CLIP_PART && it <= wanted.bytes));
    }
    true
}

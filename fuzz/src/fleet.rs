//! Fuzzes the messages between vehicles and the cloud: frames with their compressed parts, and
//! enrolments.
//!
//! An input is a byte for the mode, then the bytes.

use gleaner_fleet::{Body, Enrolment, Frame, LINES_MAX, decompress, desired_digest};

use crate::budget;
use crate::input::FuzzInput;

/// Modes of an input.
pub mod mode {
    /// A frame follows.
    pub const FRAME: u8 = 0;
    /// An enrolment follows.
    pub const ENROLMENT: u8 = 1;
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

//! What of the host a lambda can call: one line for each function and method of `wit/`, with what
//! it costs.
//!
//! Tests, the lambda `driver` and the fuzzer of calls go through this list, so that a call which is
//! missing in one of them does not compile or fails. `tests/tests/house/wit.rs` holds it against
//! `wit/`, `host/tests/library/host_calls.rs` holds the prices against what the host charges, and
//! `host/tests/library/calls.rs` tries the deadlines. It names nothing of ours, since `driver` is a
//! component.

mod list;
mod step;

pub use list::Operation;
pub use step::{Extra, Step};

/// Bytes of the pixels of the picture that [`setup`] looks at: 64 by 48, rgb8. The coded one has as
/// many.
pub const PIXELS: u64 = 64 * 48 * 3;
/// Bytes of the message that it stands in, as `gleaner_tests::drive::image` makes it.
pub const MESSAGE: u64 = 44 + PIXELS;

/// How a call meets the deadline.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Deadline {
    /// It takes no longer than copying what one call may copy, so it does not look.
    Short,
    /// It looks at the deadline before and while it works.
    Looked,
}

/// A call of an operation, in the language of `driver`, and what the host charges for it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Call {
    /// What follows the byte of the operation.
    pub arguments: &'static [u8],
    /// Bytes that it touches, by the rules of its price.
    pub bytes: u64,
}

/// What an operation costs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Price {
    /// A unit for each eight bytes that the host touches, beside what a call costs by itself: shown
    /// on a modest and on an expensive call. Where both are alike, all calls are.
    Bytes([Call; 2]),
    /// As [`Price::Bytes`], and the price of a further call, for making something.
    Made([Call; 2]),
    /// It cannot be called in this build, as nothing makes what it is a method of.
    Never,
}

/// What a call costs by itself, in units of fuel.
const CALL: u64 = 20;

impl Price {
    /// The two calls, with their price in units of fuel; none where there are no calls.
    pub fn calls(self) -> Option<[(&'static [u8], u64); 2]> {
        let (calls, each) = match self {
            Self::Bytes(calls) => (calls, CALL),
            Self::Made(calls) => (calls, 2 * CALL),
            Self::Never => return None,
        };
        Some(calls.map(|call| (call.arguments, each + call.bytes / 8)))
    }
}

/// A program for `driver` with which calls begin: all topics, by number the program's, the raw
/// camera's and the coded one's; of the raw one the seconds of its stamp and its width; the newest
/// sample of both; the raw one as a frame; `b` in scratch.
pub fn setup() -> Vec<u8> {
    use Operation::{AsFrame, Field, Input, Newest, ScratchPut};
    let steps = [
        (Step::Extra(Extra::Reset), &[][..]),
        (Step::Call(Input), &[0]),
        (Step::Call(Input), &[1]),
        (Step::Call(Input), &[2]),
        (Step::Call(Field), &[1, 0, 4]),
        (Step::Call(Field), &[1, 0, 2]),
        (Step::Call(Newest), &[1]),
        (Step::Call(Newest), &[2]),
        (Step::Call(AsFrame), &[0]),
        (Step::Call(ScratchPut), &[1, 0, 16, 0, 0]),
    ];
    steps.into_iter().flat_map(|(step, arguments)| step.with(arguments)).collect()
}

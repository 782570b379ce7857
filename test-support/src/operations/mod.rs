//! The host functions that a lambda can call: one entry for each function and method of `wit/`,
//! with its price.
//!
//! Tests, the lambda `driver` and the fuzzer of calls use this list, so that a function missing in
//! one of them is a compile error or a failed test. `tests/tests/architecture/wit.rs` compares it
//! with `wit/`, `host/tests/library/host_calls.rs` compares the prices with the host's, and
//! `host/tests/library/calls.rs` tests the deadlines.

mod list;
mod step;

pub use list::Operation;
pub use step::{DriverStep, Extra};

/// Bytes of the pixels of the raw image in [`setup`]: 64 by 48, rgb8. The coded one has as many.
pub const PIXELS: u64 = 64 * 48 * 3;
/// Bytes of its message, as created by `gleaner_tests::drive::image`.
pub const MESSAGE: u64 = 44 + PIXELS;

/// Handling of the deadline in a call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Deadline {
    /// It takes no longer than copying the bytes allowed in one call, so it does not check.
    Short,
    /// It checks the deadline before and during its work.
    Checked,
    /// It waits for the process that runs models, as long as `model_time` in `[limits]` allows.
    Waiting,
}

/// A call of an operation, in the language of `driver`, with the host's price.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PricedCall {
    /// The bytes after that of the operation.
    pub arguments: &'static [u8],
    /// Bytes that it touches, by the rules of its price.
    pub bytes: u64,
}

/// The price of an operation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Price {
    /// A unit for each eight bytes that the host touches, plus the base price of a call, for a
    /// cheap and an expensive call. If both are equal, all calls have this price.
    Bytes([PricedCall; 2]),
    /// The tests cannot call it: it is a method of a model, and `driver` has none.
    Never,
}

/// Base price of a call in units of fuel.
pub const CALL: u64 = 20;

impl Price {
    /// The two calls, with their price in units of fuel; `None` if it cannot be called.
    pub fn calls(self) -> Option<[(&'static [u8], u64); 2]> {
        match self {
            Self::Bytes(calls) => Some(calls.map(|call| (call.arguments, CALL + call.bytes / 8))),
            Self::Never => None,
        }
    }
}

/// A prelude for programs of `driver`: opens all topics, in the order program, raw camera, coded
/// camera; of the raw one the fields seconds of the stamp and width; the newest sample of both; the
/// raw one as a frame; `b` in scratch; a tensor of 32 by 32 32-bit floats.
pub fn setup() -> Vec<u8> {
    use Operation::{AsFrame, Field, Input, Newest, ScratchPut, TensorCreate};
    let steps = [
        (DriverStep::Extra(Extra::Reset), &[][..]),
        (DriverStep::Call(Input), &[0]),
        (DriverStep::Call(Input), &[1]),
        (DriverStep::Call(Input), &[2]),
        (DriverStep::Call(Field), &[1, 0, 4]),
        (DriverStep::Call(Field), &[1, 0, 2]),
        (DriverStep::Call(Newest), &[1]),
        (DriverStep::Call(Newest), &[2]),
        (DriverStep::Call(AsFrame), &[0]),
        (DriverStep::Call(ScratchPut), &[1, 0, 16, 0, 0]),
        (DriverStep::Call(TensorCreate), &[0, 0, 32, 32]),
    ];
    steps.into_iter().flat_map(|(step, arguments)| step.with(arguments)).collect()
}

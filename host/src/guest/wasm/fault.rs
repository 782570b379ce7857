//! From a trap to a fault with a named cause.

use gleaner_protocol::{Fault, FaultKind};
use wasmtime::component::ResourceTableError;
use wasmtime::{Trap, WasmBacktrace};
use wasmtime_wasi::I32Exit;

use super::limits::OutOfFuel;
use super::wasi::Asleep;
use super::{HANDLES, Hosted};

pub(super) fn fuel(used: u64, allowed: u64) -> Fault {
    let message = format!("used {used} of {allowed} units of fuel");
    Fault { kind: FaultKind::Fuel, message, used: Some(used), allowed: Some(allowed) }
}

/// `fuel` and `time` are what was used and what was allowed.
pub(super) fn from_error(
    error: &wasmtime::Error,
    hosted: &Hosted,
    (used, allowed): (u64, u64),
    time: Option<(u64, u64)>,
) -> Fault {
    let trap = error.downcast_ref::<Trap>();
    if trap == Some(&Trap::OutOfFuel) || error.downcast_ref::<OutOfFuel>().is_some() {
        return fuel(used, allowed);
    }
    if trap == Some(&Trap::Interrupt) {
        let (used, allowed) = time.unzip();
        let ms = |ns: Option<u64>| ns.unwrap_or(0) as f64 / 1e6;
        let message = format!("ran {:.1} ms; the deadline is {:.1} ms", ms(used), ms(allowed));
        return Fault { kind: FaultKind::Deadline, message, used, allowed };
    }
    if trap == Some(&Trap::StackOverflow) {
        let allowed = Some(gleaner_compile::GUEST_STACK_BYTES as u64);
        return Fault { kind: FaultKind::Stack, message: "the call stack is full".to_owned(), used: None, allowed };
    }
    let plain = |kind, message| Fault { kind, message, used: None, allowed: None };
    if error.downcast_ref::<Asleep>().is_some() {
        return plain(FaultKind::HostCall, Asleep.to_string());
    }
    if error.downcast_ref::<I32Exit>().is_some() {
        return plain(FaultKind::Trap, "the lambda called exit".to_owned());
    }
    if let Some(ResourceTableError::Full) = error.downcast_ref() {
        let message =
            format!("the lambda holds {HANDLES} handles; drop samples, frames, fields and topics that are not needed");
        return plain(FaultKind::HostCall, message);
    }
    let said = hosted.printed.reason();
    // A guest that is refused memory at its start has no trap; later it aborts, and the refusal is the cause. But a guest may
    // also survive the refusal and panic for another reason.
    // A guest is on the stack if it called the host, and not yet while its memories are made.
    let starting = trap.is_none() && error.downcast_ref::<WasmBacktrace>().is_none();
    let aborted = starting || trap == Some(&Trap::UnreachableCodeReached);
    let for_memory = said.as_ref().is_none_or(|said| said.contains("memory allocation of"));
    if let Some((used, allowed)) = hosted.limits.refused().filter(|_| aborted && for_memory) {
        let message = format!("asked for {used} bytes of memory; {allowed} are allowed");
        return Fault { kind: FaultKind::Memory, message, used: Some(used), allowed: Some(allowed) };
    }
    match trap {
        // A panic says why on standard error, and the trap only says that it happened.
        Some(trap) => plain(FaultKind::Trap, said.unwrap_or_else(|| trap.to_string())),
        None => plain(FaultKind::HostCall, format!("{}", error.root_cause())),
    }
}

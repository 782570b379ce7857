//! Converts a trap to a fault with a named cause.

use gleaner_base::grouped;
use gleaner_lambda::{Fault, FaultKind};
use wasmtime::component::ResourceTableError;
use wasmtime::{Trap, WasmBacktrace};
use wasmtime_wasi::I32Exit;

use super::Hosted;
use super::limits::RefusedGrowth;
use super::wasi::SleepError;
use crate::api::call_time::TimeUsed;
use crate::api::data::DataError;
use crate::api::fuel::OutOfFuel;

/// Prefix of wasmtime's error for a lambda that passes more than `call_bytes`.
const TOO_MUCH_DATA: &str = "too much data is being copied between the host and the guest";

pub(super) fn fuel(used: u64, allowed: u64) -> Fault {
    let [u, a] = [used, allowed].map(grouped);
    let message = format!("used {u} units of fuel; [limits] allows {a}: do less, or raise it");
    Fault { kind: FaultKind::Fuel, message, used: Some(used), allowed: Some(allowed) }
}

fn memory(&RefusedGrowth { limit, requested, allowed }: &RefusedGrowth) -> Fault {
    let [most, allows] = [requested, allowed].map(|amount| match limit {
        "memory" => format!("{:.1} MiB", amount as f64 / 1_048_576.0),
        _ => grouped(amount),
    });
    let message = format!("asked for {most}; `{limit}` in [limits] allows {allows}");
    Fault { kind: FaultKind::Memory, message, used: Some(requested), allowed: Some(allowed) }
}

/// Converts an error of a call that has used this time. The pair is fuel: used and allowed.
pub(super) fn from_error(
    error: &wasmtime::Error,
    hosted: &Hosted,
    (used, allowed): (u64, u64),
    time: TimeUsed,
) -> Fault {
    let trap = error.downcast_ref::<Trap>();
    let data = error.downcast_ref::<DataError>();
    let host_calls =
        error.is::<OutOfFuel>() || matches!(data, Some(DataError::OutOfFuel(OutOfFuel)));
    if trap == Some(&Trap::OutOfFuel) || host_calls {
        return fuel(used, allowed);
    }
    if trap == Some(&Trap::Interrupt) {
        return time.fault("");
    }
    if let Some(DataError::OutOfTime) = data {
        return time.fault("a call into the host takes longer than is left: ");
    }
    if trap == Some(&Trap::StackOverflow) {
        // The stack that another call would have needed is unknown.
        let allowed = Some(hosted.allowed.stack.bytes());
        return Fault {
            kind: FaultKind::Stack,
            message: "the call stack is full".to_owned(),
            used: None,
            allowed,
        };
    }
    let plain = |kind, message| Fault { kind, message, used: None, allowed: None };
    if let Some(error @ DataError::OutOfHolds { .. }) = data {
        return plain(FaultKind::HostCall, error.to_string());
    }
    if error.downcast_ref::<SleepError>().is_some() {
        return plain(FaultKind::HostCall, SleepError.to_string());
    }
    if error.downcast_ref::<I32Exit>().is_some() {
        return plain(FaultKind::Trap, "the lambda called exit".to_owned());
    }
    if let Some(ResourceTableError::Full) = error.downcast_ref() {
        let allowed = hosted.allowed.handles;
        let message = gleaner_rules::refused::too_many_handles(allowed);
        return Fault {
            kind: FaultKind::HostCall,
            message,
            used: Some(allowed + 1),
            allowed: Some(allowed),
        };
    }
    if error.root_cause().to_string().starts_with(TOO_MUCH_DATA) {
        let allowed = hosted.allowed.call_bytes;
        let message = format!("{TOO_MUCH_DATA}: at most {allowed} in one call");
        return Fault {
            kind: FaultKind::HostCall,
            message,
            used: None,
            allowed: Some(allowed.bytes()),
        };
    }
    let printed = hosted.output.reason();
    // A guest that is refused memory at its start has no trap; later it aborts, and the refusal is
    // the cause. But a guest may also survive the refusal and panic for another reason. The
    // backtrace has a guest if it called the host, and none while its memories are created.
    let starting = trap.is_none() && error.downcast_ref::<WasmBacktrace>().is_none();
    let aborted = starting || trap == Some(&Trap::UnreachableCodeReached);
    let for_memory =
        printed.as_ref().is_none_or(|printed| printed.contains("memory allocation of"));
    if let Some(refused) = hosted.caps.refused().filter(|_| aborted && for_memory) {
        return memory(&refused);
    }
    match trap {
        // A compiler's own stack is at the low end of `memory`, and a deep recursion goes below it.
        Some(trap @ Trap::MemoryOutOfBounds) if printed.is_none() => plain(
            FaultKind::Trap,
            format!("{trap}; perhaps its stack is full: a deep recursion, or a large array"),
        ),
        // A panic prints its reason to standard error; the trap has none.
        Some(trap) => {
            plain(FaultKind::Trap, printed.map_or_else(|| trap.to_string(), with_way_out))
        }
        None => plain(FaultKind::HostCall, format!("{}", error.root_cause())),
    }
}

/// Appends the way out to a panic about a file or a thread.
fn with_way_out(panic: String) -> String {
    let hints = [
        ("failed to spawn thread", "a lambda has no threads"),
        ("Os { code: 44,", "a lambda has no files; keep bytes in its scratch"),
    ];
    match hints.iter().find(|(part, _)| panic.contains(part)) {
        Some((_, hint)) => format!("{panic}; {hint}"),
        None => panic,
    }
}

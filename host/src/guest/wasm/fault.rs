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

fn plain(kind: FaultKind, message: impl Into<String>) -> Fault {
    Fault { kind, message: message.into(), used: None, allowed: None }
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
    match (trap, data) {
        _ if trap == Some(&Trap::OutOfFuel) || host_calls => fuel(used, allowed),
        (Some(Trap::Interrupt), _) => time.fault(""),
        (_, Some(DataError::OutOfTime)) => {
            time.fault("a call into the host takes longer than is left: ")
        }
        (Some(Trap::StackOverflow), _) => {
            // The stack that another call would have needed is unknown.
            let allowed = Some(hosted.allowed.stack.bytes());
            Fault { allowed, ..plain(FaultKind::Stack, "the call stack is full") }
        }
        (_, Some(error @ DataError::OutOfHolds { .. })) => {
            plain(FaultKind::HostCall, error.to_string())
        }
        _ => refused_call(error, hosted).unwrap_or_else(|| trapped(error, trap, hosted)),
    }
}

/// The fault of a call into the host that was refused, if `error` is one.
fn refused_call(error: &wasmtime::Error, hosted: &Hosted) -> Option<Fault> {
    if error.is::<SleepError>() {
        return Some(plain(FaultKind::HostCall, SleepError.to_string()));
    }
    if error.is::<I32Exit>() {
        return Some(plain(FaultKind::Trap, "the lambda called exit"));
    }
    if let Some(ResourceTableError::Full) = error.downcast_ref() {
        let allowed = hosted.allowed.handles;
        let message = gleaner_rules::refused::too_many_handles(allowed);
        let (used, allowed) = (Some(allowed + 1), Some(allowed));
        return Some(Fault { used, allowed, ..plain(FaultKind::HostCall, message) });
    }
    error.root_cause().to_string().starts_with(TOO_MUCH_DATA).then(|| {
        let allowed = hosted.allowed.call_bytes;
        let message = format!("{TOO_MUCH_DATA}: at most {allowed} in one call");
        Fault { allowed: Some(allowed.bytes()), ..plain(FaultKind::HostCall, message) }
    })
}

/// The fault of a lambda that trapped, or was refused memory at its start.
fn trapped(error: &wasmtime::Error, trap: Option<&Trap>, hosted: &Hosted) -> Fault {
    let printed = hosted.output.reason();
    // A guest that is refused memory at its start has no trap; later it aborts, and the refusal is
    // the cause. But a guest may also survive the refusal and panic for another reason. The
    // backtrace has a guest if it called the host, and none while its memories are created.
    let starting = trap.is_none() && !error.is::<WasmBacktrace>();
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
        None => plain(FaultKind::HostCall, error.root_cause().to_string()),
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

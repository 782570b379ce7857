//! Sandboxes the process before the first call into a guest, and arms the shim's deadline for each
//! call.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use gleaner_base::Failure;
use gleaner_lambda::{Fault, FaultKind};
use gleaner_protocol::{Layer, Phase};

use super::meter::Meter;
use super::{Guest, LambdaEngine, WakeOutcome};
use crate::api::call_time::WALL_FACTOR;
use crate::api::data::Wake;
use crate::api::models::Models;
use crate::isolation::Isolation;

/// Times after which the process of a guest is killed: longer than its deadline, at which the guest
/// is interrupted.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct KillTimeouts {
    pub init: Duration,
    pub wake: Duration,
}

impl KillTimeouts {
    /// Timeouts of a live run, with slack for a deadline that takes effect late on a busy machine.
    pub fn live(init: Duration, wake: Duration) -> Self {
        const MORE: Duration = Duration::from_millis(250);
        let hard =
            |deadline: Duration| deadline.saturating_mul(WALL_FACTOR + 1).saturating_add(MORE);
        Self { init: hard(init), wake: hard(wake) }
    }

    /// Timeouts of a replay, which has no deadline: only a call that hangs is ended.
    pub fn replay(init: Duration, wake: Duration) -> Self {
        const LEAST: Duration = Duration::from_secs(60);
        Self { init: init.saturating_mul(10).max(LEAST), wake: wake.saturating_mul(100).max(LEAST) }
    }
}

/// A guest whose process is sandboxed before the first call.
pub struct SandboxedGuest {
    guest: Box<dyn Guest>,
    isolation: Arc<Isolation>,
    timeouts: KillTimeouts,
    /// Memory of this process that the lambda may use, in bytes; `None` where its kind counts its
    /// own memory.
    memory: Option<u64>,
    models: Models,
    /// The engine without them.
    engine: OnceLock<LambdaEngine>,
    meter: Option<Meter>,
    is_prepared: bool,
    /// Set if the next wake begins with an `init`.
    needs_init: bool,
}

impl SandboxedGuest {
    /// Wraps `guest`, which has not been called yet. `memory` is the memory that it may use, in
    /// bytes, where it shares the process with Gleaner's own code.
    pub fn new(
        guest: Box<dyn Guest>,
        isolation: Arc<Isolation>,
        timeouts: KillTimeouts,
        memory: Option<u64>,
        models: Models,
    ) -> Self {
        Self {
            guest,
            isolation,
            timeouts,
            memory,
            models,
            meter: None,
            is_prepared: false,
            needs_init: false,
            engine: OnceLock::new(),
        }
    }
}

/// The fault of a guest that returned without one but uses too much memory. It is discarded.
fn memory_fault(guest: &mut dyn Guest, meter: &mut Option<Meter>) -> Option<Fault> {
    let fault = meter.as_mut()?.fault();
    if fault.is_some() {
        guest.discard();
    }
    fault
}

/// Timeout of the start-up code before a lambda: an environment, and numpy from a cold disk.
const PREPARE: Duration = Duration::from_secs(300);

impl Guest for SandboxedGuest {
    fn prepare(&mut self) -> Result<(), Fault> {
        let fault =
            |message| Fault { kind: FaultKind::HostCall, message, used: None, allowed: None };
        self.isolation
            .close()
            .map_err(|failure| fault([failure.message, failure.causes.join(": ")].join(": ")))?;
        let busy = self.isolation.heartbeat().busy(Phase::Init, PREPARE, 0);
        self.guest.prepare()?;
        drop(busy);
        self.isolation.bound_memory().map_err(fault)?;
        let meter =
            self.memory.map(|memory| Meter::start(memory, self.isolation.heartbeat())).transpose();
        self.meter = meter
            .map_err(|error| fault(format!("cannot count the memory of the lambda: {error}")))?;
        self.is_prepared = true;
        Ok(())
    }

    fn init(&mut self) -> Result<(), Fault> {
        if !self.is_prepared {
            self.prepare()?;
        }
        let _busy = self.isolation.heartbeat().busy(Phase::Init, self.timeouts.init, 0);
        self.guest.init()?;
        match memory_fault(&mut *self.guest, &mut self.meter) {
            Some(fault) => Err(Fault { message: format!("in init: {}", fault.message), ..fault }),
            None => Ok(()),
        }
    }

    fn wake(&mut self, wake: Wake) -> WakeOutcome {
        let KillTimeouts { init, wake: timeouts } = self.timeouts;
        let timeouts = if self.needs_init { timeouts.saturating_add(init) } else { timeouts };
        let busy = self.isolation.heartbeat().busy(Phase::Wake, timeouts, wake.at_ns());
        let mut outcome = self.guest.wake(wake);
        if outcome.result.is_ok()
            && let Some(fault) = memory_fault(&mut *self.guest, &mut self.meter)
        {
            outcome.result = Err(fault);
        }
        drop(busy);
        self.needs_init = outcome.result.is_err();
        outcome
    }

    fn discard(&mut self) {
        self.guest.discard();
        self.needs_init = true;
    }

    fn engine(&self) -> LambdaEngine {
        // Once, before the lambda's code can run: that of Python calls into the interpreter.
        let LambdaEngine { name, .. } = self.engine.get_or_init(|| self.guest.engine()).clone();
        LambdaEngine { name, models: self.models.runtimes() }
    }

    fn layers(&self) -> Result<Vec<Layer>, Failure> {
        Ok(self.isolation.close()?.to_vec())
    }
}

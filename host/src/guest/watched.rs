//! A guest that is entered only once this process is shut, and whose shim knows by when it has to
//! be back.

use std::sync::Arc;
use std::time::Duration;

use gleaner_base::Failure;
use gleaner_lambda::{Fault, FaultKind};
use gleaner_protocol::{Doing, Layer};

use super::meter::Meter;
use super::{Guest, Outcome};
use crate::api::data::Wake;
use crate::isolation::Isolation;

/// How long a guest may take before its process is killed. Longer than its deadline, upon which it
/// is asked to end.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct Patience {
    /// For `init`.
    pub init: Duration,
    /// For a wake.
    pub wake: Duration,
}

impl Patience {
    /// Live: enough for a deadline that is met late, on a machine where much runs.
    pub fn live(init: Duration, wake: Duration) -> Self {
        const MORE: Duration = Duration::from_millis(250);
        let hard = |deadline: Duration| deadline.saturating_mul(2).saturating_add(MORE);
        Self { init: hard(init), wake: hard(wake) }
    }

    /// In a replay there is no deadline; only what never comes back is ended.
    pub fn replay(init: Duration, wake: Duration) -> Self {
        const LEAST: Duration = Duration::from_secs(60);
        Self { init: init.saturating_mul(10).max(LEAST), wake: wake.saturating_mul(100).max(LEAST) }
    }
}

/// The guest, and what is around it.
pub struct Watched {
    guest: Box<dyn Guest>,
    isolation: Arc<Isolation>,
    patience: Patience,
    /// Memory that the lambda may take of this process, in bytes; none where its kind counts that
    /// by itself.
    memory: Option<u64>,
    meter: Option<Meter>,
    is_prepared: bool,
    /// The next wake begins with an `init`.
    is_new: bool,
}

impl Watched {
    /// `guest`, which has not been entered yet. `memory` is what it may take of this process, in
    /// bytes, where it shares that with our code.
    pub fn new(
        guest: Box<dyn Guest>,
        isolation: Arc<Isolation>,
        patience: Patience,
        memory: Option<u64>,
    ) -> Self {
        Self { guest, isolation, patience, memory, meter: None, is_prepared: false, is_new: false }
    }
}

/// The fault of a guest that came back well, and has taken too much memory for it.
fn excess(guest: &mut dyn Guest, meter: &mut Option<Meter>) -> Option<Fault> {
    let fault = meter.as_mut()?.fault();
    if fault.is_some() {
        guest.discard();
    }
    fault
}

/// How long what comes before a lambda may take: an environment that starts, and numpy from a cold
/// disk.
const PREPARE: Duration = Duration::from_secs(300);

impl Guest for Watched {
    fn prepare(&mut self) -> Result<(), Fault> {
        let loose =
            |message| Fault { kind: FaultKind::HostCall, message, used: None, allowed: None };
        self.isolation
            .close()
            .map_err(|failure| loose([failure.message, failure.causes.join(": ")].join(": ")))?;
        let busy = self.isolation.pulse().busy(Doing::Init, PREPARE, 0);
        self.guest.prepare()?;
        drop(busy);
        self.isolation.bound_memory().map_err(loose)?;
        let meter =
            self.memory.map(|memory| Meter::start(memory, self.isolation.pulse())).transpose();
        self.meter = meter
            .map_err(|error| loose(format!("cannot count the memory of the lambda: {error}")))?;
        self.is_prepared = true;
        Ok(())
    }

    fn init(&mut self) -> Result<(), Fault> {
        if !self.is_prepared {
            self.prepare()?;
        }
        let _busy = self.isolation.pulse().busy(Doing::Init, self.patience.init, 0);
        self.guest.init()?;
        match excess(&mut *self.guest, &mut self.meter) {
            Some(fault) => Err(Fault { message: format!("in init: {}", fault.message), ..fault }),
            None => Ok(()),
        }
    }

    fn wake(&mut self, wake: Wake) -> Outcome {
        let Patience { init, wake: patience } = self.patience;
        let patience = if self.is_new { patience.saturating_add(init) } else { patience };
        let busy = self.isolation.pulse().busy(Doing::Wake, patience, wake.at_ns());
        let mut outcome = self.guest.wake(wake);
        if outcome.result.is_ok()
            && let Some(fault) = excess(&mut *self.guest, &mut self.meter)
        {
            outcome.result = Err(fault);
        }
        drop(busy);
        self.is_new = outcome.result.is_err();
        outcome
    }

    fn engine(&self) -> String {
        self.guest.engine()
    }

    fn layers(&self) -> Result<Vec<Layer>, Failure> {
        Ok(self.isolation.close()?.to_vec())
    }
}

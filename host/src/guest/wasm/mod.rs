//! Runs WebAssembly components: one store on one thread, always with fuel and a memory cap, and
//! with a deadline in a live run.
//!
//! The five files named as the WIT interfaces only convert, and leave everything else to `api`,
//! including prices. A trap ends the store; the next wake gets a new one. No code is compiled here.

mod bindings;
mod data;
mod deadline;
mod fault;
mod inference;
mod limits;
mod load;
mod log;
mod scratch;
mod trigger;
mod wasi;

pub use deadline::Deadline;
pub use load::{Loaded, WasmError};

use std::time::Duration;

use gleaner_lambda::manifest::{ConfigValue, Limits};
use gleaner_lambda::{Fault, FaultKind};
use tokio::runtime::{self, Runtime};
use wasmtime::Store;
use wasmtime::component::ResourceTable;
use wasmtime_wasi::{WasiCtx, WasiCtxView, WasiView};

use self::bindings::gleaner::lambda::data as wit;
use self::bindings::{ConfigEntry, ConfigValue as WitConfigValue, Lambda};
use self::limits::Caps;
use self::wasi::GuestOutput;
use super::{Guest, LambdaEngine, WakeOutcome};
use crate::api::Session;
use crate::api::call_time::CallTime;
use crate::api::data::Wake;

/// A component and its session.
pub struct WasmGuest {
    loaded: Loaded,
    session: Session,
    limits: Limits,
    deadline: Option<Deadline>,
    /// For the few WASI calls that block. Without it, the first print would start a thread for each
    /// core.
    waiting: Runtime,
    live: Option<LiveInstance>,
}

struct LiveInstance {
    store: Store<Hosted>,
    lambda: Lambda,
}

/// State of the host for one instance, dropped with its store.
struct Hosted {
    session: Session,
    handles: ResourceTable,
    wasi: WasiCtx,
    output: GuestOutput,
    allowed: Limits,
    caps: Caps,
    counts_fuel: bool,
    /// Time of the current call, if there is a deadline.
    call: Option<CallTime>,
}

impl WasiView for Hosted {
    fn ctx(&mut self) -> WasiCtxView<'_> {
        WasiCtxView { ctx: &mut self.wasi, table: &mut self.handles }
    }
}

impl WasmGuest {
    /// A guest without an instance yet, within `limits`. With `deadline`, each call must end in
    /// time; in replay there is none. The stack is that of the engine that `loaded` runs on.
    ///
    /// # Errors
    ///
    /// An error if the system has no more descriptors or memory.
    pub fn new(
        loaded: Loaded,
        session: Session,
        limits: &Limits,
        deadline: Option<Deadline>,
    ) -> std::io::Result<Self> {
        let waiting = runtime::Builder::new_current_thread().build()?;
        Ok(Self { loaded, session, limits: *limits, deadline, waiting, live: None })
    }

    fn start(&mut self) -> Result<LiveInstance, Fault> {
        let mut store = self.new_store();
        let deadline = self.deadline.as_ref().map(|deadline| (deadline, self.limits.init_deadline));
        let mut call = GuestCall::begin(&mut store, self.limits.init_fuel, deadline);
        let lambda = self.loaded.instantiate(call.store());
        let result = lambda.and_then(|lambda| {
            let config = self.session.config().into_iter().map(config_entry).collect::<Vec<_>>();
            Ok((lambda.call_init(call.store(), &config)?, lambda))
        });
        let (answer, lambda) = call.end(result).1.map_err(in_init)?;
        answer.map_err(|message| in_init(exception(message)))?;
        Ok(LiveInstance { store, lambda })
    }

    fn new_store(&self) -> Store<Hosted> {
        let output = GuestOutput::new(&self.session);
        let hosted = Hosted {
            session: self.session.clone(),
            handles: handle_table(&self.limits),
            wasi: wasi::context(&self.session, &output, self.loaded.seed()),
            output,
            allowed: self.limits,
            caps: Caps::new(&self.limits, self.session.fuel().clone()),
            counts_fuel: self.loaded.counts_fuel(),
            call: None,
        };
        let mut store = Store::new(self.loaded.engine(), hosted);
        store.limiter(|hosted| &mut hosted.caps);
        deadline::check_time_at_epoch(&mut store);
        store.set_hostcall_fuel(self.limits.call_bytes.as_usize());
        // The resource table refuses first, with a clear error: a call lends some handles beside
        // those that are held.
        store.set_max_component_handles(2 * handles(&self.limits));
        store
    }
}

impl Guest for WasmGuest {
    fn init(&mut self) -> Result<(), Fault> {
        let waiting = self.waiting.handle().clone();
        let _waiting = waiting.enter();
        self.live = None;
        self.live = Some(self.start()?);
        Ok(())
    }

    fn wake(&mut self, wake: Wake) -> WakeOutcome {
        let waiting = self.waiting.handle().clone();
        let _waiting = waiting.enter();
        let mut live = match self
            .live
            .take()
            .map_or_else(|| self.session.clone().during_init(|| self.start()), Ok)
        {
            Ok(live) => live,
            Err(fault) => return WakeOutcome::faulted(fault),
        };
        let deadline = self.deadline.as_ref().map(|deadline| (deadline, self.limits.deadline));
        let mut call = GuestCall::begin(&mut live.store, self.limits.fuel, deadline);
        let result =
            call.lower_wake(wake).and_then(|wake| live.lambda.call_on_wake(call.store(), wake));
        let (fuel, result) = call.end(result);
        let result = result.and_then(|answer| answer.map_err(exception));
        if result.is_ok() {
            self.live = Some(live);
        }
        // The depth of a full stack depends on the processor for which the code was compiled, and
        // so does the fuel until then.
        let stacked = result.as_ref().is_err_and(|fault| fault.kind == FaultKind::Stack);
        WakeOutcome { result, fuel: (!stacked).then_some(fuel), run_ns: None, model_ns: None }
    }

    fn discard(&mut self) {
        self.live = None;
    }

    fn engine(&self) -> LambdaEngine {
        LambdaEngine { name: self.loaded.settings().to_owned(), models: Vec::new() }
    }
}

fn handles(limits: &Limits) -> usize {
    usize::try_from(limits.handles).unwrap_or(usize::MAX)
}

fn handle_table(limits: &Limits) -> ResourceTable {
    let mut table = ResourceTable::new();
    table.set_max_capacity(handles(limits));
    table
}

/// One call into a guest: sets fuel and deadline at its beginning, and reads what was used at its
/// end.
struct GuestCall<'a> {
    store: &'a mut Store<Hosted>,
    fuel: u64,
    armed: Option<deadline::ArmedCall<'a>>,
}

impl<'a> GuestCall<'a> {
    fn begin(
        store: &'a mut Store<Hosted>,
        fuel: u64,
        deadline: Option<(&'a Deadline, Duration)>,
    ) -> Self {
        if store.data().counts_fuel {
            store.set_fuel(fuel).expect("the engine counts fuel");
        }
        let hosted = store.data_mut();
        hosted.session.fuel().begin(fuel);
        hosted.caps.forget_refusal();
        hosted.output.begin();
        let armed = deadline.map(|(deadline, allowed)| deadline.arm(store, allowed));
        if armed.is_none() {
            store.set_epoch_deadline(u64::MAX / 2);
        }
        let hosted = store.data();
        if let Some(due) = hosted.session.due() {
            due.set(hosted.call);
        }
        Self { store, fuel, armed }
    }

    fn store(&mut self) -> &mut Store<Hosted> {
        self.store
    }

    fn lower_wake(&mut self, wake: Wake) -> wasmtime::Result<wit::Wake> {
        Ok(match wake {
            Wake::Event(sample) => wit::Wake::Event(self.store.data_mut().handles.push(sample)?),
            Wake::Tick(tick) => {
                wit::Wake::Tick(wit::Tick { at_ns: tick.at_ns, missed: tick.missed })
            }
        })
    }

    /// Ends the call; returns the fuel used, and the result with a trap converted to a fault.
    fn end<T>(self, result: wasmtime::Result<T>) -> (u64, Result<T, Fault>) {
        let time = self.armed.as_ref().map(|armed| armed.time);
        let late = time.as_ref().and_then(CallTime::late);
        drop(self.armed);
        self.store.data().output.end();
        let left = match self.store.data().counts_fuel {
            true => self.store.get_fuel().unwrap_or(0),
            false => self.fuel,
        };
        let used = (self.fuel - left.min(self.fuel))
            .saturating_add(self.store.data().session.fuel().used());
        let result = match result {
            // Guest and host each stayed within the allowance, but their sum must as well.
            Ok(_) if used > self.fuel => Err(fault::fuel(used, self.fuel)),
            Ok(value) => late.map_or(Ok(value), |time| Err(time.fault(""))),
            Err(error) => {
                let time = time.map(|time| time.used()).unwrap_or_default();
                Err(fault::from_error(&error, self.store.data(), (used, self.fuel), time))
            }
        };
        (used, result)
    }
}

fn exception(message: String) -> Fault {
    let message = crate::api::log::cut(&message, crate::api::log::LINE_BYTES).to_owned();
    Fault { kind: FaultKind::Exception, message, used: None, allowed: None }
}

fn in_init(fault: Fault) -> Fault {
    Fault { message: format!("in init: {}", fault.message), ..fault }
}

fn config_entry((key, value): (String, ConfigValue)) -> ConfigEntry {
    let value = match value {
        ConfigValue::Bool(value) => WitConfigValue::Boolean(value),
        ConfigValue::Int(value) => WitConfigValue::Integer(value),
        ConfigValue::Float(value) => WitConfigValue::Real(value),
        ConfigValue::Text(value) => WitConfigValue::Text(value),
    };
    ConfigEntry { key, value }
}

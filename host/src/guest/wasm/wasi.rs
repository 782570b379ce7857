//! The part of WASI that a lambda needs: output becomes log lines, the clock is the wake's, random
//! numbers are seeded.
//!
//! There are no files, environment, arguments, sockets or host names: such calls return an error.
//! Sleeping is a fault, since neither fuel nor a deadline could interrupt it. Calls whose work
//! grows with an argument cost fuel, as other host calls do.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use bytes::Bytes;
use rand::SeedableRng;
use rand::rngs::StdRng;
use wasmtime::component::{HasData, Linker, Resource};
use wasmtime_wasi::cli::{IsTerminal, StdoutStream};
use wasmtime_wasi::p2::bindings::clocks::monotonic_clock;
use wasmtime_wasi::p2::bindings::random::{insecure, random};
use wasmtime_wasi::p2::bindings::sockets::ip_name_lookup::ResolveAddressStream as Addresses;
use wasmtime_wasi::p2::bindings::sockets::network::{ErrorCode, Network};
use wasmtime_wasi::p2::bindings::sync::io::poll;
use wasmtime_wasi::p2::{DynPollable, OutputStream, Pollable, StreamError, StreamResult};
use wasmtime_wasi::random::WasiRandomCtx;
use wasmtime_wasi::{HostWallClock, WasiCtx, WasiCtxView, WasiView};

use super::Hosted;
use crate::api::Session;
use crate::api::fuel::OutOfFuel;
use crate::api::log::{LINE_BYTES, Level, cut};

/// Text of the standard library before the message of a panic, after the name of the thread.
const PANICKED: &str = "panicked at ";

/// The interface that resolves host names, as wasmtime-wasi names it.
const NAMES: &str = "wasi:sockets/ip-name-lookup@0.2.12";

/// Maximum number of random bytes of one call.
const RANDOM_BYTES: u64 = 4096;
/// Fuel for a random byte: each is generated separately.
const FUEL_PER_RANDOM_BYTE: u64 = 4;
const FUEL_PER_POLLABLE: u64 = 400;

#[derive(Debug, thiserror::Error)]
#[error("a lambda cannot sleep: it is woken by samples or by a period")]
pub(super) struct SleepError;

pub(super) fn add_to_linker(linker: &mut Linker<Hosted>) -> wasmtime::Result<()> {
    wasmtime_wasi::p2::add_to_linker_sync(linker)?;
    linker.allow_shadowing(true);
    monotonic_clock::add_to_linker::<Hosted, Bounded>(linker, |hosted| hosted)?;
    random::add_to_linker::<Hosted, Bounded>(linker, |hosted| hosted)?;
    insecure::add_to_linker::<Hosted, Bounded>(linker, |hosted| hosted)?;
    poll::add_to_linker::<Hosted, Bounded>(linker, |hosted| hosted)?;
    refuse_names(linker)?;
    linker.allow_shadowing(false);
    Ok(())
}

/// Refuses to resolve host names. The generated function would accept a name of any length without
/// charging it.
fn refuse_names(linker: &mut Linker<Hosted>) -> wasmtime::Result<()> {
    linker.instance(NAMES)?.func_wrap(
        "resolve-addresses",
        |store,
         (network, name): (Resource<Network>, String)|
         -> wasmtime::Result<(Result<Resource<Addresses>, ErrorCode>,)> {
            store.data().session.fuel().charge(|| name.len())?;
            store.data().handles.get(&network)?;
            Ok((Err(ErrorCode::PermanentResolverFailure),))
        },
    )
}

/// A context that grants nothing but output, the wake's time and numbers from `seed`.
pub(super) fn context(session: &Session, output: &GuestOutput, seed: [u8; 32]) -> WasiCtx {
    WasiCtx::builder()
        .stdout(output.stdout.clone())
        .stderr(output.stderr.clone())
        .wall_clock(Wall(session.clone()))
        .secure_random(StdRng::from_seed(seed))
        .insecure_random(StdRng::from_seed(seed))
        // Neither fuel nor a deadline interrupts a call, so no call may be long.
        .max_random_size(RANDOM_BYTES)
        .insecure_random_seed(u128::from_le_bytes(std::array::from_fn(|i| seed[i])))
        .allow_blocking_current_thread(true)
        // No socket is created, not even an unconnected one.
        .allow_tcp(false)
        .allow_udp(false)
        .allow_ip_name_lookup(false)
        .build()
}

struct Wall(Session);

impl HostWallClock for Wall {
    fn resolution(&self) -> Duration {
        Duration::from_nanos(1)
    }

    fn now(&self) -> Duration {
        Duration::from_nanos(u64::try_from(self.0.now_ns()).unwrap_or(0))
    }
}

/// Marks the WASI interfaces that are implemented here, with bounds.
struct Bounded;

impl HasData for Bounded {
    type Data<'a> = &'a mut Hosted;
}

/// A clock that stands still during a wake.
impl monotonic_clock::Host for Hosted {
    fn now(&mut self) -> wasmtime::Result<u64> {
        Ok(u64::try_from(self.session.now_ns()).unwrap_or(0))
    }

    fn resolution(&mut self) -> wasmtime::Result<u64> {
        Ok(1)
    }

    fn subscribe_instant(&mut self, _when: u64) -> wasmtime::Result<Resource<DynPollable>> {
        Err(SleepError.into())
    }

    fn subscribe_duration(&mut self, _duration: u64) -> wasmtime::Result<Resource<DynPollable>> {
        Err(SleepError.into())
    }
}

impl Hosted {
    fn wasi_random(&mut self) -> &mut WasiRandomCtx {
        let WasiCtxView { ctx, .. } = self.ctx();
        ctx.random()
    }

    fn charge_random(&self, bytes: u64) -> Result<(), OutOfFuel> {
        // A larger request is refused and generates nothing.
        self.session.fuel().charge_units(bytes.min(RANDOM_BYTES) * FUEL_PER_RANDOM_BYTE)
    }
}

impl random::Host for Hosted {
    fn get_random_bytes(&mut self, bytes: u64) -> wasmtime::Result<Vec<u8>> {
        self.charge_random(bytes)?;
        self.wasi_random().get_random_bytes(bytes)
    }

    fn get_random_u64(&mut self) -> wasmtime::Result<u64> {
        self.charge_random(8)?;
        self.wasi_random().get_random_u64()
    }
}

impl insecure::Host for Hosted {
    fn get_insecure_random_bytes(&mut self, bytes: u64) -> wasmtime::Result<Vec<u8>> {
        self.charge_random(bytes)?;
        self.wasi_random().get_insecure_random_bytes(bytes)
    }

    fn get_insecure_random_u64(&mut self) -> wasmtime::Result<u64> {
        self.charge_random(8)?;
        self.wasi_random().get_insecure_random_u64()
    }
}

/// Only output can be polled, and it is always ready.
impl poll::Host for Hosted {
    fn poll(&mut self, these: Vec<Resource<DynPollable>>) -> wasmtime::Result<Vec<u32>> {
        self.session.fuel().charge_units(FUEL_PER_POLLABLE.saturating_mul(these.len() as u64))?;
        poll::Host::poll(&mut self.handles, these)
    }
}

impl poll::HostPollable for Hosted {
    fn ready(&mut self, this: Resource<DynPollable>) -> wasmtime::Result<bool> {
        self.session.fuel().charge_units(FUEL_PER_POLLABLE)?;
        poll::HostPollable::ready(&mut self.handles, this)
    }

    fn block(&mut self, this: Resource<DynPollable>) -> wasmtime::Result<()> {
        self.session.fuel().charge_units(FUEL_PER_POLLABLE)?;
        poll::HostPollable::block(&mut self.handles, this)
    }

    fn drop(&mut self, this: Resource<DynPollable>) -> wasmtime::Result<()> {
        poll::HostPollable::drop(&mut self.handles, this)
    }
}

/// Standard output and standard error of a guest.
pub(super) struct GuestOutput {
    stdout: LogStream,
    stderr: LogStream,
}

impl GuestOutput {
    pub(super) fn new(session: &Session) -> Self {
        Self {
            stdout: LogStream::new(session, Level::Info),
            stderr: LogStream::new(session, Level::Warn),
        }
    }

    /// Clears the standard error of the previous call.
    pub(super) fn begin(&self) {
        let mut stderr = self.stderr.lock();
        stderr.beginning.clear();
        stderr.panicking = false;
    }

    /// Logs partial lines, without a newline at their end.
    pub(super) fn end(&self) {
        for lines in [&self.stdout, &self.stderr] {
            lines.lock().flush(&lines.session, lines.level);
        }
    }

    /// Standard error of this call: the reason of a panic, without the additions of the standard
    /// library.
    pub(super) fn reason(&self) -> Option<String> {
        let state = self.stderr.lock();
        let lines = state
            .beginning
            .lines()
            .filter(|line| !line.trim().is_empty() && !line.starts_with("note: run with"));
        let message = lines.collect::<Vec<_>>().join("\n");
        // `thread '<unnamed>' (1) panicked at src/lib.rs:17:9:`, and the message in the next line.
        let message = match message.find(PANICKED) {
            Some(at) => message[at..].replacen(":\n", ": ", 1),
            None => message,
        };
        (!message.is_empty()).then_some(message)
    }
}

/// Output of a guest, logged line by line.
#[derive(Clone)]
struct LogStream {
    session: Session,
    level: Level,
    state: Arc<Mutex<PartialLine>>,
}

#[derive(Default)]
struct PartialLine {
    /// Bytes since the last newline, at most [`LINE_BYTES`]: a line is often written in several
    /// pieces.
    line: Vec<u8>,
    /// Beginning of the output of this call, at most [`LINE_BYTES`].
    beginning: String,
    /// Set if the standard library has printed a panic in this call.
    panicking: bool,
}

impl LogStream {
    fn new(session: &Session, level: Level) -> Self {
        Self { session: session.clone(), level, state: Arc::default() }
    }

    fn lock(&self) -> MutexGuard<'_, PartialLine> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl PartialLine {
    fn write(&mut self, bytes: &[u8], session: &Session, level: Level) {
        for piece in bytes.split_inclusive(|byte| *byte == b'\n') {
            self.line.extend_from_slice(piece);
            if piece.ends_with(b"\n") || self.line.len() >= LINE_BYTES {
                self.flush(session, level);
            }
        }
    }

    fn flush(&mut self, session: &Session, level: Level) {
        let line = std::mem::take(&mut self.line);
        let line = String::from_utf8_lossy(&line);
        let room = LINE_BYTES.saturating_sub(self.beginning.len());
        self.beginning.push_str(cut(&line, room));
        let line = line.trim_end();
        // The fault contains the panic; in the log it would only displace other lines.
        self.panicking |= line.contains(PANICKED);
        if !line.is_empty() && !self.panicking {
            session.write(level, line);
        }
    }
}

impl IsTerminal for LogStream {
    fn is_terminal(&self) -> bool {
        false
    }
}

impl StdoutStream for LogStream {
    fn async_stream(&self) -> Box<dyn tokio::io::AsyncWrite + Send + Sync> {
        // Only WASI 0.3 uses this function, and it is not linked.
        Box::new(tokio::io::sink())
    }

    fn p2_stream(&self) -> Box<dyn OutputStream> {
        Box::new(self.clone())
    }
}

impl OutputStream for LogStream {
    fn write(&mut self, bytes: Bytes) -> StreamResult<()> {
        if bytes.len() > LINE_BYTES {
            return Err(StreamError::trap("a lambda wrote more than its stream accepts"));
        }
        self.session
            .fuel()
            .charge(|| bytes.len())
            .map_err(|error| StreamError::Trap(error.into()))?;
        self.lock().write(&bytes, &self.session, self.level);
        Ok(())
    }

    fn flush(&mut self) -> StreamResult<()> {
        Ok(())
    }

    fn check_write(&mut self) -> StreamResult<usize> {
        Ok(LINE_BYTES)
    }
}

#[wasmtime_wasi::async_trait]
impl Pollable for LogStream {
    async fn ready(&mut self) {}
}

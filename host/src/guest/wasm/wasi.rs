//! WASI as far as a lambda needs it: output becomes log lines, the clock is the wake's, random
//! numbers are seeded.
//!
//! There are no files, no environment, no arguments, no sockets and no names of other machines:
//! such calls answer with an error. Sleeping is a fault, since neither fuel nor a deadline could
//! end it. What takes longer the more is asked for costs fuel, as other host calls do.

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

/// How the standard library begins to tell a panic, behind the name of the thread.
const PANICKED: &str = "panicked at ";

/// The interface that looks names up, as wasmtime-wasi calls it.
const NAMES: &str = "wasi:sockets/ip-name-lookup@0.2.12";

/// Random bytes that one call hands out.
const RANDOM_BYTES: u64 = 4096;
/// Fuel for a random byte: each is drawn by itself.
const FUEL_PER_RANDOM_BYTE: u64 = 4;
/// Fuel for something that is waited for.
const FUEL_PER_POLLABLE: u64 = 400;

/// The lambda tried to sleep.
#[derive(Debug, thiserror::Error)]
#[error("a lambda cannot sleep: it is woken by samples or by a period")]
pub(super) struct Asleep;

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

/// Has names of other machines looked up by nobody. What is generated would take a name of any
/// length for nothing.
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
pub(super) fn context(session: &Session, printed: &Printed, seed: [u8; 32]) -> WasiCtx {
    WasiCtx::builder()
        .stdout(printed.stdout.clone())
        .stderr(printed.stderr.clone())
        .wall_clock(Wall(session.clone()))
        .secure_random(StdRng::from_seed(seed))
        .insecure_random(StdRng::from_seed(seed))
        // Neither fuel nor a deadline ends a call, so no call may be long.
        .max_random_size(RANDOM_BYTES)
        .insecure_random_seed(u128::from_le_bytes(std::array::from_fn(|i| seed[i])))
        .allow_blocking_current_thread(true)
        // None is made, not even one that leads nowhere.
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

/// What of WASI is ours, and bounded.
struct Bounded;

impl HasData for Bounded {
    type Data<'a> = &'a mut Hosted;
}

/// Standing still within a wake.
impl monotonic_clock::Host for Hosted {
    fn now(&mut self) -> wasmtime::Result<u64> {
        Ok(u64::try_from(self.session.now_ns()).unwrap_or(0))
    }

    fn resolution(&mut self) -> wasmtime::Result<u64> {
        Ok(1)
    }

    fn subscribe_instant(&mut self, _when: u64) -> wasmtime::Result<Resource<DynPollable>> {
        Err(Asleep.into())
    }

    fn subscribe_duration(&mut self, _duration: u64) -> wasmtime::Result<Resource<DynPollable>> {
        Err(Asleep.into())
    }
}

impl Hosted {
    fn wasi_random(&mut self) -> &mut WasiRandomCtx {
        let WasiCtxView { ctx, .. } = self.ctx();
        ctx.random()
    }

    fn charge_random(&self, bytes: u64) -> Result<(), OutOfFuel> {
        // More is refused, without being drawn.
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

/// Output is all that can be waited for, and always ready.
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
pub(super) struct Printed {
    stdout: Lines,
    stderr: Lines,
}

impl Printed {
    pub(super) fn new(session: &Session) -> Self {
        Self { stdout: Lines::new(session, Level::Info), stderr: Lines::new(session, Level::Warn) }
    }

    /// Forgets what an earlier call said on standard error.
    pub(super) fn begin(&self) {
        let mut stderr = self.stderr.lock();
        stderr.said.clear();
        stderr.panicking = false;
    }

    /// Writes down what did not end with a newline.
    pub(super) fn end(&self) {
        for lines in [&self.stdout, &self.stderr] {
            lines.lock().flush(&lines.session, lines.level);
        }
    }

    /// What this call said last on standard error: the reason of a panic, without what the standard
    /// library adds to it.
    pub(super) fn reason(&self) -> Option<String> {
        let state = self.stderr.lock();
        let lines = state
            .said
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

/// Output of a guest, line by line into its log.
#[derive(Clone)]
struct Lines {
    session: Session,
    level: Level,
    state: Arc<Mutex<Unfinished>>,
}

#[derive(Default)]
struct Unfinished {
    /// Bytes since the last newline, at most [`LINE_BYTES`]: a line is rarely written in one piece.
    line: Vec<u8>,
    /// Beginning of what this call wrote, at most [`LINE_BYTES`].
    said: String,
    /// The standard library is telling a panic in this call.
    panicking: bool,
}

impl Lines {
    fn new(session: &Session, level: Level) -> Self {
        Self { session: session.clone(), level, state: Arc::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Unfinished> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Unfinished {
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
        let room = LINE_BYTES.saturating_sub(self.said.len());
        self.said.push_str(cut(&line, room));
        let line = line.trim_end();
        // A panic is told by the fault; in the log it would only take the room of other lines.
        self.panicking |= line.contains(PANICKED);
        if !line.is_empty() && !self.panicking {
            session.write(level, line);
        }
    }
}

impl IsTerminal for Lines {
    fn is_terminal(&self) -> bool {
        false
    }
}

impl StdoutStream for Lines {
    fn async_stream(&self) -> Box<dyn tokio::io::AsyncWrite + Send + Sync> {
        // Only WASI 0.3 asks for this one, and it is not linked.
        Box::new(tokio::io::sink())
    }

    fn p2_stream(&self) -> Box<dyn OutputStream> {
        Box::new(self.clone())
    }
}

impl OutputStream for Lines {
    fn write(&mut self, bytes: Bytes) -> StreamResult<()> {
        if bytes.len() > LINE_BYTES {
            return Err(StreamError::trap("a lambda wrote more than its stream had said to take"));
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
impl Pollable for Lines {
    async fn ready(&mut self) {}
}

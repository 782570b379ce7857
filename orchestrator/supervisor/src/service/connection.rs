//! The connection to the orchestrator: its requests, and reports to it.
//!
//! A thread accepts connections, and another one reads the newest. An older one is closed: an
//! orchestrator that was started again replaces the one before.

use std::io::{self, BufReader, Write};
use std::net::Shutdown;
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::Builder;
use std::time::Duration;

use gleaner_base::{Exit, Failure, excerpt};
use gleaner_protocol::supervision::{
    SUPERVISION_VERSION, SupervisorReport, SupervisorRequest, Welcome,
};
use rustix::net::sockopt::{set_socket_send_buffer_size, socket_peercred};

use crate::lines::next_report;
use crate::output::{ChildOutput, NOTICE};

/// Number of requests that wait for the loop. Each replaces those before it, and further ones wait
/// in the socket.
const REQUESTS: usize = 4;
/// Size of the buffer for reports, in bytes: some seconds of a vehicle with a hundred lambdas.
const REPORT_BYTES: usize = 4 << 20;
/// Pause after an error of accepting, such as too many open files.
const PAUSE: Duration = Duration::from_secs(1);

/// The connection to the newest orchestrator.
pub(super) struct Connection {
    shared: Arc<Shared>,
    requests: Receiver<(u64, SupervisorRequest)>,
}

#[derive(Default)]
struct Shared {
    /// The newest connection, and its number.
    newest: Mutex<(u64, Option<Arc<UnixStream>>)>,
    /// Wakes the loop.
    bell: Mutex<Option<SyncSender<ChildOutput>>>,
}

impl Connection {
    /// Accepts orchestrators of the same user.
    pub(super) fn accept(listener: UnixListener) -> Result<Self, Failure> {
        let (sender, requests) = sync_channel(REQUESTS);
        let shared = Arc::new(Shared::default());
        let accepting = Arc::clone(&shared);
        Builder::new()
            .name("accept".to_owned())
            .spawn(move || {
                loop {
                    match listener.accept() {
                        Ok((stream, _)) => accepting.replace(stream, &sender),
                        Err(_) => std::thread::sleep(PAUSE),
                    }
                }
            })
            .map_err(|it| Failure::caused_by(Exit::Internal, "cannot start a thread", &it))?;
        Ok(Self { shared, requests })
    }

    /// Returns the next request, if it comes within this time. Those of earlier connections are
    /// skipped: the newest one has sent the whole state again.
    pub(super) fn next(&self, within: Duration) -> Option<SupervisorRequest> {
        loop {
            let (number, request) = self.requests.recv_timeout(within).ok()?;
            if number == lock(&self.shared.newest).0 {
                return Some(request);
            }
        }
    }

    /// Sends a report. One for which there is no room is dropped: a later one replaces it.
    pub(super) fn report(&self, report: &SupervisorReport) {
        let newest = lock(&self.shared.newest).1.clone();
        if let Some(stream) = newest {
            send(&stream, report);
        }
    }

    pub(super) fn is_open(&self) -> bool {
        lock(&self.shared.newest).1.is_some()
    }

    /// Sets what each further request wakes.
    pub(super) fn rings(&self, bell: SyncSender<ChildOutput>) {
        *lock(&self.shared.bell) = Some(bell);
    }
}

impl Shared {
    fn replace(
        self: &Arc<Self>,
        stream: UnixStream,
        requests: &SyncSender<(u64, SupervisorRequest)>,
    ) {
        let is_own =
            socket_peercred(&stream).is_ok_and(|peer| peer.uid == rustix::process::getuid());
        if !is_own || prepare(&stream).is_err() {
            return;
        }
        let stream = Arc::new(stream);
        send(&stream, &welcome());
        let mut newest = lock(&self.newest);
        let number = newest.0 + 1;
        let (_, before) = std::mem::replace(&mut *newest, (number, Some(Arc::clone(&stream))));
        drop(newest);
        if let Some(before) = before {
            let _ = before.shutdown(Shutdown::Both);
        }
        let (shared, requests) = (Arc::clone(self), requests.clone());
        let thread = Builder::new().name("orchestrator".to_owned());
        // Without a thread, the orchestrator gets no answer and connects again.
        let _ = thread.spawn(move || {
            shared.read(number, &stream, &requests);
            let mut newest = lock(&shared.newest);
            if newest.0 == number {
                newest.1 = None;
            }
        });
    }

    fn read(
        &self,
        number: u64,
        stream: &UnixStream,
        requests: &SyncSender<(u64, SupervisorRequest)>,
    ) {
        let mut reports = BufReader::new(stream);
        let mut line = Vec::new();
        while next_report(&mut reports, &mut line).unwrap_or(false) {
            match serde_json::from_slice(&line) {
                Ok(request) => {
                    if requests.send((number, request)).is_err() {
                        return;
                    }
                    if let Some(bell) = &*lock(&self.bell) {
                        let _ = bell.try_send(NOTICE);
                    }
                }
                Err(error) => {
                    let reason = format!("cannot parse a request: {}", excerpt(&error.to_string()));
                    send(stream, &SupervisorReport::Refused { reason });
                }
            }
        }
    }
}

fn prepare(stream: &UnixStream) -> io::Result<()> {
    set_socket_send_buffer_size(stream, REPORT_BYTES)?;
    // Of both directions: reads wait for data by themselves.
    stream.set_write_timeout(Some(Duration::from_millis(1)))
}

/// Sends a report as a whole, or closes the connection: a part of one would run into the next.
fn send(mut stream: &UnixStream, report: &SupervisorReport) {
    let mut text = serde_json::to_vec(report).expect("a report is plain data");
    text.push(b'\n');
    if stream.write_all(&text).is_err() {
        let _ = stream.shutdown(Shutdown::Both);
    }
}

fn welcome() -> SupervisorReport {
    SupervisorReport::Welcome(Welcome {
        version: SUPERVISION_VERSION,
        program: gleaner_base::version().to_owned(),
        pid: std::process::id(),
    })
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

//! Announces clips to the cloud, and sends those that it wants: a task for each connection.
//!
//! The cloud keeps the position up to which clips were announced, and the number of bytes that it
//! has of each file: this goes on wherever a kill has interrupted it, and `tracker` only counts
//! attempts, pauses and bytes. Clips are read to be announced whether the connection lasts or not,
//! and the next one uses the result. One file is sent at a time, in pieces that adapt to the link.
//! A clip that cannot be read or sent keeps no other one back. Nothing here writes to the folder of
//! clips or deletes from it.

use std::convert::Infallible;
use std::io;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_fleet::clips::{ClipName, ClipOrders, ClipReport, GoneClip, WantedClip};
use tokio::sync::{oneshot, watch};
use tokio::time::sleep;

use super::clip_list::{ClipFolder, is_gone, known_builds};
use super::http::{CloudHttp, PATIENCE};
use crate::orchestrator::Orchestrator;
use tracker::{AGAIN_FACTOR, ClipKey};

mod tracker;

pub(super) use tracker::ClipTracker;

/// Interval of looks for new clips.
const INTERVAL: Duration = Duration::from_secs(5);
/// Longest time between two looks at what is wanted, such as after a budget was used up.
const ORDERS_INTERVAL: Duration = Duration::from_secs(300);
/// Bytes per second that are sent, whatever the cloud wants.
const RATE: f64 = 8e6;
/// Time for the answer to the last piece of a file: the cloud compares all of it first.
const COMPARING: Duration = Duration::from_secs(600);

pub(super) struct ClipSender {
    pub(super) core: Arc<Orchestrator>,
    pub(super) folder: ClipFolder,
    pub(super) http: CloudHttp,
    /// Number of the desired state: with each new one, the cloud may want other clips.
    pub(super) wanted: watch::Receiver<u64>,
    pub(super) tracker: Arc<Mutex<ClipTracker>>,
    /// The file of which something is sent now.
    current: ClipKey,
}

impl ClipSender {
    pub(super) fn new(
        core: Arc<Orchestrator>,
        folder: ClipFolder,
        http: CloudHttp,
        wanted: watch::Receiver<u64>,
        tracker: Arc<Mutex<ClipTracker>>,
    ) -> Self {
        Self { core, folder, http, wanted, tracker, current: None }
    }

    /// Runs until it is aborted, with the end of the connection.
    pub(super) async fn run(mut self) {
        loop {
            let Err(failure) = self.serve().await;
            tracing::debug!("clips cannot be sent to the cloud now: {failure}");
            let current = self.current.take();
            sleep(self.tracked(|it| it.fail(current, &failure))).await;
        }
    }

    /// Announces and sends until something fails.
    async fn serve(&mut self) -> Result<Infallible, Failure> {
        loop {
            self.wanted.borrow_and_update();
            self.begin(None);
            let mut length = None;
            let mut orders = self.report(&ClipReport::default()).await?;
            let until = Instant::now() + ORDERS_INTERVAL;
            loop {
                let seen = self.folder.length();
                self.tracked(|it| it.learn(&orders, seen));
                if length != Some(seen) {
                    match self.new_clips(&orders).await? {
                        Some(report) => {
                            orders = self.report(&report).await?;
                            // Else the same clips would be announced again, without an end.
                            if orders.cursor != report.cursor {
                                let message = "the cloud did not store the list of clips";
                                return Err(Failure::new(Exit::Unreachable, message));
                            }
                        }
                        None => {
                            self.tracked(ClipTracker::listed);
                            length = Some(seen);
                        }
                    }
                } else if let Some(new) = self.clip_again(&orders).await? {
                    orders = new;
                } else if let Some((file, wanted)) = self.tracked(|it| it.next()) {
                    self.begin(Some((file.clone(), wanted.is_none())));
                    orders = match wanted {
                        None => self.send_thumbnail(&file).await?,
                        Some(wanted) => self.send_piece(&wanted).await?.unwrap_or(orders),
                    };
                    self.current = None;
                } else {
                    tokio::select! {
                        changed = self.wanted.changed() => {
                            if changed.is_err() {
                                std::future::pending::<()>().await;
                            }
                            break;
                        }
                        () = sleep(INTERVAL) => if Instant::now() >= until { break },
                    }
                }
            }
        }
    }

    fn tracked<T>(&self, act: impl FnOnce(&mut ClipTracker) -> T) -> T {
        act(&mut self.tracker.lock().unwrap_or_else(PoisonError::into_inner))
    }

    fn begin(&mut self, file: ClipKey) {
        self.warn(self.tracked(|it| it.attempt(file.clone())));
        self.current = file;
    }

    fn warn(&self, event: Option<String>) {
        if let Some(text) = event {
            self.core.warn(&text);
        }
    }

    async fn report(&self, report: &ClipReport) -> Result<ClipOrders, Failure> {
        paced(0, self.http.post("/v1/clips", report)).await
    }

    async fn send_thumbnail(&self, name: &ClipName) -> Result<ClipOrders, Failure> {
        let path = format!("/v1/clips/{name}/thumbnail");
        let (folder, of) = (self.folder.clone(), name.clone());
        match in_background(move || folder.thumbnail(&of)).await {
            Ok(image) => self.send(&path, image, PATIENCE).await,
            // Without it, the clip is still there, and the next ones go on.
            Err(error) if is_gone(&error) => self.report_gone(name, true, &error).await,
            Err(error) => Err(unreadable(&error)),
        }
    }

    /// Sends the next piece of a clip; returns no orders if the clip cannot be read.
    async fn send_piece(&self, wanted: &WantedClip) -> Result<Option<ClipOrders>, Failure> {
        let WantedClip { name, bytes, from, .. } = wanted.clone();
        let Some(begin) = from else {
            let message = "the cloud takes no pieces of clips";
            return Err(Failure::new(Exit::Unreachable, message)
                .with_help("upgrade the cloud first, then its vehicles"));
        };
        let most = self.tracked(ClipTracker::piece);
        let (folder, of) = (self.folder.clone(), name.clone());
        let read = in_background(move || folder.piece(&of, bytes, (begin, most))).await;
        let content = match read {
            Ok(content) => content,
            Err(error) if is_gone(&error) => {
                return self.report_gone(&name, false, &error).await.map(Some);
            }
            Err(error) => {
                self.not_read(&name, &error.to_string()).await;
                return Ok(None);
            }
        };
        let is_last = begin + content.len() as u64 == bytes;
        let path = format!("/v1/clips/{name}/from/{begin}");
        let orders = self.send(&path, content, if is_last { COMPARING } else { PATIENCE }).await?;
        let now = orders.wanted.iter().find(|it| it.name == name);
        if now.is_some_and(|now| now.from <= from) {
            let message = "the cloud has kept nothing of a piece";
            return Err(Failure::new(Exit::Unreachable, message));
        }
        self.tracked(|it| it.arrived(most));
        Ok(Some(orders))
    }

    async fn send(
        &self,
        path: &str,
        content: Vec<u8>,
        patience: Duration,
    ) -> Result<ClipOrders, Failure> {
        let bytes = content.len();
        self.tracked(|it| it.send(bytes as u64));
        paced(bytes, self.http.put(path, content, patience)).await
    }

    async fn report_gone(
        &self,
        name: &ClipName,
        is_thumbnail: bool,
        error: &io::Error,
    ) -> Result<ClipOrders, Failure> {
        let reason = match error.kind() {
            io::ErrorKind::NotFound => "the vehicle has deleted the file".to_owned(),
            _ => error.to_string(),
        };
        let gone = GoneClip { name: name.clone(), is_thumbnail, reason };
        self.report(&ClipReport { gone: vec![gone], ..ClipReport::default() }).await
    }

    async fn new_clips(&self, orders: &ClipOrders) -> Result<Option<ClipReport>, Failure> {
        let report = self.read(orders.cursor.clone(), None).await?;
        for facts in report.iter().flat_map(|it| &it.clips) {
            if let Some(cause) = &facts.unreadable {
                self.warn(self.tracked(|it| it.not_read(&facts.name, cause)));
            }
        }
        Ok(report)
    }

    /// Reads an unreadable clip again, if one is due, and announces what is new of it.
    async fn clip_again(&mut self, orders: &ClipOrders) -> Result<Option<ClipOrders>, Failure> {
        let Some(name) = self.tracked(ClipTracker::due) else { return Ok(None) };
        let report = self.read(None, Some(name.clone())).await?;
        let cause = report.iter().flat_map(|it| &it.clips).find_map(|it| it.unreadable.as_ref());
        let is_readable = cause.is_none();
        if let Some(cause) = cause {
            self.not_read(&name, cause).await;
            if orders.wanted.iter().all(|it| it.name != name) {
                return Ok(None);
            }
        }
        let report = report.unwrap_or_else(|| {
            let reason = "the list of the vehicle lacks it".to_owned();
            let gone = vec![GoneClip { name: name.clone(), is_thumbnail: false, reason }];
            ClipReport { gone, ..ClipReport::default() }
        });
        self.begin(Some((name.clone(), false)));
        let orders = self.report(&report).await?;
        self.current = None;
        self.tracked(|it| it.announced(&name, is_readable));
        Ok(Some(orders))
    }

    /// Reads clips of the list, also after the end of the connection. One thread of all connections
    /// does so at a time, and keeps its results for the next one.
    async fn read(
        &self,
        cursor: Option<String>,
        only: Option<ClipName>,
    ) -> Result<Option<ClipReport>, Failure> {
        let reads = self.tracked(|it| Arc::clone(&it.reads));
        let mut reads = reads.lock_owned().await;
        let (core, folder) = (Arc::clone(&self.core), self.folder.clone());
        let read = in_background(move || {
            let (begin, builds) = (Instant::now(), known_builds(&core));
            let (reads, again) = &mut *reads;
            let report = folder.clips(cursor.as_deref(), only.as_ref(), &builds, reads);
            if only.is_some() {
                *again = Some(Instant::now() + begin.elapsed() * AGAIN_FACTOR).max(*again);
            }
            report
        });
        read.await.map_err(|error| unreadable(&error))
    }

    /// Notes that a clip cannot be read, and forgets what earlier reads of it have found.
    async fn not_read(&self, name: &ClipName, cause: &str) {
        self.warn(self.tracked(|it| it.not_read(name, cause)));
        let reads = self.tracked(|it| Arc::clone(&it.reads));
        reads.lock().await.0.retain(|((known, ..), _)| known != name);
    }
}

/// Awaits a request with so many bytes, and then the time that it takes at the allowed rate. Small
/// ones count as well, so that no cloud makes the vehicle send them in a loop.
async fn paced(
    bytes: usize,
    request: impl Future<Output = Result<ClipOrders, Failure>>,
) -> Result<ClipOrders, Failure> {
    let begin = Instant::now();
    let orders = request.await?;
    let due = Duration::from_secs_f64((bytes as f64 + 64e3) / RATE);
    sleep(due.saturating_sub(begin.elapsed())).await;
    Ok(orders)
}

fn unreadable(error: &io::Error) -> Failure {
    Failure::caused_by(Exit::Internal, "cannot read the clips of this vehicle", error)
}

/// Reads in a thread of its own with the lowest priority: the recorder and the lambdas come first.
/// It goes on if this is dropped.
async fn in_background<T: Send + 'static>(
    read: impl FnOnce() -> io::Result<T> + Send + 'static,
) -> io::Result<T> {
    let (result, received) = oneshot::channel();
    std::thread::Builder::new().name("clips".to_owned()).spawn(move || {
        // Linux applies it to the thread. Without it, the rates still hold.
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 19);
        let _ = result.send(read());
    })?;
    received.await.map_err(io::Error::other)?
}

#[cfg(test)]
mod tests;

//! Announces clips to the cloud, and sends those that it wants: a task for each connection.
//!
//! The cloud keeps the position up to which clips were announced, and the number of the next part
//! of each file: this has no state of its own, and goes on wherever a kill has interrupted it.
//! One file is sent at a time. Nothing here writes to the folder of clips or deletes from it.

use std::convert::Infallible;
use std::io;
use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_fleet::clips::{ClipName, ClipOrders, ClipReport, GoneClip, WantedClip};
use gleaner_trust::sha256;
use tokio::sync::{oneshot, watch};
use tokio::time::sleep;

use super::clip_list::{ClipFolder, is_gone, known_builds};
use super::http::CloudHttp;
use crate::core::Core;

/// Interval of looks for new clips.
const INTERVAL: Duration = Duration::from_secs(5);
/// Longest time between two looks at what is wanted, such as after a budget was used up.
const ORDERS_INTERVAL: Duration = Duration::from_secs(300);
/// Pause after a failure; it doubles up to the longest.
const PAUSE: Duration = Duration::from_secs(2);
const PAUSE_MAX: Duration = Duration::from_secs(300);
/// Bytes per second that are sent, whatever the cloud wants.
const RATE: f64 = 8e6;

/// The task.
pub(super) struct ClipSender {
    pub(super) core: Arc<Core>,
    pub(super) folder: ClipFolder,
    pub(super) http: CloudHttp,
    /// Number of the wanted state: with each new one, the cloud may want other clips.
    pub(super) wanted: watch::Receiver<u64>,
    pub(super) pause: Duration,
}

impl ClipSender {
    pub(super) fn new(
        core: Arc<Core>,
        folder: ClipFolder,
        http: CloudHttp,
        wanted: watch::Receiver<u64>,
    ) -> Self {
        Self { core, folder, http, wanted, pause: PAUSE }
    }

    /// Runs until it is aborted, with the end of the connection.
    pub(super) async fn run(mut self) {
        loop {
            let Err(failure) = self.serve().await;
            tracing::debug!("clips cannot be sent to the cloud now: {failure}");
            sleep(self.pause).await;
            self.pause = (self.pause * 2).min(PAUSE_MAX);
        }
    }

    /// Announces and sends until something fails.
    async fn serve(&mut self) -> Result<Infallible, Failure> {
        let mut length = None;
        loop {
            self.wanted.borrow_and_update();
            let mut orders = self.report(&ClipReport::default()).await?;
            let until = Instant::now() + ORDERS_INTERVAL;
            loop {
                if length != Some(self.folder.length()) {
                    let seen = self.folder.length();
                    match self.new_clips(orders.cursor.clone()).await? {
                        Some(report) => {
                            orders = self.report(&report).await?;
                            // Else the same clips would be read again, without an end.
                            if orders.cursor != report.cursor {
                                return Err(not_stored());
                            }
                        }
                        None => length = Some(seen),
                    }
                } else if let Some(name) = orders.thumbnails.first() {
                    orders = self.send_thumbnail(name).await?;
                } else if let Some(wanted) = orders.wanted.first() {
                    orders = self.send_part(wanted).await?;
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
                self.pause = PAUSE;
            }
        }
    }

    async fn report(&self, report: &ClipReport) -> Result<ClipOrders, Failure> {
        paced(0, self.http.post("/v1/clips", report)).await
    }

    async fn send_thumbnail(&self, name: &ClipName) -> Result<ClipOrders, Failure> {
        let path = format!("/v1/clips/{name}/thumbnail");
        let (folder, of) = (self.folder.clone(), name.clone());
        match self.reading(move || folder.thumbnail(&of)).await? {
            Ok(image) => self.send(&path, image).await,
            Err(reason) => self.report_gone(name, true, reason).await,
        }
    }

    async fn send_part(&self, wanted: &WantedClip) -> Result<ClipOrders, Failure> {
        let WantedClip { name, bytes, part, .. } = wanted.clone();
        let (folder, of) = (self.folder.clone(), name.clone());
        match self.reading(move || folder.part(&of, bytes, part)).await? {
            Ok(content) => {
                let path = format!("/v1/clips/{name}/parts/{part}/{}", sha256(&content));
                self.send(&path, content).await
            }
            Err(reason) => self.report_gone(&name, false, reason).await,
        }
    }

    async fn send(&self, path: &str, content: Vec<u8>) -> Result<ClipOrders, Failure> {
        let bytes = content.len();
        paced(bytes, self.http.put(path, content)).await
    }

    async fn report_gone(
        &self,
        name: &ClipName,
        is_thumbnail: bool,
        reason: String,
    ) -> Result<ClipOrders, Failure> {
        let gone = GoneClip { name: name.clone(), is_thumbnail, reason };
        self.report(&ClipReport { gone: vec![gone], ..ClipReport::default() }).await
    }

    /// Reads a file; the inner error is the reason why it is gone.
    async fn reading(
        &self,
        read: impl FnOnce() -> io::Result<Vec<u8>> + Send + 'static,
    ) -> Result<Result<Vec<u8>, String>, Failure> {
        match in_background(move |_| read()).await {
            Ok(content) => Ok(Ok(content)),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {
                Ok(Err("the vehicle has deleted the file".to_owned()))
            }
            Err(error) if is_gone(&error) => Ok(Err(error.to_string())),
            Err(error) => Err(unreadable(&error)),
        }
    }

    async fn new_clips(&self, cursor: Option<String>) -> Result<Option<ClipReport>, Failure> {
        let (core, folder) = (Arc::clone(&self.core), self.folder.clone());
        let read = in_background(move |is_over| {
            folder.new_clips(cursor.as_deref(), &known_builds(&core), is_over)
        });
        read.await.map_err(|error| unreadable(&error))
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

fn not_stored() -> Failure {
    Failure::new(Exit::Unreachable, "the cloud did not store the list of clips")
}

fn unreadable(error: &io::Error) -> Failure {
    Failure::caused_by(Exit::Internal, "cannot read the clips of this vehicle", error)
}

/// Reads in a thread of its own with the lowest priority, which ends soon after this is dropped:
/// the recorder and the lambdas come first.
async fn in_background<T: Send + 'static>(
    read: impl FnOnce(&dyn Fn() -> bool) -> io::Result<T> + Send + 'static,
) -> io::Result<T> {
    let (result, received) = oneshot::channel();
    std::thread::Builder::new().name("clips".to_owned()).spawn(move || {
        // Linux applies it to the thread. Without it, the rates still hold.
        let _ = rustix::process::setpriority_process(Some(rustix::thread::gettid()), 19);
        let read = read(&|| result.is_closed());
        let _ = result.send(read);
    })?;
    received.await.map_err(io::Error::other)?
}

#[cfg(test)]
mod tests;

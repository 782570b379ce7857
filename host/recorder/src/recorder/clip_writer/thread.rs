//! The thread that writes clips, and its queues. Between its jobs it recovers unfinished clips of
//! an earlier process.

use std::io;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::sync::{Arc, OnceLock};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_transport::SampleMeta;

use super::ClipOutcome;
use super::clip_files::{ClipCompletion, ClipFiles};
use crate::RecordError;
use crate::file::{ClipHeader, TopicSchema};

/// Messages are sent in batches of this many bytes.
const BATCH: usize = 1 << 20;
/// Approximate overhead of a queued message.
const OVERHEAD: usize = 128;
/// Approximate cost of any other job.
const JOB: usize = 4 << 10;
/// Empty batches that are kept for reuse.
const SPARE: usize = 16;
/// Time that a recovery may still take once the recording ends; the rest is left for the next
/// start.
const RECOVERY: Duration = Duration::from_secs(5);

/// A job of the thread.
enum WriterJob {
    Begin(u64, String, Box<ClipHeader>),
    Images(u64, usize),
    Image(Batch),
    Messages(Batch),
    Forget(u64),
    Finish(Box<ClipCompletion>),
}

impl WriterJob {
    /// The clip of the job.
    fn clip(&self) -> u64 {
        match self {
            WriterJob::Begin(clip, ..) | WriterJob::Images(clip, _) | WriterJob::Forget(clip) => {
                *clip
            }
            WriterJob::Image(batch) | WriterJob::Messages(batch) => batch.clip,
            WriterJob::Finish(completion) => completion.clip,
        }
    }
}

/// The result of a job.
enum JobResult {
    Nothing,
    /// An empty batch for reuse.
    Messages(Batch),
    Clip(ClipOutcome),
    /// The recovery is done or aborted.
    Recovery,
}

/// Messages of one clip.
#[derive(Default)]
struct Batch {
    clip: u64,
    bytes: Vec<u8>,
    messages: Vec<BatchMessage>,
}

struct BatchMessage {
    topic: usize,
    of: Arc<TopicSchema>,
    meta: SampleMeta,
    len: usize,
}

impl Batch {
    fn push(&mut self, topic: usize, of: &Arc<TopicSchema>, meta: &SampleMeta, cdr: &[u8]) {
        self.bytes.extend_from_slice(cdr);
        self.messages.push(BatchMessage { topic, of: Arc::clone(of), meta: *meta, len: cdr.len() });
    }

    fn cost(&self) -> usize {
        self.bytes.len() + OVERHEAD * self.messages.len()
    }

    fn each(
        &self,
        mut act: impl FnMut(&BatchMessage, &[u8]) -> Result<(), RecordError>,
    ) -> Result<(), RecordError> {
        let mut at = 0;
        for message in &self.messages {
            act(message, &self.bytes[at..at + message.len])?;
            at += message.len;
        }
        Ok(())
    }

    fn clear(&mut self) {
        self.bytes.clear();
        self.messages.clear();
    }
}

/// The handle of the thread.
pub(in crate::recorder) struct WriterThread {
    /// `None` once it is to end.
    jobs: Option<Sender<(usize, WriterJob)>>,
    /// Cost and result of each job.
    done: Receiver<(usize, JobResult)>,
    handle: Option<JoinHandle<()>>,
    batch: Batch,
    in_flight: usize,
    spare: Vec<Batch>,
    is_recovering: bool,
    /// The deadline of the recovery, once it is set.
    until: Arc<OnceLock<Instant>>,
}

impl WriterThread {
    pub(super) fn start(files: ClipFiles) -> Result<WriterThread, RecordError> {
        // Neither queue has a bound of its own: its content is counted, and nothing is added when
        // the writer has no room.
        let ((jobs, inbox), (outbox, done)) = (channel(), channel());
        let until = Arc::<OnceLock<_>>::default();
        let given_up = Arc::clone(&until);
        let handle = Builder::new()
            .name("clips".to_owned())
            .spawn(move || {
                WriterLoop { files, failed: Vec::new(), done: outbox }.run(&inbox, &given_up)
            })
            .map_err(|source| RecordError::Thread { source })?;
        let (batch, spare) = (Batch::default(), Vec::new());
        Ok(WriterThread {
            jobs: Some(jobs),
            done,
            handle: Some(handle),
            batch,
            in_flight: 0,
            spare,
            is_recovering: true,
            until,
        })
    }

    /// Gives the recovery some more seconds.
    pub(super) fn end_recovery(&self) {
        self.until.get_or_init(|| Instant::now() + RECOVERY);
    }

    pub(super) fn is_recovering(&self) -> bool {
        self.is_recovering
    }

    pub(super) fn begin(
        &mut self,
        clip: u64,
        clip_name: String,
        clip_header: ClipHeader,
    ) -> Result<(), RecordError> {
        self.send(WriterJob::Begin(clip, clip_name, Box::new(clip_header)), JOB)
    }

    pub(super) fn images(&mut self, clip: u64, topic: usize) -> Result<(), RecordError> {
        self.send(WriterJob::Images(clip, topic), JOB)
    }

    pub(super) fn image(
        &mut self,
        clip: u64,
        of: &Arc<TopicSchema>,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        let mut batch = Batch { clip, ..Batch::default() };
        batch.push(0, of, meta, cdr);
        let cost = batch.cost();
        self.send(WriterJob::Image(batch), cost)
    }

    pub(super) fn message(
        &mut self,
        clip: u64,
        topic: usize,
        of: &Arc<TopicSchema>,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        if self.batch.clip != clip || self.batch.cost() + cdr.len() > BATCH {
            self.hand_over()?;
            self.batch.clip = clip;
        }
        self.batch.push(topic, of, meta, cdr);
        if self.batch.cost() >= BATCH { self.hand_over() } else { Ok(()) }
    }

    pub(super) fn forget(&mut self, clip: u64) -> Result<(), RecordError> {
        self.send(WriterJob::Forget(clip), JOB)
    }

    pub(super) fn finish(&mut self, completion: ClipCompletion) -> Result<(), RecordError> {
        let cost = JOB + completion.journals.iter().map(|(_, _, part)| part.bytes()).sum::<usize>();
        self.send(WriterJob::Finish(Box::new(completion)), cost)
    }

    pub(super) fn in_flight(&self) -> usize {
        self.in_flight + self.batch.cost()
    }

    pub(super) fn poll(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        loop {
            match self.done.try_recv() {
                Ok(done) => self.note(done, outcomes),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => return Err(gone()),
            }
        }
        // Small messages are collected only while the thread has other work.
        if self.in_flight == 0 { self.hand_over() } else { Ok(()) }
    }

    pub(super) fn wait(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        self.hand_over()?;
        if self.in_flight > 0 || self.is_recovering {
            let done = self.done.recv().map_err(|_| gone())?;
            self.note(done, outcomes);
        }
        self.poll(outcomes)
    }

    fn note(&mut self, (cost, done): (usize, JobResult), outcomes: &mut Vec<ClipOutcome>) {
        self.in_flight -= cost;
        match done {
            // A batch that held a large message would keep its memory.
            JobResult::Messages(batch)
                if self.spare.len() < SPARE && batch.bytes.capacity() <= 2 * BATCH =>
            {
                self.spare.push(batch);
            }
            JobResult::Clip(outcome) => outcomes.push(outcome),
            JobResult::Recovery => self.is_recovering = false,
            JobResult::Messages(_) | JobResult::Nothing => {}
        }
    }

    /// Sends the collected messages.
    fn hand_over(&mut self) -> Result<(), RecordError> {
        if self.batch.messages.is_empty() {
            return Ok(());
        }
        let batch = std::mem::replace(&mut self.batch, self.spare.pop().unwrap_or_default());
        self.batch.clip = batch.clip;
        self.give(batch.cost(), WriterJob::Messages(batch))
    }

    /// Sends a job, after the collected messages.
    fn send(&mut self, job: WriterJob, cost: usize) -> Result<(), RecordError> {
        self.hand_over()?;
        self.give(cost, job)
    }

    fn give(&mut self, cost: usize, job: WriterJob) -> Result<(), RecordError> {
        self.in_flight += cost;
        let jobs = self.jobs.as_ref().ok_or_else(gone)?;
        jobs.send((cost, job)).map_err(|_| gone())
    }
}

impl Drop for WriterThread {
    /// Waits for queued jobs; an unfinished clip stays for recovery.
    fn drop(&mut self) {
        self.jobs = None;
        let _ = self.until.set(Instant::now());
        if let Some(handle) = self.handle.take() {
            let _ = handle.join();
        }
    }
}

fn gone() -> RecordError {
    RecordError::Thread { source: io::Error::other("the thread that writes clips has ended") }
}

/// The state of the thread.
struct WriterLoop {
    files: ClipFiles,
    /// Clips that failed: their further jobs are skipped. Each is removed with its last job.
    failed: Vec<u64>,
    done: Sender<(usize, JobResult)>,
}

impl WriterLoop {
    /// Runs until the job queue is closed. Jobs do not wait for the recovery.
    fn run(mut self, jobs: &Receiver<(usize, WriterJob)>, until: &OnceLock<Instant>) {
        let mut recovery = self.files.take_unfinished();
        while let Some(came) = recovery.next(&mut || {
            let is_heard =
                std::iter::from_fn(|| jobs.try_recv().ok()).all(|(cost, job)| self.job(cost, job));
            is_heard && until.get().is_none_or(|until| Instant::now() < *until)
        }) {
            let outcome = match came {
                Ok(clip) => {
                    let deleted = self.files.make_room(&clip);
                    ClipOutcome::Recovered(Box::new(clip), deleted)
                }
                Err(error) => ClipOutcome::Failed(error),
            };
            if self.done.send((0, JobResult::Clip(outcome))).is_err() {
                return;
            }
        }
        let _ = self.done.send((0, JobResult::Recovery));
        for (cost, job) in jobs {
            if !self.job(cost, job) {
                return;
            }
        }
    }

    /// Does a job; `false` if the handle is gone.
    fn job(&mut self, cost: usize, job: WriterJob) -> bool {
        let clip = job.clip();
        let came = match job {
            WriterJob::Forget(_) => {
                self.files.forget(clip);
                self.failed.retain(|failed| *failed != clip);
                JobResult::Nothing
            }
            WriterJob::Finish(_) if self.failed.contains(&clip) => {
                self.failed.retain(|failed| *failed != clip);
                JobResult::Nothing
            }
            WriterJob::Finish(completion) => {
                JobResult::Clip(match self.files.finish(*completion) {
                    Ok(clip) => {
                        let deleted = self.files.make_room(&clip);
                        ClipOutcome::Finished(Box::new(clip), deleted)
                    }
                    Err(error) => {
                        self.files.forget(clip);
                        ClipOutcome::Failed(error)
                    }
                })
            }
            _ if self.failed.contains(&clip) => JobResult::Nothing,
            job => match act(&mut self.files, job) {
                Ok(came) => came,
                Err(error) => {
                    self.files.forget(clip);
                    self.failed.push(clip);
                    JobResult::Clip(ClipOutcome::Failed(error))
                }
            },
        };
        self.done.send((cost, came)).is_ok()
    }
}

fn act(files: &mut ClipFiles, job: WriterJob) -> Result<JobResult, RecordError> {
    match job {
        WriterJob::Begin(clip, clip_name, clip_header) => {
            files.begin(clip, &clip_name, &clip_header)?
        }
        WriterJob::Images(clip, topic) => files.images(clip, topic),
        WriterJob::Image(batch) => batch.each(|message, cdr| {
            files.image(batch.clip, &message.of, &message.meta, cdr);
            Ok(())
        })?,
        WriterJob::Messages(mut batch) => {
            let clip = batch.clip;
            batch.each(|BatchMessage { topic, of, meta, .. }, cdr| {
                files.message(clip, *topic, of, meta, cdr)
            })?;
            batch.clear();
            return Ok(JobResult::Messages(batch));
        }
        // Handled by the caller.
        WriterJob::Forget(_) | WriterJob::Finish(_) => {}
    }
    Ok(JobResult::Nothing)
}

//! The thread that writes clips, and its queues. Between its jobs it recovers unfinished clips of
//! an earlier process.

use std::io;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_messages::transport::SampleMeta;

use super::file::{ClipCompletion, ClipFile};
use super::{ClipOutcome, ClipSample};
use crate::RecordError;
use crate::file::{ClipHeader, RecordingFolder, TopicSchema};

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

struct WriterJob {
    clip: u64,
    /// Bytes that it takes while it is queued.
    cost: usize,
    work: ClipWork,
}

enum ClipWork {
    Begin(String, Box<ClipHeader>),
    ThumbnailOf(usize),
    Thumbnail(Batch),
    Messages(Batch),
    /// Nothing further comes for a clip that is not finished.
    Forget,
    Finish(Box<ClipCompletion>),
}

enum WriterMessage {
    Job(WriterJob),
    /// No further job comes.
    End,
}

enum JobResult {
    Nothing,
    Clip(ClipOutcome),
    /// The recovery is done or aborted.
    Recovery,
}

#[derive(Default)]
struct Batch {
    bytes: Vec<u8>,
    messages: Vec<BatchMessage>,
}

struct BatchMessage {
    topic: usize,
    schema: Arc<TopicSchema>,
    meta: SampleMeta,
    len: usize,
}

impl Batch {
    fn push(&mut self, ClipSample { topic, schema, meta, cdr }: ClipSample<'_>) {
        self.bytes.extend_from_slice(cdr);
        let (schema, meta) = (Arc::clone(schema), *meta);
        self.messages.push(BatchMessage { topic, schema, meta, len: cdr.len() });
    }

    fn samples(&self) -> impl Iterator<Item = ClipSample<'_>> {
        let mut rest = &self.bytes[..];
        self.messages.iter().map(move |BatchMessage { topic, schema, meta, len }| {
            let (cdr, after) = rest.split_at(*len);
            rest = after;
            ClipSample { topic: *topic, schema, meta, cdr }
        })
    }

    fn cost(&self) -> usize {
        self.bytes.len() + OVERHEAD * self.messages.len()
    }
}

/// Bytes on their way to the disk, and empty batches for reuse.
#[derive(Default)]
struct Flow {
    /// Bytes of messages that are collected in batches.
    collected: AtomicUsize,
    /// Cost of the jobs of the thread.
    queued: AtomicUsize,
    spare: Mutex<Vec<Batch>>,
}

impl Flow {
    fn take_batch(&self) -> Batch {
        self.spare.lock().unwrap_or_else(PoisonError::into_inner).pop().unwrap_or_default()
    }

    fn give_back(&self, mut batch: Batch) {
        batch.bytes.clear();
        batch.messages.clear();
        let mut spare = self.spare.lock().unwrap_or_else(PoisonError::into_inner);
        // A batch that held a large message would keep its memory.
        if spare.len() < SPARE && batch.bytes.capacity() <= 2 * BATCH {
            spare.push(batch);
        }
    }
}

pub struct WriterThread {
    jobs: Sender<WriterMessage>,
    /// Cost and result of each job.
    done: Receiver<(usize, JobResult)>,
    handle: Option<JoinHandle<()>>,
    flow: Arc<Flow>,
    clips: u64,
    is_recovering: bool,
    /// The deadline of the recovery, once it is set.
    until: Arc<OnceLock<Instant>>,
}

impl WriterThread {
    pub fn start(folder: RecordingFolder) -> Result<WriterThread, RecordError> {
        // Neither queue has a bound of its own: its content is counted, and nothing is added when
        // the disk has no room.
        let ((jobs, inbox), (outbox, done)) = (channel(), channel());
        let (flow, until) = (Arc::<Flow>::default(), Arc::<OnceLock<_>>::default());
        let (shared, given_up) = (Arc::clone(&flow), Arc::clone(&until));
        let handle = Builder::new()
            .name("clips".to_owned())
            .spawn(move || {
                let writer = WriterLoop {
                    folder,
                    open: Vec::new(),
                    failed: Vec::new(),
                    done: outbox,
                    flow: shared,
                    is_ended: false,
                };
                writer.run(&inbox, &given_up);
            })
            .map_err(|source| RecordError::Thread { source })?;
        let handle = Some(handle);
        Ok(WriterThread { jobs, done, handle, flow, clips: 0, is_recovering: true, until })
    }

    pub fn new_clip(&mut self) -> QueuedClip {
        self.clips += 1;
        let (jobs, flow) = (self.jobs.clone(), Arc::clone(&self.flow));
        QueuedClip { clip: self.clips, jobs, flow, batch: Batch::default(), is_finished: false }
    }

    /// Gives the recovery some more seconds.
    pub fn end_recovery(&self) {
        self.until.get_or_init(|| Instant::now() + RECOVERY);
    }

    pub fn is_recovering(&self) -> bool {
        self.is_recovering
    }

    /// Cost of the jobs of the thread.
    pub fn queued(&self) -> usize {
        self.flow.queued.load(Ordering::Relaxed)
    }

    pub fn in_flight(&self) -> usize {
        self.queued() + self.flow.collected.load(Ordering::Relaxed)
    }

    pub fn poll(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        loop {
            match self.done.try_recv() {
                Ok(done) => self.note(done, outcomes),
                Err(TryRecvError::Empty) => return Ok(()),
                Err(TryRecvError::Disconnected) => return Err(gone()),
            }
        }
    }

    pub fn wait(&mut self, outcomes: &mut Vec<ClipOutcome>) -> Result<(), RecordError> {
        if self.queued() > 0 || self.is_recovering {
            let done = self.done.recv().map_err(|_| gone())?;
            self.note(done, outcomes);
        }
        self.poll(outcomes)
    }

    fn note(&mut self, (cost, done): (usize, JobResult), outcomes: &mut Vec<ClipOutcome>) {
        self.flow.queued.fetch_sub(cost, Ordering::Relaxed);
        match done {
            JobResult::Clip(outcome) => outcomes.push(outcome),
            JobResult::Recovery => self.is_recovering = false,
            JobResult::Nothing => {}
        }
    }
}

impl Drop for WriterThread {
    /// Waits for queued jobs; an unfinished clip stays for recovery.
    fn drop(&mut self) {
        let _ = self.jobs.send(WriterMessage::End);
        let _ = self.until.set(Instant::now());
        if let Some(handle) = self.handle.take() {
            let _ = handle.join();
        }
    }
}

pub struct QueuedClip {
    clip: u64,
    jobs: Sender<WriterMessage>,
    flow: Arc<Flow>,
    batch: Batch,
    is_finished: bool,
}

impl QueuedClip {
    pub fn begin(&mut self, name: String, header: ClipHeader) -> Result<(), RecordError> {
        self.send(ClipWork::Begin(name, Box::new(header)), JOB)
    }

    pub fn thumbnail_of(&mut self, topic: usize) -> Result<(), RecordError> {
        self.send(ClipWork::ThumbnailOf(topic), JOB)
    }

    pub fn thumbnail(&mut self, sample: ClipSample<'_>) -> Result<(), RecordError> {
        let mut batch = Batch::default();
        batch.push(sample);
        let cost = batch.cost();
        self.send(ClipWork::Thumbnail(batch), cost)
    }

    pub fn write(&mut self, sample: ClipSample<'_>) -> Result<(), RecordError> {
        if self.batch.cost() + sample.cdr.len() > BATCH {
            self.flush()?;
        }
        let before = self.batch.cost();
        self.batch.push(sample);
        let after = self.batch.cost();
        self.flow.collected.fetch_add(after - before, Ordering::Relaxed);
        if after >= BATCH { self.flush() } else { Ok(()) }
    }

    pub fn flush(&mut self) -> Result<(), RecordError> {
        if self.batch.messages.is_empty() {
            return Ok(());
        }
        let batch = std::mem::replace(&mut self.batch, self.flow.take_batch());
        let cost = batch.cost();
        self.flow.collected.fetch_sub(cost, Ordering::Relaxed);
        self.queue(ClipWork::Messages(batch), cost)
    }

    pub fn finish(mut self, completion: ClipCompletion) -> Result<(), RecordError> {
        self.is_finished = true;
        let cost = JOB + completion.journals.iter().map(|(_, _, part)| part.bytes()).sum::<usize>();
        self.send(ClipWork::Finish(Box::new(completion)), cost)
    }

    /// Sends a job, after the collected messages.
    fn send(&mut self, work: ClipWork, cost: usize) -> Result<(), RecordError> {
        self.flush()?;
        self.queue(work, cost)
    }

    fn queue(&self, work: ClipWork, cost: usize) -> Result<(), RecordError> {
        self.flow.queued.fetch_add(cost, Ordering::Relaxed);
        let job = WriterJob { clip: self.clip, cost, work };
        self.jobs.send(WriterMessage::Job(job)).map_err(|_| gone())
    }
}

impl Drop for QueuedClip {
    fn drop(&mut self) {
        self.flow.collected.fetch_sub(self.batch.cost(), Ordering::Relaxed);
        if !self.is_finished {
            // A thread that has ended needs no job.
            let _ = self.queue(ClipWork::Forget, JOB);
        }
    }
}

fn gone() -> RecordError {
    RecordError::Thread { source: io::Error::other("the thread that writes clips has ended") }
}

struct WriterLoop {
    folder: RecordingFolder,
    open: Vec<(u64, ClipFile)>,
    /// Clips that failed: their further jobs are skipped. Each is removed with its last job.
    failed: Vec<u64>,
    done: Sender<(usize, JobResult)>,
    flow: Arc<Flow>,
    is_ended: bool,
}

impl WriterLoop {
    /// Runs until the handle is dropped. Jobs do not wait for the recovery.
    fn run(mut self, inbox: &Receiver<WriterMessage>, until: &OnceLock<Instant>) {
        let mut recovery = self.folder.take_unfinished();
        while let Some(came) = recovery.next(&mut || {
            std::iter::from_fn(|| inbox.try_recv().ok()).for_each(|message| self.act(message));
            !self.is_ended && until.get().is_none_or(|until| Instant::now() < *until)
        }) {
            let outcome = match came {
                Ok(clip) => {
                    let deleted = self.folder.make_room(&clip);
                    ClipOutcome::Recovered(Box::new(clip), deleted)
                }
                Err(error) => ClipOutcome::Failed(error),
            };
            if self.done.send((0, JobResult::Clip(outcome))).is_err() {
                return;
            }
        }
        let _ = self.done.send((0, JobResult::Recovery));
        while !self.is_ended {
            let Ok(message) = inbox.recv() else { return };
            self.act(message);
        }
    }

    fn act(&mut self, message: WriterMessage) {
        let WriterMessage::Job(WriterJob { clip, cost, work }) = message else {
            self.is_ended = true;
            return;
        };
        let is_last = matches!(work, ClipWork::Forget | ClipWork::Finish(_));
        let came = match self.failed.contains(&clip) {
            true => JobResult::Nothing,
            false => self.job(clip, work).unwrap_or_else(|error| {
                self.take(clip);
                self.failed.push(clip);
                JobResult::Clip(ClipOutcome::Failed(error))
            }),
        };
        if is_last {
            self.failed.retain(|failed| *failed != clip);
        }
        self.is_ended |= self.done.send((cost, came)).is_err();
    }

    fn job(&mut self, clip: u64, work: ClipWork) -> Result<JobResult, RecordError> {
        match work {
            ClipWork::Begin(name, header) => {
                let mut file = self.take(clip);
                file.begin(&mut self.folder, &name, &header)?;
                self.open.push((clip, file));
            }
            ClipWork::ThumbnailOf(topic) => self.file(clip).thumbnail_of(topic),
            ClipWork::Thumbnail(batch) => {
                let file = self.file(clip);
                batch.samples().for_each(|sample| file.thumbnail(sample));
            }
            ClipWork::Messages(batch) => {
                let file = self.file(clip);
                batch.samples().try_for_each(|sample| file.write(sample))?;
                self.flow.give_back(batch);
            }
            ClipWork::Forget => drop(self.take(clip)),
            ClipWork::Finish(completion) => {
                let finished = self.take(clip).finish(*completion)?;
                let deleted = self.folder.make_room(&finished);
                return Ok(JobResult::Clip(ClipOutcome::Finished(Box::new(finished), deleted)));
            }
        }
        Ok(JobResult::Nothing)
    }

    fn file(&mut self, clip: u64) -> &mut ClipFile {
        let index = self.open.iter().position(|(open, _)| *open == clip).unwrap_or_else(|| {
            self.open.push((clip, ClipFile::default()));
            self.open.len() - 1
        });
        &mut self.open[index].1
    }

    /// Removes a clip from the open ones.
    fn take(&mut self, clip: u64) -> ClipFile {
        let index = self.open.iter().position(|(open, _)| *open == clip);
        index.map(|index| self.open.swap_remove(index).1).unwrap_or_default()
    }
}

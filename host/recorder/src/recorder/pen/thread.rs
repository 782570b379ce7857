//! The thread that writes clips, and what is on its way to it. It also recovers what an earlier
//! process left, between its jobs.

use std::io;
use std::sync::mpsc::{Receiver, Sender, TryRecvError, channel};
use std::sync::{Arc, OnceLock};
use std::thread::{Builder, JoinHandle};
use std::time::{Duration, Instant};

use gleaner_transport::SampleMeta;

use super::Outcome;
use super::scribe::{Last, Scribe};
use crate::RecordError;
use crate::file::{About, Topic};

/// Messages are handed over when they have so many bytes together.
const BATCH: usize = 1 << 20;
/// What a message costs on its way beside its bytes, about.
const OVERHEAD: usize = 128;
/// What any other job costs, about.
const JOB: usize = 4 << 10;
/// Batches that were written and are kept for the next messages.
const SPARE: usize = 16;
/// How long a recovery may still take once the recording ends; what it does not reach is left for
/// the next start.
const RECOVERY: Duration = Duration::from_secs(5);

/// What the thread is to do.
enum Job {
    Begin(u64, String, Box<About>),
    Images(u64, usize),
    Image(Batch),
    Messages(Batch),
    Forget(u64),
    Finish(Box<Last>),
}

impl Job {
    /// Whose job it is.
    fn clip(&self) -> u64 {
        match self {
            Job::Begin(clip, ..) | Job::Images(clip, _) | Job::Forget(clip) => *clip,
            Job::Image(batch) | Job::Messages(batch) => batch.clip,
            Job::Finish(last) => last.clip,
        }
    }
}

/// What came of a job.
enum Done {
    Nothing,
    /// This is empty now, and may be used again.
    Messages(Batch),
    Clip(Outcome),
    /// Nothing is left to recover, or it is left for another process.
    Recovery,
}

/// Messages of one clip.
#[derive(Default)]
struct Batch {
    clip: u64,
    bytes: Vec<u8>,
    messages: Vec<Message>,
}

struct Message {
    topic: usize,
    of: Arc<Topic>,
    meta: SampleMeta,
    len: usize,
}

impl Batch {
    fn push(&mut self, topic: usize, of: &Arc<Topic>, meta: &SampleMeta, cdr: &[u8]) {
        self.bytes.extend_from_slice(cdr);
        self.messages.push(Message { topic, of: Arc::clone(of), meta: *meta, len: cdr.len() });
    }

    fn cost(&self) -> usize {
        self.bytes.len() + OVERHEAD * self.messages.len()
    }

    fn each(
        &self,
        mut act: impl FnMut(&Message, &[u8]) -> Result<(), RecordError>,
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

/// The thread, seen from those who record.
pub(in crate::recorder) struct Thread {
    /// `None` once it is to end.
    jobs: Option<Sender<(usize, Job)>>,
    /// Of each job what it was counted as, and what came of it.
    done: Receiver<(usize, Done)>,
    handle: Option<JoinHandle<()>>,
    batch: Batch,
    in_flight: usize,
    spare: Vec<Batch>,
    is_recovering: bool,
    /// When a recovery gives up, once that is known.
    until: Arc<OnceLock<Instant>>,
}

impl Thread {
    pub(super) fn start(scribe: Scribe) -> Result<Thread, RecordError> {
        // Neither queue has a bound of its own: what is in them is counted, and nothing is added
        // beyond what a pen has room for.
        let ((jobs, inbox), (outbox, done)) = (channel(), channel());
        let until = Arc::<OnceLock<_>>::default();
        let given_up = Arc::clone(&until);
        let handle = Builder::new()
            .name("clips".to_owned())
            .spawn(move || {
                Writing { scribe, failed: Vec::new(), done: outbox }.run(&inbox, &given_up)
            })
            .map_err(|source| RecordError::Thread { source })?;
        let (batch, spare) = (Batch::default(), Vec::new());
        Ok(Thread {
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

    /// The recording ends: a recovery has some seconds left.
    pub(super) fn end_recovery(&self) {
        self.until.get_or_init(|| Instant::now() + RECOVERY);
    }

    pub(super) fn is_recovering(&self) -> bool {
        self.is_recovering
    }

    pub(super) fn begin(
        &mut self,
        clip: u64,
        stem: String,
        about: About,
    ) -> Result<(), RecordError> {
        self.send(Job::Begin(clip, stem, Box::new(about)), JOB)
    }

    pub(super) fn images(&mut self, clip: u64, topic: usize) -> Result<(), RecordError> {
        self.send(Job::Images(clip, topic), JOB)
    }

    pub(super) fn image(
        &mut self,
        clip: u64,
        of: &Arc<Topic>,
        meta: &SampleMeta,
        cdr: &[u8],
    ) -> Result<(), RecordError> {
        let mut batch = Batch { clip, ..Batch::default() };
        batch.push(0, of, meta, cdr);
        let cost = batch.cost();
        self.send(Job::Image(batch), cost)
    }

    pub(super) fn message(
        &mut self,
        clip: u64,
        topic: usize,
        of: &Arc<Topic>,
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
        self.send(Job::Forget(clip), JOB)
    }

    pub(super) fn finish(&mut self, last: Last) -> Result<(), RecordError> {
        let cost = JOB + last.journals.iter().map(|(_, _, part)| part.bytes()).sum::<usize>();
        self.send(Job::Finish(Box::new(last)), cost)
    }

    pub(super) fn in_flight(&self) -> usize {
        self.in_flight + self.batch.cost()
    }

    pub(super) fn poll(&mut self, outcomes: &mut Vec<Outcome>) -> Result<(), RecordError> {
        loop {
            match self.done.try_recv() {
                Ok(done) => self.note(done, outcomes),
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => return Err(gone()),
            }
        }
        // Small messages wait for each other only while the thread has other work.
        if self.in_flight == 0 { self.hand_over() } else { Ok(()) }
    }

    pub(super) fn wait(&mut self, outcomes: &mut Vec<Outcome>) -> Result<(), RecordError> {
        self.hand_over()?;
        if self.in_flight > 0 || self.is_recovering {
            let done = self.done.recv().map_err(|_| gone())?;
            self.note(done, outcomes);
        }
        self.poll(outcomes)
    }

    fn note(&mut self, (cost, done): (usize, Done), outcomes: &mut Vec<Outcome>) {
        self.in_flight -= cost;
        match done {
            // One that held a large message would keep its memory for nothing.
            Done::Messages(batch)
                if self.spare.len() < SPARE && batch.bytes.capacity() <= 2 * BATCH =>
            {
                self.spare.push(batch);
            }
            Done::Clip(outcome) => outcomes.push(outcome),
            Done::Recovery => self.is_recovering = false,
            Done::Messages(_) | Done::Nothing => {}
        }
    }

    /// Hands over the messages that were collected.
    fn hand_over(&mut self) -> Result<(), RecordError> {
        if self.batch.messages.is_empty() {
            return Ok(());
        }
        let batch = std::mem::replace(&mut self.batch, self.spare.pop().unwrap_or_default());
        self.batch.clip = batch.clip;
        self.give(batch.cost(), Job::Messages(batch))
    }

    /// Hands over a job, behind the messages that came before it.
    fn send(&mut self, job: Job, cost: usize) -> Result<(), RecordError> {
        self.hand_over()?;
        self.give(cost, job)
    }

    fn give(&mut self, cost: usize, job: Job) -> Result<(), RecordError> {
        self.in_flight += cost;
        let jobs = self.jobs.as_ref().ok_or_else(gone)?;
        jobs.send((cost, job)).map_err(|_| gone())
    }
}

impl Drop for Thread {
    /// Waits for what is under way; a clip that is not finished stays for recovery.
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

/// What the thread has in hand.
struct Writing {
    scribe: Scribe,
    /// Clips that failed: what else is said of them is left out. Each goes with its end.
    failed: Vec<u64>,
    done: Sender<(usize, Done)>,
}

impl Writing {
    /// What the thread does until it is told nothing more. Jobs do not wait for what is recovered.
    fn run(mut self, jobs: &Receiver<(usize, Job)>, until: &OnceLock<Instant>) {
        let mut recovery = self.scribe.take_left();
        while let Some(came) = recovery.next(&mut || {
            let is_heard =
                std::iter::from_fn(|| jobs.try_recv().ok()).all(|(cost, job)| self.job(cost, job));
            is_heard && until.get().is_none_or(|until| Instant::now() < *until)
        }) {
            let outcome = match came {
                Ok(clip) => {
                    let deleted = self.scribe.make_room(&clip);
                    Outcome::Recovered(Box::new(clip), deleted)
                }
                Err(error) => Outcome::Failed(error),
            };
            if self.done.send((0, Done::Clip(outcome))).is_err() {
                return;
            }
        }
        let _ = self.done.send((0, Done::Recovery));
        for (cost, job) in jobs {
            if !self.job(cost, job) {
                return;
            }
        }
    }

    /// Does a job; `false` if nobody wants to know any more.
    fn job(&mut self, cost: usize, job: Job) -> bool {
        let clip = job.clip();
        let came = match job {
            Job::Forget(_) => {
                self.scribe.forget(clip);
                self.failed.retain(|failed| *failed != clip);
                Done::Nothing
            }
            Job::Finish(_) if self.failed.contains(&clip) => {
                self.failed.retain(|failed| *failed != clip);
                Done::Nothing
            }
            Job::Finish(last) => Done::Clip(match self.scribe.finish(*last) {
                Ok(clip) => {
                    let deleted = self.scribe.make_room(&clip);
                    Outcome::Finished(Box::new(clip), deleted)
                }
                Err(error) => {
                    self.scribe.forget(clip);
                    Outcome::Failed(error)
                }
            }),
            _ if self.failed.contains(&clip) => Done::Nothing,
            job => match act(&mut self.scribe, job) {
                Ok(came) => came,
                Err(error) => {
                    self.scribe.forget(clip);
                    self.failed.push(clip);
                    Done::Clip(Outcome::Failed(error))
                }
            },
        };
        self.done.send((cost, came)).is_ok()
    }
}

fn act(scribe: &mut Scribe, job: Job) -> Result<Done, RecordError> {
    match job {
        Job::Begin(clip, stem, about) => scribe.begin(clip, &stem, &about)?,
        Job::Images(clip, topic) => scribe.images(clip, topic),
        Job::Image(batch) => batch.each(|message, cdr| {
            scribe.image(batch.clip, &message.of, &message.meta, cdr);
            Ok(())
        })?,
        Job::Messages(mut batch) => {
            let clip = batch.clip;
            batch.each(|Message { topic, of, meta, .. }, cdr| {
                scribe.message(clip, *topic, of, meta, cdr)
            })?;
            batch.clear();
            return Ok(Done::Messages(batch));
        }
        // Their outcome is not that of a step.
        Job::Forget(_) | Job::Finish(_) => {}
    }
    Ok(Done::Nothing)
}

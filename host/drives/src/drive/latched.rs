//! Latched samples from before the part of a drive that is replayed.

use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use gleaner_messages::transport::{
    Delivery, LatchedSample, LatchedTopics, SampleMeta, Sink, Subscription, TopicSpec, Transport,
};
use tracing::warn;

use super::Replay;
use crate::error::ReplayError;
use crate::options::DriveOptions;
use crate::step::ReplayStep;
use crate::track::nanoseconds;

/// A latched sample from before the part to replay.
pub(super) struct EarlierSample {
    subscription: Subscription,
    sample: LatchedSample,
}

impl Replay {
    /// Delivers first, with the time of the begin of the part to replay, the samples of latched
    /// topics that were valid then: as a node receives them that starts at this time. `paths` and
    /// `options` are those with which the drive was opened. Must be called before the first step.
    ///
    /// Writers of a drive are unknown, so these are all earlier samples of such a topic, at most
    /// 1,000 and 16 MiB of each, and 64 MiB of all; a warning counts the others. If the drive is
    /// damaged before the part, there are none, and the replay ends with
    /// [`ReplayError::WithoutLatched`].
    pub fn begin_with_latched(&mut self, paths: &[PathBuf], options: &DriveOptions) {
        self.opened = Some((paths.to_vec(), DriveOptions { merge: true, ..options.clone() }));
    }

    /// Reads the latched samples of subscribed topics from before the part to replay.
    pub(super) fn read_latched(
        &mut self,
        paths: &[PathBuf],
        options: &DriveOptions,
    ) -> Result<(), ReplayError> {
        let all = self.subscribed.iter().enumerate();
        let latched: Vec<(usize, TopicSpec)> = all
            .filter(|(_, (spec, _))| self.catalog.is_latched(spec))
            .map(|(number, (spec, _))| (number, spec.clone()))
            .collect();
        if latched.is_empty() {
            return Ok(());
        }
        let mut drive = Self::open_as(paths, options)?;
        let from_ns = nanoseconds(self.span.from);
        drive.restrict(0, from_ns);
        let kept = Arc::new(Mutex::new(Kept::default()));
        for (number, spec) in &latched {
            let (number, kept, max_bytes) = (*number, Arc::clone(&kept), spec.max_bytes);
            // As it is subscribed here, it can be there.
            let _ = drive.subscribe(spec, Arc::new(Latched { number, kept, max_bytes }));
        }
        while let Some(step) = drive.step().transpose() {
            if let Err(error) = step {
                // A later sample may have replaced those that were read.
                self.without_latched =
                    Some(ReplayError::WithoutLatched { source: Box::new(error) });
                return Ok(());
            }
        }
        let kept = lock(&kept);
        let mut dropped = kept.too_big;
        for (number, _) in latched {
            let subscription = Subscription(number);
            let (samples, lost) = kept.samples.valid_at(number, from_ns);
            dropped += lost;
            for sample in samples {
                let SampleMeta { writer, seq, .. } = sample.meta;
                self.tracks.iter_mut().for_each(|track| track.skip_to(subscription, writer, seq));
                self.latched.push_back(EarlierSample { subscription, sample });
            }
        }
        if dropped > 0 {
            warn!(dropped, "skipped latched samples from before the replayed part");
        }
        self.latched.make_contiguous().sort_by_key(|earlier| earlier.sample.meta.at_ns);
        Ok(())
    }

    pub(super) fn deliver_latched(&mut self, earlier: EarlierSample) -> ReplayStep {
        let EarlierSample { subscription, sample: LatchedSample { meta, cdr } } = earlier;
        let meta = SampleMeta { at_ns: nanoseconds(self.span.from), ..meta };
        let delivery = self.subscribed[subscription.0].1.deliver(&meta, &cdr);
        self.last_at_ns = self.last_at_ns.max(meta.at_ns);
        ReplayStep { at_ns: meta.at_ns, subscription, delivery, meta, bytes: cdr.len() }
    }
}

/// The latched samples of all subscriptions.
#[derive(Default)]
struct Kept {
    samples: LatchedTopics,
    /// Number of samples that are larger than their subscription takes.
    too_big: u64,
}

fn lock(kept: &Mutex<Kept>) -> MutexGuard<'_, Kept> {
    kept.lock().unwrap_or_else(PoisonError::into_inner)
}

struct Latched {
    number: usize,
    kept: Arc<Mutex<Kept>>,
    max_bytes: usize,
}

impl Sink for Latched {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        if cdr.len() > self.max_bytes {
            self.too_big(meta, cdr.len());
            return Delivery::TooBig;
        }
        let sample = LatchedSample::new(meta, cdr);
        lock(&self.kept).samples.keep(self.number, sample, None, i64::MAX);
        Delivery::Taken
    }

    fn too_big(&self, _: &SampleMeta, _: usize) {
        lock(&self.kept).too_big += 1;
    }
}

//! The receiving side: a participant, and a sink that stores the samples.

use std::sync::{Arc, Condvar, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use gleaner_dds::{Dds, DdsOptions, Distro};
use gleaner_messages::transport::{
    Delivery, Guid, Qos, ReceptionStatus, SampleMeta, Sink, Subscription, TopicSpec, Transport,
};
use gleaner_tests::peers::PATIENCE;
use gleaner_tests::peers::message::MessageType;
use libtest_mimic::Failed;

/// The largest message: an image of 1080p.
const LARGEST: usize = 7 << 20;

pub fn join(distro: Option<Distro>) -> Result<Dds, Failed> {
    let mut options = DdsOptions::new("/gleaner/tests");
    options.largest = LARGEST;
    options.distro = distro;
    Ok(Dds::open(options)?)
}

pub struct ReceivedSample {
    pub meta: SampleMeta,
    pub cdr: Vec<u8>,
}

#[derive(Default)]
struct SampleStore {
    samples: Mutex<Vec<ReceivedSample>>,
    arrived: Condvar,
}

impl Sink for SampleStore {
    fn deliver(&self, meta: &SampleMeta, cdr: &[u8]) -> Delivery {
        self.samples.lock().unwrap().push(ReceivedSample { meta: *meta, cdr: cdr.to_vec() });
        self.arrived.notify_all();
        Delivery::Taken
    }
}

/// A subscription with its samples.
pub struct TopicReceiver {
    pub subscription: Subscription,
    ty: MessageType,
    store: Arc<SampleStore>,
}

impl TopicReceiver {
    pub fn new(dds: &mut Dds, ty: MessageType, topic: &str, qos: Qos) -> Result<Self, Failed> {
        let store = Arc::new(SampleStore::default());
        let (topic, type_name) = (topic.to_owned(), ty.name());
        let spec = TopicSpec { topic, type_name, queue: 100, max_bytes: LARGEST, qos };
        Ok(Self { subscription: dds.subscribe(&spec, store.clone())?, ty, store })
    }

    /// Waits until `enough` holds for the received samples, and returns them.
    pub fn wait(
        &self,
        what: &str,
        mut enough: impl FnMut(&[ReceivedSample]) -> bool,
    ) -> Result<MutexGuard<'_, Vec<ReceivedSample>>, Failed> {
        let mut samples = self.store.samples.lock().unwrap();
        let deadline = Instant::now() + PATIENCE;
        while !enough(&samples) {
            if Instant::now() > deadline {
                return Err(
                    format!("waited for {what}; {} samples were received", samples.len()).into()
                );
            }
            // Checked again periodically: a loss is counted without a sample.
            samples =
                self.store.arrived.wait_timeout(samples, Duration::from_millis(100)).unwrap().0;
        }
        Ok(samples)
    }

    /// Number of samples received so far.
    pub fn count(&self) -> usize {
        self.store.samples.lock().unwrap().len()
    }

    /// Waits for messages 1 to `count` of one writer: each once, in order, every byte correct, none
    /// counted as lost.
    pub fn all(&self, dds: &Dds, count: u32) -> Result<(), Failed> {
        let samples = self.wait("all messages", |samples| samples.len() >= count as usize)?;
        if samples.len() > count as usize {
            return Err(format!("{} samples for {count} messages", samples.len()).into());
        }
        self.in_order(samples.iter(), 1)?;
        // Checks that the comparison finds a difference.
        if self.in_order(samples.iter().take(1), 2).is_ok() {
            return Err("message 1 passes for message 2".into());
        }
        drop(samples);
        let status = dds.status(self.subscription);
        let ReceptionStatus { lost, malformed, qos_warnings, .. } = &status;
        if *lost != Some(0) || *malformed != 0 || !qos_warnings.is_empty() {
            return Err(format!("all messages arrived, but the status is {status:?}").into());
        }
        Ok(())
    }

    /// Checks that `samples` are consecutive messages of one writer, beginning with `first`.
    pub fn in_order<'s>(
        &self,
        samples: impl IntoIterator<Item = &'s ReceivedSample>,
        first: u32,
    ) -> Result<(), Failed> {
        let mut before: Option<(Guid, u64)> = None;
        for (n, ReceivedSample { meta, cdr }) in (first..).zip(samples) {
            if let Some(how) = self.ty.message(n).differs(cdr, meta.endian) {
                return Err(format!("message {n}: {how}").into());
            }
            if before.is_some_and(|(writer, seq)| writer != meta.writer || seq + 1 != meta.seq) {
                return Err(format!("message {n} is not the next of {before:?}: {meta:?}").into());
            }
            before = Some((meta.writer, meta.seq));
        }
        Ok(())
    }
}

/// The number of a message, from its stamp.
pub fn number(sample: &ReceivedSample) -> u32 {
    let sec = sample.cdr.first_chunk().map_or(0, |sec| i32::from_le_bytes(*sec));
    u32::try_from(sec - 1000).unwrap_or(0)
}

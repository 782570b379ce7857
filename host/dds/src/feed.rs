//! One subscription: its reader, what it asks for, and the way of its samples to the sink.

use std::any::Any;
use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

use mio::{Interest, Registry, Token};
use rustdds::dds::ReadError;
use rustdds::{DomainParticipant, GUID, RTPSEntity, Timestamp, TopicKind};
use tracing::{info, warn};

use super::names::{dds_topic, dds_type, ros_type, visible};
use super::offers::{Offer, Request, in_words};
use super::raw::{CopyInto, CopyOrSay, Held, PassOver, Raw, RawReader};
use super::state::{Once, State, Told, lock, panic_text};
use super::types::Types;
use gleaner_transport::{Clock, Gaps, Guid, Qos, SampleMeta, Sink, TopicSpec};

/// What RustDDS may keep of a topic: it frees a sample when newer ones have taken its place, not
/// when it was taken.
const KEPT_BYTES: usize = 64 << 20;
const KEPT: std::ops::RangeInclusive<usize> = 4..=1024;
/// However long a queue is asked for.
const MOST_KEPT_BYTES: usize = 1 << 30;
const MOST_KEPT: usize = 65_536;
/// Sentences of qos_warnings: those of now, and those of times when it was asked again.
const TROUBLE: usize = 12;
const REMEMBERED: usize = 4;

/// The first token of a reader.
const FIRST: usize = 16;

/// One subscription.
pub(super) struct Feed {
    index: usize,
    spec: TopicSpec,
    topic: String,
    type_name: String,
    /// `None` after it panicked.
    sink: Option<Arc<dyn Sink>>,
    told: Arc<Told>,
    reader: Option<RawReader>,
    request: Option<Request>,
    /// No writer offered this topic at the last look.
    alone: bool,
    /// What an earlier reader had read: the samples that RustDDS keeps of a topic are there for a
    /// new reader, too.
    read_before: Gaps,
    gaps: Gaps,
    types: Types,
    asked_again: Vec<String>,
    once: Once,
    /// Samples may wait.
    pub(super) ready: bool,
}

/// What all feeds need.
pub(super) struct Around<'a> {
    pub(super) participant: &'a DomainParticipant,
    pub(super) registry: &'a Registry,
    pub(super) state: &'a State,
    pub(super) memory: &'a RefCell<Vec<u8>>,
    pub(super) clock: Clock,
}

/// By which the poll names the reader of a subscription; those before are the receive thread's own.
pub(super) fn token(index: usize) -> Token {
    Token(FIRST + index)
}

/// The subscription whose reader has `token`.
pub(super) fn index(token: Token) -> Option<usize> {
    token.0.checked_sub(FIRST)
}

/// How many samples RustDDS keeps of a topic.
fn kept(spec: &TopicSpec) -> usize {
    let bytes = spec.max_bytes.max(1);
    let (least, most) = KEPT.into_inner();
    let asked = match spec.qos {
        Qos::Fixed { depth, .. } => spec.queue.max(depth),
        Qos::Auto => spec.queue,
    };
    let most_kept = (MOST_KEPT_BYTES / bytes).clamp(least, MOST_KEPT);
    asked.min(most_kept).max((KEPT_BYTES / bytes).clamp(least, most))
}

impl Feed {
    /// `None` if a name is none in ROS 2.
    pub(super) fn new(
        index: usize,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
        told: Arc<Told>,
    ) -> Option<Self> {
        Some(Self {
            index,
            topic: dds_topic(&spec.topic)?,
            type_name: dds_type(&spec.type_name)?,
            spec: spec.clone(),
            sink: Some(sink),
            told,
            reader: None,
            request: None,
            alone: true,
            read_before: Gaps::default(),
            gaps: Gaps::default(),
            types: Types::default(),
            asked_again: Vec::new(),
            once: Once::default(),
            ready: false,
        })
    }

    /// Bytes of the largest sample that is expected.
    pub(super) fn largest(&self) -> usize {
        self.spec.max_bytes
    }

    pub(super) fn guid(&self) -> Option<GUID> {
        self.reader.as_ref().map(RTPSEntity::guid)
    }

    /// Hands over what has come, at most `most` samples.
    pub(super) fn take(&mut self, around: &Around<'_>, most: usize) {
        self.ready = false;
        // Taken out, so that the reader can be used while the counts change.
        let Some(reader) = self.reader.take() else { return };
        // Before the samples are looked at: one that comes after the last look has to notify again.
        reader.drain_read_notifications();
        for taken in 0.. {
            if taken == most {
                self.ready = true;
                break;
            }
            around.state.deliver(self.index);
            let sink = self.sink.as_deref();
            let change = reader.try_take_one_with(CopyOrSay(CopyInto {
                sink,
                memory: around.memory,
                clock: around.clock,
            }));
            around.state.deliver(self.index);
            match change {
                Ok(None) => break,
                Ok(Some(change)) => {
                    let writer = Guid(change.writer_guid.to_bytes());
                    let seq = u64::try_from(i64::from(change.sequence_number)).unwrap_or(0).max(1);
                    let other =
                        self.types.is_backing_off(around.participant, writer, &self.type_name);
                    if !other && !self.read_before.has(writer, seq) {
                        let publish_ns =
                            change.source_timestamp().map_or(change.sample.at_ns, nanoseconds);
                        self.deliver(around, writer, seq, publish_ns, change.sample);
                    }
                }
                Err(ReadError::Deserialization { reason }) => self.note_malformed(&reason),
                Err(error) => {
                    around.state.die(format!(
                        "topic `{}` cannot be read: {}",
                        self.spec.topic,
                        visible(&error.to_string())
                    ));
                    break;
                }
            }
        }
        self.told.lost.store(self.gaps.lost(), Relaxed);
        self.reader = Some(reader);
    }

    fn deliver(&mut self, around: &Around<'_>, writer: Guid, seq: u64, publish_ns: i64, raw: Raw) {
        let missing = self.gaps.note(writer, seq);
        if missing > 0 && self.once.first("lost", "") {
            warn!(topic = %self.spec.topic, %writer, missing, "samples were lost on their way; said once, counted further");
        }
        if let Held::Unreadable(why) = &raw.held {
            return self.note_malformed(why);
        }
        let Some(sink) = &self.sink else { return };
        let meta = SampleMeta {
            at_ns: raw.at_ns,
            publish_ns,
            writer,
            seq,
            endian: raw.endian,
            options: [0; 2],
        };
        around.state.deliver(self.index);
        let delivered = match raw.held {
            Held::Sink => catch_unwind(AssertUnwindSafe(|| sink.accept(&meta))),
            Held::Memory => catch_unwind(AssertUnwindSafe(|| {
                sink.deliver(&meta, &around.memory.borrow());
            })),
            Held::Nobody(text) | Held::Unreadable(text) => {
                Err(Box::new(text) as Box<dyn Any + Send>)
            }
        };
        around.state.deliver(self.index);
        around.state.handled.fetch_add(1, Relaxed);
        if let Err(panic) = delivered {
            let text = panic_text(&*panic);
            around.state.die(format!("the sink of topic `{}` panicked: {text}", self.spec.topic));
            self.sink = None;
        }
    }

    fn note_malformed(&mut self, reason: &str) {
        self.told.malformed.fetch_add(1, Relaxed);
        if self.once.first("malformed", "") {
            warn!(topic = %self.spec.topic, reason = visible(reason), "malformed sample");
        }
    }

    /// Looks at what is offered, and asks for what all offer.
    pub(super) fn look(&mut self, around: &Around<'_>, offers: &[Offer]) {
        let here: Vec<&Offer> = offers.iter().filter(|offer| offer.topic == self.topic).collect();
        let (ours, others): (Vec<&Offer>, Vec<&Offer>) =
            here.into_iter().partition(|offer| offer.type_name == self.type_name);
        let wanted = match self.spec.qos {
            Qos::Fixed { reliable, transient_local, .. } => {
                Some(Request { reliable, transient_local })
            }
            Qos::Auto if ours.is_empty() => None,
            Qos::Auto => Some(Request::of_all(ours.iter().copied())),
        };
        if let Some(wanted) = wanted {
            match self.request {
                None => self.ask(around, wanted),
                // Asking for more would lose samples for no need, unless there is nobody to lose
                // them from.
                Some(now) if now != wanted && (self.alone || !now.within(wanted)) => {
                    let unheard = ours.iter().find(|offer| !now.within(Request::of_all([**offer])));
                    self.ask_again(around, now, wanted, unheard.copied());
                }
                Some(_) => {}
            }
        }
        self.alone = ours.is_empty();
        self.types.note(&ours, &others);
        let qos_warnings = self.qos_warnings(&ours, &others);
        for (cause, sentence) in &qos_warnings {
            if self.once.first(cause, sentence) {
                warn!(topic = %self.spec.topic, "{sentence}");
            }
        }
        let mut words = lock(&self.told.words);
        words.reader = self.guid();
        words.qos =
            self.request.filter(|_| self.reader.is_some()).map(|request| request.to_string());
        words.qos_warnings = qos_warnings.into_iter().map(|(_, sentence)| sentence).collect();
        words.qos_warnings.extend_from_slice(&self.asked_again);
        words.qos_warnings.extend(self.types.qos_warnings(&self.spec.topic));
    }

    /// Why writers are not heard, or not as they could be: causes, and sentences.
    fn qos_warnings(&self, ours: &[&Offer], others: &[&Offer]) -> Vec<(&'static str, String)> {
        let topic = &self.spec.topic;
        let of_another_type = others.iter().map(|offer| {
            let (found, wanted) = (visible(&ros_type(&offer.type_name)), ros_type(&self.type_name));
            (
                "another type",
                format!("writer {} of `{topic}` sends `{found}`, not `{wanted}`", offer.guid),
            )
        });
        let mut qos_warnings: Vec<_> = of_another_type.take(TROUBLE / 2).collect();
        let Some(request) = self.request else { return qos_warnings };
        let policies = request.policies(1);
        for offer in ours {
            if let Some(policy) = offer.qos.compliance_failure_wrt(&policies) {
                let offered = in_words(&offer.qos);
                let sentence = format!(
                    "writer {} of `{topic}` offers {offered}, asked for is {request}: {policy:?} does not fit",
                    offer.guid
                );
                qos_warnings.push(("offers less", sentence));
            }
        }
        let most = Request::of_all(ours.first().copied());
        if let Some(other) = ours.iter().find(|offer| Request::of_all([**offer]) != most)
            && self.spec.qos == Qos::Auto
        {
            let (a, b) = (in_words(&ours[0].qos), in_words(&other.qos));
            let (first, second) = (ours[0].guid, other.guid);
            let sentence = format!(
                "writers of `{topic}` differ, {first} offers {a} and {second} {b}: all are asked for {request}"
            );
            qos_warnings.push(("differ", sentence));
        }
        qos_warnings.truncate(TROUBLE);
        qos_warnings
    }

    fn ask_again(
        &mut self,
        around: &Around<'_>,
        now: Request,
        wanted: Request,
        because: Option<&Offer>,
    ) {
        if let Some(offer) = because {
            let (topic, writer, offered) = (&self.spec.topic, offer.guid, in_words(&offer.qos));
            warn!(%topic, %writer, offered, asked = %now, asking = %wanted, "a writer offers less: asking again");
            let sentence = format!(
                "`{topic}` was asked for again, {wanted} instead of {now}, because of writer {writer}: {offered}"
            );
            if self.asked_again.len() == REMEMBERED {
                self.asked_again.remove(0);
            }
            self.asked_again.push(sentence);
        }
        self.ask(around, wanted);
    }

    /// Makes a reader, and then gives up the one that there was.
    fn ask(&mut self, around: &Around<'_>, request: Request) {
        let mut reader = match self.reader_of(around, request) {
            Ok(reader) => reader,
            // Tried again at the next look.
            Err(error) => {
                if self.once.first("reader", "") {
                    warn!(topic = %self.spec.topic, error, "no reader; trying again");
                }
                return;
            }
        };
        if let Err(error) =
            around.registry.register(&mut reader, token(self.index), Interest::READABLE)
        {
            around.state.die(format!("topic `{}` cannot be waited for: {error}", self.spec.topic));
            return;
        }
        if self.reader.is_some() {
            self.take(around, MOST_KEPT);
            self.read_before = self.gaps.clone();
            self.give_up(around);
        } else if !request.transient_local {
            // What is kept of the topic from an earlier subscription is none of this one's
            // business.
            let mut kept = (0..MOST_KEPT).map(|_| reader.try_take_one_with(PassOver));
            kept.find(|passed| {
                !matches!(passed, Ok(Some(_)) | Err(ReadError::Deserialization { .. }))
            });
        }
        info!(topic = %self.spec.topic, qos = %request, kept = kept(&self.spec), "subscribed");
        self.reader = Some(reader);
        self.request = Some(request);
        self.ready = true;
    }

    fn reader_of(&self, around: &Around<'_>, request: Request) -> Result<RawReader, String> {
        let policies = request.policies(kept(&self.spec));
        let made = (|| {
            // The topic first, with its limits: they only ever grow.
            let participant = around.participant;
            let (name, type_name) = (self.topic.clone(), self.type_name.clone());
            let topic = participant.create_topic(name, type_name, &policies, TopicKind::NoKey)?;
            let subscriber = participant.create_subscriber(&policies)?;
            subscriber.create_simple_datareader_no_key(&topic, Some(policies.clone()))
        })();
        let reader: RawReader =
            made.map_err(|error: rustdds::dds::CreateError| visible(&error.to_string()))?;
        around.state.peers().follow(reader.guid());
        Ok(reader)
    }

    fn give_up(&mut self, around: &Around<'_>) {
        if let Some(mut reader) = self.reader.take() {
            // It is gone at once; what the poll thinks of it does not matter any more.
            drop(around.registry.deregister(&mut reader));
            around.state.peers().forget(reader.guid());
        }
    }
}

/// Nanoseconds since 1970. RTPS counts 2⁻³² of seconds.
fn nanoseconds(stamp: Timestamp) -> i64 {
    let ticks = stamp.to_ticks();
    let (seconds, fraction) = (ticks >> 32, ticks & 0xffff_ffff);
    // Less than 2³² seconds: it fits.
    i64::try_from(seconds * 1_000_000_000 + ((fraction * 1_000_000_000) >> 32)).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn spec(queue: usize, max_bytes: usize) -> TopicSpec {
        let (topic, type_name) = ("/t".to_owned(), "a/msg/T".to_owned());
        TopicSpec { topic, type_name, queue, max_bytes, qos: Qos::Auto }
    }

    #[test]
    fn small_samples_have_long_queues_and_large_ones_short_ones() {
        assert_eq!(kept(&spec(1, 324)), 1024);
        assert_eq!(kept(&spec(1, 1 << 20)), 64);
        assert_eq!(kept(&spec(1, 25 << 20)), 4);
        assert_eq!(kept(&spec(10, 25 << 20)), 10);
        assert_eq!(kept(&spec(1, 0)), 1024);
    }

    #[test]
    fn no_queue_takes_more_than_a_gibibyte() {
        assert_eq!(kept(&spec(usize::MAX, 25 << 20)), 40);
        assert_eq!(kept(&spec(usize::MAX, 1)), MOST_KEPT);
        assert_eq!(kept(&spec(usize::MAX, usize::MAX)), 4);
    }

    #[test]
    fn source_stamps_become_nanoseconds_without_overflow() {
        assert_eq!(nanoseconds(Timestamp::from_ticks(1 << 32 | 1 << 31)), 1_500_000_000);
        assert_eq!(nanoseconds(Timestamp::from_ticks(u64::MAX)), 4_294_967_295_999_999_999);
    }
}

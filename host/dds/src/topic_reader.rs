//! A subscription: its reader, its requested QoS, and the delivery of its samples to the sink.

use std::any::Any;
use std::cell::RefCell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;

use mio::{Interest, Registry, Token};
use rustdds::dds::ReadError;
use rustdds::{DomainParticipant, GUID, RTPSEntity, Timestamp, TopicKind};
use tracing::{info, warn};

use super::before_match::BeforeMatch;
use super::names::{dds_topic, dds_type, visible};
use super::qos::{Offer, Request, describe};
use super::raw::{CopiedTo, CopyInto, CopyOrReport, Raw, RawReader};
use super::state::{OnceLog, ParticipantState, SubscriptionStatus, UNKNOWN, lock, panic_text};
use super::type_check::{LeftOut, TypeCheck};
use gleaner_messages::transport::{Clock, Gaps, Guid, Qos, SampleMeta, Sink, TopicSpec};

/// Memory and number of samples that RustDDS may keep for a topic: it frees a sample when newer
/// ones have taken its place, not when it is taken.
const KEPT_BYTES: usize = 64 << 20;
const KEPT: std::ops::RangeInclusive<usize> = 4..=1024;
/// Hard caps on the queue, whatever the subscription requests.
const MAX_KEPT_BYTES: usize = 1 << 30;
const MAX_KEPT: usize = 65_536;
/// Most warnings about writers in the status, and most past re-subscriptions besides.
const MAX_WARNINGS: usize = 10;
const MAX_RESUBSCRIBED: usize = 4;

/// The token of the first reader.
const FIRST: usize = 16;

/// One subscription.
pub(super) struct TopicReader {
    index: usize,
    spec: TopicSpec,
    topic: String,
    type_name: String,
    /// `None` after it panicked.
    sink: Option<Arc<dyn Sink>>,
    status: Arc<SubscriptionStatus>,
    reader: Option<RawReader>,
    request: Option<Request>,
    /// True if the topic had no writer of the type at the last update.
    without_writers: bool,
    /// The sequence numbers that an earlier reader has read: a new reader gets the samples that
    /// RustDDS keeps for the topic again.
    read_before: Gaps,
    gaps: Gaps,
    /// Samples that RustDDS received earlier were for an earlier subscription, and are skipped.
    not_before: Timestamp,
    /// `None` until the first update.
    before_match: Option<BeforeMatch>,
    type_check: TypeCheck,
    resubscribed: Vec<String>,
    once: OnceLog,
    /// True if samples may be waiting.
    pub(super) ready: bool,
}

/// The parts of the receive thread that all readers need.
pub(super) struct ReceiveContext<'a> {
    pub(super) participant: &'a DomainParticipant,
    pub(super) registry: &'a Registry,
    pub(super) state: &'a ParticipantState,
    pub(super) memory: &'a RefCell<Vec<u8>>,
    pub(super) clock: Clock,
}

/// The mio token of a subscription's reader; lower tokens are the receive thread's own.
pub(super) fn token(index: usize) -> Token {
    Token(FIRST + index)
}

/// The subscription whose reader has `token`.
pub(super) fn index(token: Token) -> Option<usize> {
    token.0.checked_sub(FIRST)
}

/// Times the memory of the samples that RustDDS keeps, with that of incomplete ones: those that
/// their writer no longer has stay for 10 s.
const WITH_INCOMPLETE: usize = 3;
const DATAGRAM_BYTES: usize = 64 << 10;

/// Number of samples that RustDDS keeps for a topic.
pub(super) fn kept(spec: &TopicSpec) -> usize {
    let bytes = spec.max_bytes.max(1);
    let (least, most) = KEPT.into_inner();
    let asked = match spec.qos {
        Qos::Fixed { depth, .. } => spec.queue.max(depth),
        Qos::Auto => spec.queue,
    };
    let most_kept = (MAX_KEPT_BYTES / bytes).clamp(least, MAX_KEPT);
    asked.min(most_kept).max((KEPT_BYTES / bytes).clamp(least, most))
}

impl TopicReader {
    /// Returns `None` if a name is not valid in ROS 2.
    pub(super) fn new(
        index: usize,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
        status: Arc<SubscriptionStatus>,
    ) -> Option<Self> {
        Some(Self {
            index,
            topic: dds_topic(&spec.topic)?,
            type_name: dds_type(&spec.type_name)?,
            spec: spec.clone(),
            sink: Some(sink),
            status,
            reader: None,
            request: None,
            without_writers: true,
            read_before: Gaps::default(),
            gaps: Gaps::default(),
            not_before: Timestamp::ZERO,
            before_match: None,
            type_check: TypeCheck::default(),
            resubscribed: Vec::new(),
            once: OnceLog::default(),
            ready: false,
        })
    }

    pub(super) fn index(&self) -> usize {
        self.index
    }

    /// Bytes of the largest sample that is expected.
    pub(super) fn largest(&self) -> usize {
        self.spec.max_bytes
    }

    /// Bytes of memory that its samples take besides that of received datagrams, in which small
    /// samples stay.
    pub(super) fn memory_needed(&self) -> usize {
        let bytes = self.spec.max_bytes;
        let samples = if bytes > DATAGRAM_BYTES { WITH_INCOMPLETE * kept(&self.spec) } else { 0 };
        bytes.saturating_mul(samples)
    }

    pub(super) fn guid(&self) -> Option<GUID> {
        self.reader.as_ref().map(RTPSEntity::guid)
    }

    /// Delivers waiting samples, at most `most`.
    pub(super) fn take(&mut self, context: &ReceiveContext<'_>, most: usize) {
        self.ready = false;
        // Taken out, so that the reader can be used while the counts change.
        let Some(reader) = self.reader.take() else { return };
        // Before the samples are read, so that a sample that arrives after the last read notifies
        // again.
        reader.drain_read_notifications();
        for taken in 0.. {
            if taken == most {
                self.ready = true;
                break;
            }
            // Checked before each sample: no sample follows the return of `unsubscribe`, except one
            // whose delivery is in progress.
            if self.status.ended.load(Relaxed) {
                break;
            }
            context.state.deliver(self.index);
            let sink = self.sink.as_deref();
            let change = reader.try_take_one_with(CopyOrReport(CopyInto {
                sink,
                memory: context.memory,
                clock: context.clock,
            }));
            context.state.deliver(self.index);
            match change {
                Ok(None) => break,
                Ok(Some(change)) => {
                    let writer = Guid(change.writer_guid.to_bytes());
                    let seq = u64::try_from(i64::from(change.sequence_number)).unwrap_or(0).max(1);
                    let layout = self.type_check.layout_of(
                        context.participant,
                        writer,
                        &self.type_name,
                        &self.status.layout,
                    );
                    let is_new = change.receive_instant >= self.not_before
                        && !self.read_before.has(writer, seq);
                    if let Some(layout) = layout.filter(|_| is_new) {
                        let publish_ns =
                            change.source_timestamp().map_or(change.sample.at_ns, nanoseconds);
                        self.deliver(context, (writer, seq, layout), publish_ns, change.sample);
                    }
                }
                Err(ReadError::Deserialization { reason }) => self.note_malformed(&reason),
                Err(error) => {
                    context.state.die(format!(
                        "topic `{}` cannot be read: {}",
                        self.spec.topic,
                        visible(&error.to_string())
                    ));
                    break;
                }
            }
        }
        self.status.lost.store(self.gaps.lost(), Relaxed);
        let before = self.before_match.as_ref().and_then(BeforeMatch::count);
        self.status.before_match.store(before.unwrap_or(UNKNOWN), Relaxed);
        self.reader = Some(reader);
    }

    fn deliver(
        &mut self,
        context: &ReceiveContext<'_>,
        (writer, seq, layout): (Guid, u64, u16),
        publish_ns: i64,
        raw: Raw,
    ) {
        let missing = self.gaps.note(writer, seq);
        if missing > 0 && self.once.first("lost", "") {
            warn!(
                topic = %self.spec.topic,
                %writer,
                missing,
                "samples lost in transit (logged once, still counted)"
            );
        }
        let meta = SampleMeta {
            publish_ns,
            endian: raw.endian,
            layout,
            ..SampleMeta::new(raw.at_ns, writer, seq)
        };
        if let Some(before) = &mut self.before_match {
            before.note(&meta);
        }
        if let CopiedTo::Unreadable(why) = &raw.copied_to {
            return self.note_malformed(why);
        }
        let Some(sink) = &self.sink else { return };
        context.state.deliver(self.index);
        let delivered = match raw.copied_to {
            CopiedTo::Sink => catch_unwind(AssertUnwindSafe(|| sink.accept(&meta))),
            CopiedTo::SharedMemory => catch_unwind(AssertUnwindSafe(|| {
                sink.deliver(&meta, &context.memory.borrow());
            })),
            CopiedTo::SinkPanicked(text) | CopiedTo::Unreadable(text) => {
                Err(Box::new(text) as Box<dyn Any + Send>)
            }
        };
        context.state.deliver(self.index);
        context.state.handled.fetch_add(1, Relaxed);
        if let Err(panic) = delivered {
            let text = panic_text(&*panic);
            context.state.die(format!("the sink of topic `{}` panicked: {text}", self.spec.topic));
            self.sink = None;
        }
    }

    fn note_malformed(&mut self, reason: &str) {
        self.status.malformed.fetch_add(1, Relaxed);
        if self.once.first("malformed", "") {
            warn!(topic = %self.spec.topic, reason = visible(reason), "malformed sample");
        }
    }

    /// Requests the QoS that all current writers offer, and updates the status.
    pub(super) fn update(&mut self, context: &ReceiveContext<'_>, offers: &[Offer]) {
        let here: Vec<&Offer> = offers.iter().filter(|offer| offer.topic == self.topic).collect();
        let (same, others) = self.type_check.note(&here, &self.type_name, &self.status.layout);
        let wanted = match self.spec.qos {
            Qos::Fixed { reliable, transient_local, .. } => {
                Some(Request { reliable, transient_local })
            }
            Qos::Auto if same.is_empty() => None,
            Qos::Auto => Some(Request::of_all(same.iter().copied())),
        };
        if let Some(wanted) = wanted {
            match self.request {
                None => self.subscribe(context, wanted),
                // A stronger request would lose samples needlessly, unless there are no writers.
                Some(now) if now != wanted && (self.without_writers || !now.within(wanted)) => {
                    let weaker = same.iter().find(|offer| !now.within(Request::of_all([**offer])));
                    self.resubscribe(context, now, wanted, weaker.copied());
                }
                Some(_) => {}
            }
        }
        self.without_writers = same.is_empty();
        let clock = context.clock;
        let before = self.before_match.get_or_insert_with(|| BeforeMatch::new(clock.now()));
        before.make_room(|writer| same.iter().any(|offer| offer.guid == *writer));
        let qos_warnings = self.qos_warnings(&same, &others);
        for (cause, sentence) in &qos_warnings {
            if self.once.first(cause, sentence) {
                warn!(topic = %self.spec.topic, "{sentence}");
            }
        }
        let mut text = lock(&self.status.text);
        text.reader = self.guid();
        text.qos =
            self.request.filter(|_| self.reader.is_some()).map(|request| request.to_string());
        text.qos_warnings = qos_warnings.into_iter().map(|(_, sentence)| sentence).collect();
        text.qos_warnings.extend_from_slice(&self.resubscribed);
        text.qos_warnings.extend(self.type_check.warnings(&self.spec.topic));
        text.left_out = others.iter().map(|(offer, _)| offer.guid).collect();
    }

    /// Warnings about writers whose samples are not received, or not with the QoS they offer:
    /// cause, and sentence.
    fn qos_warnings(
        &self,
        same: &[&Offer],
        others: &[(&Offer, LeftOut)],
    ) -> Vec<(&'static str, String)> {
        let topic = &self.spec.topic;
        let left_out = others
            .iter()
            .map(|(offer, why)| why.warning(offer, (topic, &self.type_name), &self.status.layout));
        let mut qos_warnings: Vec<_> = left_out.take(MAX_WARNINGS / 2).collect();
        let Some(request) = self.request else { return qos_warnings };
        for offer in same {
            if let Some(shortfall) = offer.shortfall(request) {
                let sentence = format!("writer {} of `{topic}` offers {shortfall}", offer.guid);
                qos_warnings.push(("offers less", sentence));
            }
        }
        let most = Request::of_all(same.first().copied());
        if let Some(other) = same.iter().find(|offer| Request::of_all([**offer]) != most)
            && self.spec.qos == Qos::Auto
        {
            let (a, b) = (describe(&same[0].qos), describe(&other.qos));
            let (first, second) = (same[0].guid, other.guid);
            let sentence = format!(
                "writers of `{topic}` differ: {first} offers {a}, {second} offers {b}; \
                 {request} is requested of all"
            );
            qos_warnings.push(("differ", sentence));
        }
        qos_warnings.truncate(MAX_WARNINGS);
        qos_warnings
    }

    fn resubscribe(
        &mut self,
        context: &ReceiveContext<'_>,
        now: Request,
        wanted: Request,
        because: Option<&Offer>,
    ) {
        if let Some(offer) = because {
            let (topic, writer, offered) = (&self.spec.topic, offer.guid, describe(&offer.qos));
            warn!(
                %topic,
                %writer,
                offered,
                before = %now,
                now = %wanted,
                "re-subscribing with weaker QoS for a new writer"
            );
            let sentence = format!(
                "`{topic}` was re-subscribed with {wanted} instead of {now}: \
                 writer {writer} offers {offered}"
            );
            if self.resubscribed.len() == MAX_RESUBSCRIBED {
                self.resubscribed.remove(0);
            }
            self.resubscribed.push(sentence);
        }
        self.subscribe(context, wanted);
    }

    /// Creates a reader, then removes the old one.
    fn subscribe(&mut self, context: &ReceiveContext<'_>, request: Request) {
        let before = Timestamp::now();
        let mut reader = match self.create_reader(context, request) {
            Ok(reader) => reader,
            // Retried at the next update.
            Err(error) => {
                if self.once.first("reader", "") {
                    warn!(topic = %self.spec.topic, error, "cannot create a reader; retrying");
                }
                return;
            }
        };
        if let Err(error) =
            context.registry.register(&mut reader, token(self.index), Interest::READABLE)
        {
            context.state.die(format!("topic `{}` cannot be polled: {error}", self.spec.topic));
            return;
        }
        if self.reader.is_some() {
            self.take(context, MAX_KEPT);
            self.read_before = self.gaps.clone();
            self.remove_reader(context.registry, context.state);
        } else if !request.transient_local {
            // By their time: taking here all that waits would also take the first samples of a
            // writer that RustDDS has matched in the meantime.
            self.not_before = before;
        }
        info!(topic = %self.spec.topic, qos = %request, kept = kept(&self.spec), "subscribed");
        self.reader = Some(reader);
        self.request = Some(request);
        self.ready = true;
    }

    fn create_reader(
        &self,
        context: &ReceiveContext<'_>,
        request: Request,
    ) -> Result<RawReader, String> {
        let policies = request.policies(kept(&self.spec));
        let made = (|| {
            // The topic first, with its limits: RustDDS only ever raises them.
            let participant = context.participant;
            let (name, type_name) = (self.topic.clone(), self.type_name.clone());
            let topic = participant.create_topic(name, type_name, &policies, TopicKind::NoKey)?;
            let subscriber = participant.create_subscriber(&policies)?;
            subscriber.create_simple_datareader_no_key(&topic, Some(policies.clone()))
        })();
        let reader: RawReader =
            made.map_err(|error: rustdds::dds::CreateError| visible(&error.to_string()))?;
        context.state.peers().follow(reader.guid());
        Ok(reader)
    }

    pub(super) fn remove_reader(&mut self, registry: &Registry, state: &ParticipantState) {
        if let Some(mut reader) = self.reader.take() {
            // The reader is dropped anyway; an error of the poll does not matter.
            drop(registry.deregister(&mut reader));
            state.peers().forget(reader.guid());
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
        // A lambda that asks for more of them needs no other reader.
        assert_eq!(kept(&spec(256, 4096)), kept(&spec(512, 4096)));
    }

    #[test]
    fn no_queue_takes_more_than_a_gibibyte() {
        assert_eq!(kept(&spec(usize::MAX, 25 << 20)), 40);
        assert_eq!(kept(&spec(usize::MAX, 1)), MAX_KEPT);
        assert_eq!(kept(&spec(usize::MAX, usize::MAX)), 4);
    }

    #[test]
    fn source_stamps_become_nanoseconds_without_overflow() {
        assert_eq!(nanoseconds(Timestamp::from_ticks(1 << 32 | 1 << 31)), 1_500_000_000);
        assert_eq!(nanoseconds(Timestamp::from_ticks(u64::MAX)), 4_294_967_295_999_999_999);
    }
}

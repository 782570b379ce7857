//! The recorded topics: what the ingress has granted, their descriptions, and their samples in the
//! order of their stamps.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::mpsc::Sender;
use std::time::{Duration, Instant};

use gleaner_base::visible;
use gleaner_messages::transport::{SampleMeta, same_type};
use gleaner_messages::type_description::type_hash;
use gleaner_protocol::ReceptionGaps;
use gleaner_protocol::ingress::{COMMANDS_ID, ReceptionStatus, RefusedTopic, SourceStatus};
use gleaner_protocol::link::RecordedTopic;
use gleaner_samples::{FeedError, FeedEvent, ReconnectingReader, SharedTopicReader};
use tracing::{error, warn};

use super::background::DefinitionsRequest;
use super::samples::SampleReader;
use crate::{RecordError, Recorder, TopicId, TopicSchema};

/// Time that a topic may wait for its definitions; the ingress asks the nodes that write it.
const DEFINITIONS_TIMEOUT: Duration = Duration::from_secs(6);
/// Maximum number of bytes that are taken before the loop checks for triggers again.
const BYTES_TURN: usize = 256 << 10;

/// The state of a topic's description.
enum Description {
    /// It is searched in the folders of this machine.
    Searched,
    /// The definitions of this machine are found. The first sample decides if they fit.
    Found,
    /// It is not there: the ingress is asked once the topic has a sample, and so a writer.
    Unknown,
    /// The ingress was asked.
    Asked(Instant),
    /// It is known, or given up.
    Known(Option<Arc<str>>),
    /// The recorder has it, or refuses it.
    Settled,
}

enum Supply {
    /// Not attached yet.
    Awaited,
    Fed(Box<FedRecording>),
}

struct FedRecording {
    samples: SampleReader,
    description: Description,
    /// The time when it was attached.
    since_ns: i64,
    /// True once lost samples were logged.
    is_warned: bool,
    /// Definitions on this machine, until the layout of the first sample is known.
    local: Option<Arc<str>>,
    /// Time at which the ingress was asked for the layout.
    layout_asked: Option<Instant>,
    /// Layout of the definitions that the recorder has.
    described: Option<String>,
}

struct GrantedTopic {
    id: u32,
    name: String,
    topic: TopicId,
    supply: Supply,
    /// The reason why no further samples can be received, if any.
    refused: Option<String>,
}

pub struct Topics {
    feed: ReconnectingReader,
    /// To the thread that searches definitions.
    searches: Sender<DefinitionsRequest>,
    topics: Vec<GrantedTopic>,
    /// Events of topics that no lambda has announced yet, in their order.
    early: BTreeMap<u32, Vec<Result<SharedTopicReader, RefusedTopic>>>,
}

impl Topics {
    pub fn new(feed: ReconnectingReader, searches: Sender<DefinitionsRequest>) -> Topics {
        Topics { feed, searches, topics: Vec::new(), early: BTreeMap::new() }
    }

    pub fn status(&self) -> &SourceStatus {
        self.feed.status()
    }

    /// The times without an ingress.
    pub fn gaps(&self) -> ReceptionGaps {
        self.feed.gaps()
    }

    /// Returns false while the ingress has ended, and no other one was joined.
    pub fn has_ingress(&self) -> bool {
        self.feed.has_ingress()
    }

    /// Adds a topic that an announced lambda records.
    pub fn add(&mut self, id: u32, name: &str, topic: TopicId, now_ns: i64) {
        if self.topics.iter().any(|known| known.topic == topic) {
            return;
        }
        let name = name.to_owned();
        self.topics.push(GrantedTopic { id, name, topic, supply: Supply::Awaited, refused: None });
        for event in self.early.remove(&id).unwrap_or_default() {
            match event {
                Ok(fed) => self.attach(fed, now_ns),
                Err(reason) => self.refuse(id, reason),
            }
        }
    }

    /// Handles messages of the ingress; returns the topic of commands once it is attached.
    pub fn poll(&mut self, now_ns: i64) -> Result<Option<SharedTopicReader>, FeedError> {
        let mut commands = None;
        for event in self.feed.poll()? {
            match event {
                FeedEvent::Attached(fed) if fed.info.id == COMMANDS_ID => commands = Some(fed),
                FeedEvent::Attached(fed) => self.attach(fed, now_ns),
                FeedEvent::Refused { id, reason } => self.refuse(id, reason),
                FeedEvent::Definitions { id, text } => {
                    if let Some(fed) = self.fed(id)
                        && matches!(fed.description, Description::Asked(_))
                    {
                        fed.description = Description::Known(text.map(Arc::from));
                    }
                }
                FeedEvent::Layout { id, type_hash } => {
                    if let Some(fed) = self.fed(id)
                        && fed.layout_asked.take().is_some()
                    {
                        fed.samples.set_layout(type_hash);
                    }
                }
            }
        }
        Ok(commands)
    }

    /// Takes the result of a search on this machine.
    pub fn found_locally(&mut self, id: u32, text: Option<Arc<str>>) {
        if let Some(fed) = self.fed(id) {
            fed.local = text;
            fed.description = Description::Found;
        }
    }

    /// Passes samples to the recorder in the order of their stamps: those that are stamped
    /// `until_ns` or earlier, at most `most`. Returns whether there may be more.
    ///
    /// `until_ns` is a time before this call. A sample that the ingress publishes during the call
    /// is stamped later, so it is not taken before an earlier one of another topic.
    pub fn take(
        &mut self,
        until_ns: i64,
        most: usize,
        recorder: &mut Recorder,
    ) -> Result<bool, RecordError> {
        self.feed.look_for_losses();
        let mut stamps: Vec<(i64, usize)> = Vec::new();
        for index in 0..self.topics.len() {
            self.describe(index, recorder);
            stamps.extend(self.look(index).map(|at_ns| (at_ns, index)));
        }
        let (mut samples, mut bytes) = (0, 0);
        while let Some((place, (at_ns, index))) =
            stamps.iter().copied().enumerate().min_by_key(|(_, stamp)| *stamp)
            && at_ns <= until_ns
        {
            if samples >= most || bytes >= BYTES_TURN && most != usize::MAX {
                return Ok(true);
            }
            // Up to the next sample of any other topic.
            let others = stamps.iter().filter(|(_, other)| *other != index);
            let until_ns = others.map(|(at_ns, _)| *at_ns).min().unwrap_or(until_ns).min(until_ns);
            let GrantedTopic { topic, supply: Supply::Fed(fed), .. } = &mut self.topics[index]
            else {
                return Ok(false);
            };
            let layout = fed.samples.layout_as(fed.described.as_deref());
            let taken = fed.samples.read(until_ns, most - samples, |meta, cdr| {
                let meta = SampleMeta { layout: layout.unwrap_or(meta.layout), ..*meta };
                recorder.sample(*topic, &meta, cdr)
            })?;
            (samples, bytes) = (samples + taken.0, bytes + taken.1);
            match self.look(index) {
                Some(at_ns) => stamps[place].0 = at_ns,
                None => drop(stamps.swap_remove(place)),
            }
        }
        Ok(false)
    }

    pub fn statuses(&self) -> Vec<RecordedTopic> {
        self.topics.iter().map(|topic| topic.status(self.reception(topic.id))).collect()
    }

    /// Returns the state of a subscription, if the ingress has sent it.
    pub fn reception(&self, id: u32) -> Option<ReceptionStatus> {
        self.feed.reception(id)
    }

    fn attach(&mut self, fed: SharedTopicReader, since_ns: i64) {
        let id = fed.info.id;
        let Some(known) = self.topics.iter_mut().find(|known| known.id == id) else {
            self.early.entry(id).or_default().push(Ok(fed));
            return;
        };
        if let Supply::Fed(earlier) = &mut known.supply {
            if !same_type(earlier.samples.type_name(), &fed.info.type_name) {
                return self.refuse(id, RefusedTopic::WrongType { found: fed.info.type_name });
            }
            known.refused = None;
            earlier.samples.continue_in(fed);
            // The answer of an ingress that has ended does not come.
            if matches!(earlier.description, Description::Asked(_)) {
                earlier.description = Description::Unknown;
            }
            return;
        }
        let type_name = fed.info.type_name.clone();
        // It ends only with the loop.
        let _ = self.searches.send(DefinitionsRequest { id, type_name });
        known.supply = Supply::Fed(Box::new(FedRecording {
            samples: SampleReader::new(fed),
            description: Description::Searched,
            since_ns,
            is_warned: false,
            local: None,
            layout_asked: None,
            described: None,
        }));
    }

    fn refuse(&mut self, id: u32, reason: RefusedTopic) {
        let Some(known) = self.topics.iter_mut().find(|known| known.id == id) else {
            if id == COMMANDS_ID {
                error!(why = describe(&reason), "cannot receive the topic of commands");
            } else {
                self.early.entry(id).or_default().push(Err(reason));
            }
            return;
        };
        let why = describe(&reason);
        error!(topic = %visible(&known.name), %why, "cannot record a topic");
        known.refused = Some(why);
    }

    fn fed(&mut self, id: u32) -> Option<&mut FedRecording> {
        match &mut self.topics.iter_mut().find(|known| known.id == id)?.supply {
            Supply::Fed(fed) => Some(fed),
            Supply::Awaited => None,
        }
    }

    /// Passes the description of a topic to the recorder before its first sample.
    fn describe(&mut self, index: usize, recorder: &mut Recorder) {
        let GrantedTopic { id, name, topic, supply: Supply::Fed(fed), .. } =
            &mut self.topics[index]
        else {
            return;
        };
        fed.request_layout(*id, &mut self.feed);
        match &fed.description {
            Description::Settled | Description::Searched => return,
            _ if fed.samples.look().is_none() || fed.samples.lacks_layout() => return,
            Description::Found => {
                let local = fed.local.take();
                fed.description = match fed.samples.definitions(local) {
                    Some(text) => Description::Known(Some(text)),
                    None => Description::Unknown,
                };
                return self.describe(index, recorder);
            }
            // The next one is asked.
            Description::Unknown if !self.feed.has_ingress() => return,
            Description::Unknown => {
                fed.description = match self.feed.request_definitions(*id) {
                    Ok(()) => Description::Asked(Instant::now()),
                    Err(_) => Description::Known(None),
                };
            }
            Description::Asked(at) if at.elapsed() >= DEFINITIONS_TIMEOUT => {
                fed.description = Description::Known(None);
            }
            Description::Asked(_) | Description::Known(_) => {}
        }
        let Description::Known(definitions) = &fed.description else { return };
        let type_name = fed.samples.type_name().to_owned();
        if definitions.is_none() {
            let (topic, type_name) = (visible(name), visible(&type_name));
            warn!(
                %topic,
                %type_name,
                "no definitions of this type; recording its messages without a schema"
            );
        }
        let schema = TopicSchema {
            name: name.clone(),
            type_name,
            definitions: definitions.clone(),
            other_definitions: Vec::new(),
            offered_qos: fed.samples.offered_qos().map(str::to_owned),
        };
        fed.description = Description::Settled;
        // If writers announce none, a later one may announce this.
        let own = || type_hash(&schema.type_name, schema.definitions.as_deref()?).ok();
        fed.described = fed.samples.type_hash().map(str::to_owned).or_else(own);
        if let Err(why) = recorder.found_topic(*topic, schema, fed.since_ns) {
            error!(error = &why as &dyn std::error::Error, "cannot record a topic");
        }
    }

    /// Returns the stamp of the next sample of a topic that is described.
    fn look(&mut self, index: usize) -> Option<i64> {
        let GrantedTopic { name, supply: Supply::Fed(fed), .. } = &mut self.topics[index] else {
            return None;
        };
        if !matches!(fed.description, Description::Settled) {
            return None;
        }
        let stamp = fed.samples.look().filter(|_| !fed.samples.lacks_layout());
        if fed.samples.missed() > 0 && !std::mem::replace(&mut fed.is_warned, true) {
            let (topic, missed) = (visible(name), fed.samples.missed());
            warn!(%topic, missed, "recorder too slow: samples overwritten");
        }
        stamp
    }
}

impl FedRecording {
    /// Requests the layout if it is unknown: that of an ingress that was started again may be
    /// another one.
    fn request_layout(&mut self, id: u32, feed: &mut ReconnectingReader) {
        match self.layout_asked {
            _ if !self.samples.lacks_layout() => {}
            None if feed.request_layout(id).is_ok() => self.layout_asked = Some(Instant::now()),
            Some(at) if at.elapsed() >= DEFINITIONS_TIMEOUT => self.samples.set_layout(None),
            _ => {}
        }
    }
}

impl GrantedTopic {
    fn status(&self, reception: Option<ReceptionStatus>) -> RecordedTopic {
        let mut status = reception.unwrap_or_default();
        let samples = match &self.supply {
            Supply::Fed(fed) => Some(&fed.samples),
            Supply::Awaited => None,
        };
        if let Some(why) = &self.refused {
            status.qos_warnings.push(format!("It cannot be recorded: {why}."));
        }
        RecordedTopic {
            topic: self.name.clone(),
            type_name: samples.map(|samples| samples.type_name().to_owned()),
            writers: status.writers,
            received: samples.map_or(0, SampleReader::received),
            lost: status.lost,
            no_slot: samples.map_or(0, SampleReader::missed),
            too_big: samples.map_or(0, SampleReader::too_big),
            malformed: status.malformed,
            qos: status.qos,
            qos_warnings: status.qos_warnings,
        }
    }
}

fn describe(reason: &RefusedTopic) -> String {
    match reason {
        RefusedTopic::NoSuchTopic { .. } => "there is no such topic".to_owned(),
        RefusedTopic::WrongType { found } => format!("its type is `{}`", visible(found)),
        RefusedTopic::Other(lines) => visible(&lines.join(": ")),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use gleaner_ingress::Ingress;
    use gleaner_messages::transport::loopback::Loopback;
    use gleaner_protocol::ingress::{AddReader, IngressControl, Qos, recorded_grant};
    use gleaner_samples::Feed;

    use super::*;
    use crate::recorder::tests::support::{TestDir, meta};

    const TYPE: &str = "test_msgs/msg/Number";
    const TIMEOUT: Duration = Duration::from_secs(60);

    /// A source with topics that are granted from id 1 on, for samples of `max_bytes`.
    fn fed(names: &[&str], max_bytes: u64) -> (Loopback, IngressControl, Feed) {
        let source = Loopback::default();
        let (mut control, _) = Ingress::start_in_thread(Box::new(source.clone()));
        let topics = names.iter().zip(1..).map(|(name, id)| {
            source.add_topic(name, TYPE, "int64 value\n");
            recorded_grant(id, name, Some(TYPE.to_owned()), Some(max_bytes), Qos::Auto)
        });
        let topics = topics.collect();
        let add = AddReader { name: "recorder".to_owned(), topics, publishes: Vec::new() };
        let socket = control.add_reader(&add).unwrap();
        (source, control, Feed::connect(socket).unwrap())
    }

    #[test]
    fn samples_of_several_topics_are_taken_in_the_order_of_their_stamps() {
        let scratch = TestDir::new();
        let mut recorder = scratch.recorder(|_| {});
        let (source, _control, feed) = fed(&["/a", "/b"], 100);
        let (searches, searched) = channel();
        let mut topics = Topics::new(ReconnectingReader::new(feed, None), searches);
        for (name, id) in [("/a", 1), ("/b", 2)] {
            let topic = recorder.add_missing_topic(name).unwrap();
            topics.add(id, name, topic, 0);
        }
        let mut left = 2;
        let deadline = Instant::now() + TIMEOUT;
        while left > 0 {
            assert!(Instant::now() < deadline, "the topics are not attached");
            assert!(topics.poll(0).unwrap().is_none());
            while let Ok(DefinitionsRequest { id, .. }) = searched.try_recv() {
                topics.found_locally(id, None);
                left -= 1;
            }
            std::thread::yield_now();
        }
        let publish = |name: &str, at: i64| {
            source.publish(name, &meta(at, at as u64), &[7; 8]).unwrap();
        };
        (0..100).for_each(|n| publish("/a", 2 * n + 1));
        (0..100).for_each(|n| publish("/b", 2 * n + 2));
        assert!(topics.take(50, 20, &mut recorder).unwrap(), "there are more than 20");
        let received = |topics: &Topics| {
            topics.statuses().iter().map(|topic| topic.received).collect::<Vec<_>>()
        };
        assert_eq!(received(&topics), [10, 10]);
        assert!(!topics.take(50, usize::MAX, &mut recorder).unwrap());
        assert_eq!(received(&topics), [25, 25], "later ones wait");
        publish("/a", 201);
        assert!(!topics.take(1000, usize::MAX, &mut recorder).unwrap());
        assert_eq!(received(&topics), [101, 100]);
        let counts = recorder.counts();
        assert_eq!((counts.out_of_order, counts.recording.topic_unknown), (0, 0));
    }

    #[test]
    fn samples_that_leave_before_they_are_read_are_counted() {
        let (source, _control, mut feed) = fed(&["/a"], 16 << 20);
        let mut samples = SampleReader::new(feed.topic(1, TIMEOUT).unwrap());
        for seq in 1..=100 {
            source.publish("/a", &meta(seq as i64, seq), &[7; 8]).unwrap();
        }
        let mut read = Vec::new();
        while samples.look().is_some() {
            let keep = |meta: &gleaner_messages::transport::SampleMeta, _: &[u8]| {
                read.push(meta.seq);
                Ok::<(), RecordError>(())
            };
            samples.read(i64::MAX, usize::MAX, keep).unwrap();
        }
        assert!(samples.missed() > 0 && samples.received() > 0);
        assert_eq!(samples.missed() + samples.received(), 100);
        assert_eq!(read, (samples.missed() + 1..=100).collect::<Vec<_>>());
    }
}

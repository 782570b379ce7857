//! Our node in the graph of ROS 2: who is heard there, and what is said.

use bytes::Bytes;
use mio::{Interest, Registry, Token};
use rustdds::dds::CreateError;
use rustdds::{DomainParticipant, Duration, GUID, QosPolicyBuilder, RTPSEntity, TopicKind, policy};
use tracing::{info, warn};

use super::feed::Around;
use super::graph::{Entry, Hearing, Part, TOPIC, TYPE, encode};
use super::nodes::Nodes;
use super::offers::Request;
use super::peers::prefix;
use super::raw::{CopyInto, RawReader, RawWriter};
use super::state::State;
use super::{DdsError, Distro, Options};

/// Nodes whose newest word is kept until we have read it.
const KEPT: usize = 256;
/// How long the leave may take.
const LEAVE: std::time::Duration = std::time::Duration::from_millis(100);

/// Our node in the graph.
pub(super) struct Presence {
    node: String,
    entry: Entry,
    hearing: Hearing,
    nodes: Nodes,
    part: Part,
    reader: RawReader,
    /// Made when there is something to say.
    writer: Option<RawWriter>,
    said: Option<(Entry, Distro)>,
}

impl Presence {
    pub(super) fn new(
        options: &Options,
        (namespace, name): (String, String),
        participant: &DomainParticipant,
        registry: &Registry,
        token: Token,
    ) -> Result<Self, DdsError> {
        let join = |source| DdsError::Join { domain: options.domain, source };
        let reader = (|| {
            let policies = Request { reliable: true, transient_local: true }.policies(KEPT);
            let topic = participant.create_topic(
                TOPIC.to_owned(),
                TYPE.to_owned(),
                &policies,
                TopicKind::NoKey,
            )?;
            participant
                .create_subscriber(&policies)?
                .create_simple_datareader_no_key(&topic, Some(policies))
        })();
        let mut reader: RawReader = reader.map_err(|error| join(error.into()))?;
        registry
            .register(&mut reader, token, Interest::READABLE)
            .map_err(|error| join(error.into()))?;
        let entry = Entry {
            participant: participant.guid().to_bytes(),
            namespace,
            name,
            ..Entry::default()
        };
        Ok(Self {
            node: options.node.clone(),
            entry,
            hearing: Hearing::new(options.distro),
            nodes: Nodes::default(),
            part: Part::Silent,
            reader,
            writer: None,
            said: None,
        })
    }

    /// Listens to what others said.
    pub(super) fn listen(&mut self, around: &Around<'_>) {
        self.reader.drain_read_notifications();
        for _ in 0..KEPT {
            match self.reader.try_take_one_with(CopyInto {
                sink: None,
                memory: around.memory,
                clock: around.clock,
            }) {
                Ok(None) => break,
                Ok(Some(change)) => {
                    if change.writer_guid.prefix != self.reader.guid().prefix {
                        let said = around.memory.borrow();
                        self.hearing.hear(&said, change.sample.endian);
                        self.nodes.hear(prefix(&change.writer_guid), &said, change.sample.endian);
                    }
                }
                // Whatever it was, it says nothing.
                Err(_) => {}
            }
        }
    }

    /// Which nodes others have said that they have.
    pub(super) fn nodes(&mut self) -> &mut Nodes {
        &mut self.nodes
    }

    /// Says what there is to say, if it is not what was said.
    pub(super) fn speak(&mut self, around: &Around<'_>, readers: Vec<GUID>, writers: &[GUID]) {
        self.entry.readers = readers.iter().map(GUID::to_bytes).collect();
        self.entry.writers = writers.iter().map(GUID::to_bytes).collect();
        let part = self.hearing.part();
        if part != self.part {
            match part {
                Part::Out(why) => {
                    warn!(why, "not listed in the graph of ROS 2; data flows all the same")
                }
                _ => info!(graph = part.in_words(&self.node), "in the graph of ROS 2"),
            }
            self.part = part;
        }
        self.tell(around.state);
        match part {
            Part::In(distro) => self.say(around.participant, self.entry.clone(), distro),
            // First taken back, and at the next look the writer goes, so that nobody who comes
            // later hears of us.
            Part::Silent | Part::Out(_) => match &self.said {
                Some((entry, distro)) if !entry.name.is_empty() => {
                    let distro = *distro;
                    self.say(around.participant, self.nobody(), distro);
                }
                _ => self.writer = None,
            },
        }
    }

    /// Takes back what was said.
    pub(super) fn leave(mut self, participant: &DomainParticipant) {
        if let Some((_, distro)) = self.said {
            self.say(participant, self.nobody(), distro);
            if let Some(writer) = &self.writer {
                // Others forget us anyway when the participant says that it goes.
                drop(writer.wait_for_acknowledgments(LEAVE));
            }
        }
    }

    fn tell(&self, state: &State) {
        let distro = match self.part {
            Part::In(distro) => Some(distro),
            Part::Silent | Part::Out(_) => None,
        };
        state.set_graph(self.part.in_words(&self.node), distro);
    }

    fn nobody(&self) -> Entry {
        Entry { participant: self.entry.participant, ..Entry::default() }
    }

    fn say(&mut self, participant: &DomainParticipant, entry: Entry, distro: Distro) {
        if self
            .said
            .as_ref()
            .is_some_and(|(said, in_words_of)| *said == entry && *in_words_of == distro)
        {
            return;
        }
        if self.writer.is_none() {
            self.writer = writer(participant)
                .inspect_err(|error| warn!(%error, "cannot write the graph"))
                .ok();
        }
        let Some(writer) = &self.writer else { return };
        // What finds no room now is said at the next look.
        if writer.write(Bytes::from(encode(&entry, distro)), None).is_ok() {
            self.said = Some((entry, distro));
        }
    }
}

fn writer(participant: &DomainParticipant) -> Result<RawWriter, CreateError> {
    let policies = QosPolicyBuilder::new()
        // This is the receive thread: it waits for nobody.
        .reliability(policy::Reliability::Reliable { max_blocking_time: Duration::ZERO })
        .durability(policy::Durability::TransientLocal)
        .history(policy::History::KeepLast { depth: 1 })
        .build();
    let topic =
        participant.create_topic(TOPIC.to_owned(), TYPE.to_owned(), &policies, TopicKind::NoKey)?;
    participant.create_publisher(&policies)?.create_datawriter_no_key(&topic, Some(policies))
}

//! Lists our node in the ROS 2 graph, and receives the nodes of other participants.

use bytes::Bytes;
use mio::{Interest, Registry, Token};
use rustdds::dds::CreateError;
use rustdds::{DomainParticipant, Duration, GUID, QosPolicyBuilder, RTPSEntity, TopicKind, policy};
use tracing::{info, warn};

use super::graph_message::{DistroDetector, Listing, OwnNode, TOPIC, TYPE, encode};
use super::nodes::Nodes;
use super::peers::prefix;
use super::qos::Request;
use super::raw::{CopyInto, RawReader, RawWriter};
use super::state::ParticipantState;
use super::topic_reader::ReceiveContext;
use super::{DdsError, DdsOptions, Distro};

/// Participants whose newest message is kept until we have read it.
const KEPT: usize = 256;
/// Time that leaving the graph may take.
const LEAVE: std::time::Duration = std::time::Duration::from_millis(100);

pub(super) struct GraphNode {
    node: String,
    entry: OwnNode,
    detector: DistroDetector,
    nodes: Nodes,
    listing: Listing,
    reader: RawReader,
    /// Created with the first message.
    writer: Option<RawWriter>,
    sent: Option<(OwnNode, Distro)>,
}

impl GraphNode {
    pub(super) fn new(
        options: &DdsOptions,
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
        let entry = OwnNode {
            participant: participant.guid().to_bytes(),
            namespace,
            name,
            ..OwnNode::default()
        };
        Ok(Self {
            node: options.node.clone(),
            entry,
            detector: DistroDetector::new(options.distro),
            nodes: Nodes::default(),
            listing: Listing::Unlisted,
            reader,
            writer: None,
            sent: None,
        })
    }

    /// Receives the messages of other participants.
    pub(super) fn receive(&mut self, context: &ReceiveContext<'_>) {
        self.reader.drain_read_notifications();
        for _ in 0..KEPT {
            match self.reader.try_take_one_with(CopyInto {
                sink: None,
                memory: context.memory,
                clock: context.clock,
            }) {
                Ok(None) => break,
                Ok(Some(change)) => {
                    if change.writer_guid.prefix != self.reader.guid().prefix {
                        let message = context.memory.borrow();
                        self.detector.observe(&message, change.sample.endian);
                        self.nodes.note(
                            prefix(&change.writer_guid),
                            &message,
                            change.sample.endian,
                        );
                    }
                }
                // An unreadable message is ignored.
                Err(_) => {}
            }
        }
    }

    /// The nodes of other participants.
    pub(super) fn nodes(&mut self) -> &mut Nodes {
        &mut self.nodes
    }

    /// Sends our current entry, if it differs from the last one sent.
    pub(super) fn update(
        &mut self,
        context: &ReceiveContext<'_>,
        readers: Vec<GUID>,
        writers: &[GUID],
    ) {
        self.entry.readers = readers.iter().map(GUID::to_bytes).collect();
        self.entry.writers = writers.iter().map(GUID::to_bytes).collect();
        let listing = self.detector.listing();
        if listing != self.listing {
            match listing {
                Listing::Out(why) => {
                    warn!(why, "not listed in the ROS 2 graph; data is not affected")
                }
                _ => info!(graph = listing.describe(&self.node), "ROS 2 graph"),
            }
            self.listing = listing;
        }
        self.report(context.state);
        match listing {
            Listing::In(distro) => self.send(context.participant, self.entry.clone(), distro),
            // First an entry without a node, and at the next update the writer goes, so that later
            // participants do not receive our node.
            Listing::Unlisted | Listing::Out(_) => match &self.sent {
                Some((entry, distro)) if !entry.name.is_empty() => {
                    let distro = *distro;
                    self.send(context.participant, self.without_node(), distro);
                }
                _ => self.writer = None,
            },
        }
    }

    /// Withdraws our entry.
    pub(super) fn leave(mut self, participant: &DomainParticipant) {
        if let Some((_, distro)) = self.sent {
            self.send(participant, self.without_node(), distro);
            if let Some(writer) = &self.writer {
                // Other nodes remove this node anyway when the participant leaves.
                drop(writer.wait_for_acknowledgments(LEAVE));
            }
        }
    }

    fn report(&self, state: &ParticipantState) {
        let distro = match self.listing {
            Listing::In(distro) => Some(distro),
            Listing::Unlisted | Listing::Out(_) => None,
        };
        state.set_graph(self.listing.describe(&self.node), distro);
    }

    fn without_node(&self) -> OwnNode {
        OwnNode { participant: self.entry.participant, ..OwnNode::default() }
    }

    fn send(&mut self, participant: &DomainParticipant, entry: OwnNode, distro: Distro) {
        if self.sent.as_ref().is_some_and(|(sent, format)| *sent == entry && *format == distro) {
            return;
        }
        if self.writer.is_none() {
            self.writer = writer(participant)
                .inspect_err(|error| warn!(%error, "cannot write the ROS 2 graph"))
                .ok();
        }
        let Some(writer) = &self.writer else { return };
        // A message for which there is no room is sent at the next update.
        if writer.write(Bytes::from(encode(&entry, distro)), None).is_ok() {
            self.sent = Some((entry, distro));
        }
    }
}

fn writer(participant: &DomainParticipant) -> Result<RawWriter, CreateError> {
    let policies = QosPolicyBuilder::new()
        // This is the receive thread: it must not block.
        .reliability(policy::Reliability::Reliable { max_blocking_time: Duration::ZERO })
        .durability(policy::Durability::TransientLocal)
        .history(policy::History::KeepLast { depth: 1 })
        .build();
    let topic =
        participant.create_topic(TOPIC.to_owned(), TYPE.to_owned(), &policies, TopicKind::NoKey)?;
    participant.create_publisher(&policies)?.create_datawriter_no_key(&topic, Some(policies))
}

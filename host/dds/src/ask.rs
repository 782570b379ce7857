//! Asking a node of ROS 2 what a message type is: its service `get_type_description`, which nodes
//! of Iron and newer have.
//!
//! The receive thread asks one question at a time, of one node, and hands the answer over as it
//! came; who asked reads it. A node is known by the graph, and the type's hash, without which no
//! node answers, by what the writer announced.
//!
//! Which question an answer belongs to is said in two ways: rmw_cyclonedds puts 16 bytes in front
//! of both, all others name the question beside the answer. The participant's vendor tells which;
//! where it does not, both are tried in turn.
//!
//! Sources: rmw_cyclonedds_cpp `serdata.cpp`, rmw_fastrtps_shared_cpp `rmw_request.cpp`; OMG RPC
//! over DDS 1.0, 7.2.4.

use std::time::{Duration, Instant};

use bytes::Bytes;
use mio::{Interest, Token};
use rustdds::dds::CreateError;
use rustdds::discovery::DiscoveredWriterData;
use rustdds::{
    DomainParticipant, QosPolicyBuilder, RTPSEntity, SampleIdentity, SequenceNumber, TopicKind,
    WriteOptionsBuilder, policy,
};

use super::feed::Around;
use super::names::{dds_topic, dds_type, visible};
use super::nodes::Nodes;
use super::offers::Request;
use super::peers::prefix;
use super::raw::{CopyInto, RawReader, RawWriter};
use gleaner_messages::Endian;
use gleaner_messages::described::{Header, question};
use gleaner_transport::Guid;

/// How long a question may take, from looking for somebody to ask until the answer is here.
const LIMIT: Duration = Duration::from_secs(2);
/// The largest answer. Of ROS 2's own types they stay below 64 KiB.
const LARGEST: usize = 1 << 20;
/// Answers that are kept until they are looked at: those to others come, too.
const KEPT: usize = 16;

const REQUEST: &str = "type_description_interfaces::srv::dds_::GetTypeDescription_Request_";
const RESPONSE: &str = "type_description_interfaces::srv::dds_::GetTypeDescription_Response_";

const CYCLONE: [u8; 2] = [1, 0x10];
const OTHERS: [[u8; 2]; 2] = [[1, 0x0f], [1, 1]];

/// A question that somebody has.
#[derive(Clone, Debug)]
pub(super) struct Ask {
    /// By which the outcome is told from that of an earlier question.
    pub(super) ticket: u64,
    pub(super) type_name: String,
    pub(super) before: Asked,
}

/// How often something was asked, and how often of those nobody answered.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct Asked {
    pub(super) times: usize,
    pub(super) in_vain: usize,
}

/// What became of a question.
#[derive(Debug)]
pub(super) enum Outcome {
    /// A node answered.
    Answer {
        node: String,
        /// Of the type, as its writer announced it.
        hash: String,
        /// Without a header.
        cdr: Vec<u8>,
        endian: Endian,
    },
    /// Nobody did.
    Silence {
        why: String,
        /// Whether it may help to ask again.
        again: bool,
    },
}

/// Asks.
#[derive(Default)]
pub(super) struct Asker {
    open: Option<Open>,
}

struct Open {
    ask: Ask,
    begun: Instant,
    call: Option<Call>,
    /// What it waits for.
    lacks: (String, bool),
}

/// One node, asked.
struct Call {
    whom: Whom,
    writer: RawWriter,
    reader: RawReader,
    sent: Option<(SequenceNumber, Option<Header>)>,
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Whom {
    node: String,
    hash: String,
    writer: Guid,
}

impl Asker {
    /// Asks this from now on, and nothing else.
    pub(super) fn ask(&mut self, ask: Ask) {
        let lacks = ("the receive thread was busy".to_owned(), true);
        self.open = Some(Open { ask, begun: Instant::now(), call: None, lacks });
    }

    pub(super) fn is_asking(&self) -> bool {
        self.open.is_some()
    }

    /// Bytes of the largest answer that is expected.
    pub(super) fn largest(&self) -> usize {
        if self.is_asking() { LARGEST } else { 0 }
    }

    /// Goes on with it.
    pub(super) fn look(
        &mut self,
        around: &Around<'_>,
        token: Token,
        writers: &[DiscoveredWriterData],
        nodes: &Nodes,
    ) {
        let Some(open) = &mut self.open else { return };
        let mut outcome = open.proceed(around, token, writers, nodes);
        if outcome.is_none() && open.begun.elapsed() >= LIMIT {
            let (why, again) = open.lacks.clone();
            outcome = Some(Outcome::Silence { why, again });
        }
        if let Some(outcome) = outcome {
            around.state.answer(open.ask.ticket, outcome);
            if let Some(call) = self.open.take().and_then(|open| open.call) {
                call.give_up(around);
            }
        }
    }
}

impl Open {
    fn proceed(
        &mut self,
        around: &Around<'_>,
        token: Token,
        writers: &[DiscoveredWriterData],
        nodes: &Nodes,
    ) -> Option<Outcome> {
        if self.call.is_none() {
            match whom(&self.ask, writers, nodes)
                .and_then(|whom| Call::make(around, token, &self.ask, whom))
            {
                Ok(call) => self.call = Some(call),
                // It may not have been heard of yet.
                Err(Lack::Yet(why)) => self.lacks = (why, false),
                Err(Lack::Ever(why)) => return Some(Outcome::Silence { why, again: false }),
            }
        }
        let call = self.call.as_mut()?;
        let node = visible(&call.whom.node);
        if call.sent.is_none() {
            self.lacks =
                (format!("node `{node}` does not offer the service get_type_description"), false);
            call.send(around, &self.ask)?;
        }
        self.lacks = (format!("node `{node}` did not answer within {} s", LIMIT.as_secs()), true);
        call.take(around).map(|answer| match answer {
            Ok((cdr, endian)) => {
                Outcome::Answer { node, hash: call.whom.hash.clone(), cdr, endian }
            }
            Err(why) => Outcome::Silence { why: format!("node `{node}`: {why}"), again: true },
        })
    }
}

enum Lack {
    Yet(String),
    Ever(String),
}

/// Whom to ask: each time another node, if several write the type.
fn whom(ask: &Ask, writers: &[DiscoveredWriterData], nodes: &Nodes) -> Result<Whom, Lack> {
    let yet = |why: &str| Lack::Yet(why.to_owned());
    let type_name =
        dds_type(&ask.type_name).ok_or_else(|| Lack::Ever("it is no type of ROS 2".to_owned()))?;
    let of_type =
        || writers.iter().filter(|writer| writer.publication_topic_data.type_name == type_name);
    if of_type().next().is_none() {
        return Err(yet("nobody writes it"));
    }
    let announced: Vec<_> =
        of_type().filter_map(|writer| Some((writer, type_hash(&writer.user_data)?))).collect();
    if announced.is_empty() {
        let why = "its writers do not announce the type's hash, as nodes of Iron and newer do";
        return Err(Lack::Ever(why.to_owned()));
    }
    let whom = announced.into_iter().filter_map(|(writer, hash)| {
        let writer = Guid(writer.writer_proxy.remote_writer_guid.to_bytes());
        Some(Whom { node: nodes.writing(writer)?.to_owned(), hash, writer })
    });
    let mut whom: Vec<Whom> = whom.collect();
    whom.sort_unstable();
    whom.dedup_by(|a, b| a.node == b.node);
    match whom.len() {
        0 => Err(yet("which node writes it is not known: the graph of ROS 2 does not say")),
        count => Ok(whom.swap_remove(ask.before.times % count)),
    }
}

/// The hash of a writer's type, out of what nodes of Iron and newer announce with a writer:
/// `typehash=RIHS01_…;`.
fn type_hash(user_data: &[u8]) -> Option<String> {
    const KEY: &[u8] = b"typehash=";
    const HASH: usize = "RIHS01_".len() + 64;
    let at = user_data.windows(KEY.len()).position(|window| window == KEY)?;
    let hash = str::from_utf8(user_data.get(at + KEY.len()..)?.get(..HASH)?).ok()?;
    let digits = hash.strip_prefix("RIHS01_")?;
    digits.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f')).then(|| hash.to_owned())
}

impl Call {
    fn make(around: &Around<'_>, token: Token, ask: &Ask, whom: Whom) -> Result<Self, Lack> {
        let service = dds_topic(&format!("{}/get_type_description", whom.node));
        let Some(service) = service.as_deref().and_then(|service| service.strip_prefix("rt"))
        else {
            return Err(Lack::Ever(format!("`{}` is no name of a node", visible(&whom.node))));
        };
        let ever = |why: String| {
            Lack::Ever(format!("node `{}` cannot be asked: {why}", visible(&whom.node)))
        };
        // Held, so that nobody can be connected before it is followed who.
        let mut peers = around.state.peers();
        let (writer, mut reader) = endpoints(around.participant, service)
            .map_err(|error| ever(visible(&error.to_string())))?;
        peers.follow(writer.guid());
        peers.follow(reader.guid());
        drop(peers);
        around
            .registry
            .register(&mut reader, token, Interest::READABLE)
            .map_err(|error| ever(error.to_string()))?;
        tracing::info!(
            type_name = ask.type_name,
            node = visible(&whom.node),
            hash = whom.hash,
            "asking for definitions"
        );
        Ok(Self { whom, writer, reader, sent: None })
    }

    /// What is in front of question and answer, if it is on a DDS that wants that.
    fn header(&self, around: &Around<'_>, ask: &Ask) -> Option<Header> {
        let guid = self.writer.guid().to_bytes();
        let vendor =
            around.state.peers().vendor(prefix(&rustdds::GUID::from_bytes(self.whom.writer.0)));
        let with = match vendor {
            Some(CYCLONE) => true,
            Some(vendor) if OTHERS.contains(&vendor) => false,
            _ => ask.before.in_vain % 2 == 1,
        };
        let own = *guid.last_chunk::<8>().expect("8 of 16 bytes");
        with.then(|| Header([u64::from_le_bytes(own), ask.ticket]))
    }

    /// Sends the question, as soon as there is somebody at both ends. `None` if there is not.
    fn send(&mut self, around: &Around<'_>, ask: &Ask) -> Option<()> {
        let peers = around.state.peers();
        let here =
            peers.connected(self.writer.guid()) > 0 && peers.connected(self.reader.guid()) > 0;
        drop(peers);
        if !here {
            return None;
        }
        let header = self.header(around, ask);
        let question = Bytes::from(question(&ask.type_name, &self.whom.hash, header));
        // Fast DDS waits for this reader, then, before it answers. The number is that of the
        // question, which it knows.
        let related = SampleIdentity {
            writer_guid: self.reader.guid(),
            sequence_number: SequenceNumber::UNKNOWN,
        };
        let options = WriteOptionsBuilder::new()
            .related_sample_identity_opt(header.is_none().then_some(related));
        let sent = self.writer.write_with_options(question, options.build()).ok()?;
        self.sent = Some((sent.sequence_number, header));
        Some(())
    }

    /// The answer, or why there is none; `None` while there is neither.
    fn take(&mut self, around: &Around<'_>) -> Option<Result<(Vec<u8>, Endian), String>> {
        let (sent, header) = self.sent?;
        self.reader.drain_read_notifications();
        for _ in 0..KEPT {
            let memory = CopyInto { sink: None, memory: around.memory, clock: around.clock };
            let change = match self.reader.try_take_one_with(memory) {
                Ok(None) => break,
                Ok(Some(change)) => change,
                // Whoever writes to this topic may write anything, and is not who was asked.
                Err(_) => continue,
            };
            let (memory, endian) = (around.memory.borrow(), change.sample.endian);
            let ours = match header {
                Some(header) => Header::split(&memory, endian)
                    .and_then(|(found, cdr)| (found == header).then_some(cdr)),
                None => change.related_sample_identity().and_then(|to| {
                    let guids = [self.reader.guid(), self.writer.guid()];
                    (to.sequence_number == sent && guids.contains(&to.writer_guid))
                        .then_some(memory.as_slice())
                }),
            };
            match ours {
                // Somebody else's.
                None => {}
                Some(cdr) if cdr.len() > LARGEST => {
                    return Some(Err(format!(
                        "its answer has {} bytes, more than {LARGEST}",
                        cdr.len()
                    )));
                }
                Some(cdr) => return Some(Ok((cdr.to_vec(), endian))),
            }
        }
        None
    }

    fn give_up(mut self, around: &Around<'_>) {
        drop(around.registry.deregister(&mut self.reader));
        let mut peers = around.state.peers();
        peers.forget(self.writer.guid());
        peers.forget(self.reader.guid());
    }
}

/// Writes questions to a service, and reads its answers.
fn endpoints(
    participant: &DomainParticipant,
    service: &str,
) -> Result<(RawWriter, RawReader), CreateError> {
    let policies = QosPolicyBuilder::new()
        // This is the receive thread: it waits for nobody.
        .reliability(policy::Reliability::Reliable { max_blocking_time: rustdds::Duration::ZERO })
        .durability(policy::Durability::Volatile)
        .history(policy::History::KeepLast { depth: 1 })
        .build();
    let (name, type_name) = (format!("rq{service}Request"), REQUEST.to_owned());
    let topic = participant.create_topic(name, type_name, &policies, TopicKind::NoKey)?;
    let writer = participant
        .create_publisher(&policies)?
        .create_datawriter_no_key(&topic, Some(policies))?;
    let policies = Request { reliable: true, transient_local: false }.policies(KEPT);
    let (name, type_name) = (format!("rr{service}Reply"), RESPONSE.to_owned());
    let topic = participant.create_topic(name, type_name, &policies, TopicKind::NoKey)?;
    let reader = participant
        .create_subscriber(&policies)?
        .create_simple_datareader_no_key(&topic, Some(policies))?;
    Ok((writer, reader))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hash_is_found_among_what_else_a_writer_announces() {
        let hash = format!("RIHS01_{}", "0123456789abcdef".repeat(4));
        for front in [&b""[..], b"\x53\0\0\0", b"clientid=1;typehash;", b"\xff\xfe"] {
            let user_data = [front, b"typehash=", hash.as_bytes(), b";more"].concat();
            assert_eq!(type_hash(&user_data), Some(hash.clone()));
            assert_eq!(type_hash(&user_data[..user_data.len() - 6]), None, "cut");
        }
        for wrong in ["", "RIHS02_", "RIHS01_x", &hash.to_uppercase(), &hash.replace('7', "\u{1b}")]
        {
            assert_eq!(type_hash(format!("typehash={wrong};").as_bytes()), None, "{wrong}");
        }
    }
}

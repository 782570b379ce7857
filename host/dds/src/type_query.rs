//! Requests the definition of a message type from a ROS 2 node, by its service
//! `get_type_description`, which nodes of Iron and newer have.
//!
//! The receive thread sends one query at a time, to one node, and returns the raw answer; the
//! caller parses it. The node is found by the graph; the type's hash, without which no node
//! answers, is in the announcement of the writer.
//!
//! Request and answer are matched in two ways: rmw_cyclonedds puts a 16-byte header before both,
//! all others use the related sample identity. The participant's vendor decides; where it is
//! unknown, both are tried in turn.
//!
//! Sources: rmw_cyclonedds_cpp `serdata.cpp`, rmw_fastrtps_shared_cpp `rmw_request.cpp`; OMG RPC
//! over DDS 1.0, 7.2.4.

use std::time::{Duration, Instant};

use bytes::Bytes;
use mio::{Interest, Token};
use rustdds::dds::CreateError;
use rustdds::{
    DomainParticipant, QosPolicyBuilder, RTPSEntity, SampleIdentity, SequenceNumber, TopicKind,
    WriteOptionsBuilder, policy,
};

use super::names::{dds_topic, dds_type, visible};
use super::nodes::Nodes;
use super::peers::prefix;
use super::qos::{Offer, Request};
use super::raw::{CopyInto, RawReader, RawWriter};
use super::topic_reader::ReceiveContext;
use gleaner_messages::Endian;
use gleaner_messages::transport::Guid;
use gleaner_messages::type_description::{RequestHeader, request};

/// Time limit of a query, from the search for a node to its answer.
const LIMIT: Duration = Duration::from_secs(2);
/// The largest answer. For ROS 2's own types they stay below 64 KiB.
const LARGEST: usize = 1 << 20;
/// Answers that are queued until they are read: those to other clients arrive, too.
const KEPT: usize = 16;

const REQUEST: &str = "type_description_interfaces::srv::dds_::GetTypeDescription_Request_";
const RESPONSE: &str = "type_description_interfaces::srv::dds_::GetTypeDescription_Response_";

const CYCLONE: [u8; 2] = [1, 0x10];
const OTHERS: [[u8; 2]; 2] = [[1, 0x0f], [1, 1]];

/// A request for the definition of one type.
#[derive(Clone, Debug)]
pub(super) struct TypeQuery {
    /// Distinguishes its outcome from that of an earlier query.
    pub(super) ticket: u64,
    pub(super) type_name: String,
    /// The hash that the type must have, if its writers announce any.
    pub(super) type_hash: Option<String>,
    pub(super) before: Attempts,
}

/// Number of queries for a type, and how many of them got no answer.
#[derive(Copy, Clone, Debug, Default)]
pub(super) struct Attempts {
    pub(super) times: usize,
    pub(super) unanswered: usize,
}

#[derive(Debug)]
pub(super) enum QueryOutcome {
    Answer {
        node: String,
        /// The type's hash, as its writer announced it.
        hash: String,
        /// The answer, without a header.
        cdr: Vec<u8>,
        endian: Endian,
    },
    /// No node answered.
    Failed { why: String, retry: Retry },
}

/// The use of another query after one that failed.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(super) enum Retry {
    No,
    Yes,
    /// Yes, and the failed one does not count: it was sent to no node.
    Unsent,
}

#[derive(Default)]
pub(super) struct TypeQuerier {
    open: Option<OpenQuery>,
}

struct OpenQuery {
    query: TypeQuery,
    begun: Instant,
    call: Option<ServiceCall>,
    /// The reason if the time limit is reached now.
    missing: (String, Retry),
}

/// The client of one node's service.
struct ServiceCall {
    target: QueryTarget,
    writer: RawWriter,
    reader: RawReader,
    sent: Option<(SequenceNumber, Option<RequestHeader>)>,
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct QueryTarget {
    node: String,
    hash: String,
    writer: Guid,
}

impl TypeQuerier {
    /// Starts `query`, in place of any other.
    pub(super) fn start(&mut self, query: TypeQuery) {
        let missing = ("the receive thread was busy".to_owned(), Retry::Yes);
        self.open = Some(OpenQuery { query, begun: Instant::now(), call: None, missing });
    }

    pub(super) fn is_open(&self) -> bool {
        self.open.is_some()
    }

    /// Bytes of the largest answer that is expected.
    pub(super) fn largest(&self) -> usize {
        if self.is_open() { LARGEST } else { 0 }
    }

    pub(super) fn poll(
        &mut self,
        context: &ReceiveContext<'_>,
        token: Token,
        offers: &[Offer],
        nodes: &Nodes,
    ) {
        let Some(open) = &mut self.open else { return };
        let mut outcome = open.proceed(context, token, offers, nodes);
        if outcome.is_none() && open.begun.elapsed() >= LIMIT {
            let (why, retry) = open.missing.clone();
            outcome = Some(QueryOutcome::Failed { why, retry });
        }
        if let Some(outcome) = outcome {
            context.state.answer(open.query.ticket, outcome);
            if let Some(call) = self.open.take().and_then(|open| open.call) {
                call.close(context);
            }
        }
    }
}

impl OpenQuery {
    fn proceed(
        &mut self,
        context: &ReceiveContext<'_>,
        token: Token,
        offers: &[Offer],
        nodes: &Nodes,
    ) -> Option<QueryOutcome> {
        if self.call.is_none() {
            match target(&self.query, offers, nodes)
                .and_then(|target| ServiceCall::create(context, token, &self.query, target))
            {
                Ok(call) => self.call = Some(call),
                // It may not be discovered yet.
                Err(NoTarget::Yet(why)) => self.missing = (why, Retry::Unsent),
                Err(NoTarget::Ever(why)) => {
                    return Some(QueryOutcome::Failed { why, retry: Retry::No });
                }
            }
        }
        let call = self.call.as_mut()?;
        let node = visible(&call.target.node);
        if call.sent.is_none() {
            let why = format!("node `{node}` does not offer the service get_type_description");
            self.missing = (why, Retry::No);
            call.send(context, &self.query)?;
        }
        let why = format!("node `{node}` did not answer within {} s", LIMIT.as_secs());
        self.missing = (why, Retry::Yes);
        call.take(context).map(|answer| match answer {
            Ok((cdr, endian)) => {
                QueryOutcome::Answer { node, hash: call.target.hash.clone(), cdr, endian }
            }
            Err(why) => {
                QueryOutcome::Failed { why: format!("node `{node}`: {why}"), retry: Retry::Yes }
            }
        })
    }
}

enum NoTarget {
    Yet(String),
    Ever(String),
}

/// Chooses the node: each time another one, if several write the type.
fn target(query: &TypeQuery, offers: &[Offer], nodes: &Nodes) -> Result<QueryTarget, NoTarget> {
    let yet = |why: &str| NoTarget::Yet(why.to_owned());
    let type_name =
        dds_type(&query.type_name).ok_or_else(|| NoTarget::Ever("not a ROS 2 type".to_owned()))?;
    let mut of_type = offers.iter().filter(|offer| offer.type_name == type_name).peekable();
    if of_type.peek().is_none() {
        return Err(yet("no writer of the type is known"));
    }
    let announced: Vec<_> =
        of_type.filter_map(|offer| Some((offer.guid, offer.type_hash.clone()?))).collect();
    if announced.is_empty() {
        let why = "its writers do not announce the type's hash, as nodes of Iron and newer do";
        return Err(NoTarget::Ever(why.to_owned()));
    }
    let is_wanted = |hash: &String| query.type_hash.as_ref().is_none_or(|wanted| wanted == hash);
    let wanted = announced.into_iter().filter(|(_, hash)| is_wanted(hash));
    let target = wanted.filter_map(|(writer, hash)| {
        Some(QueryTarget { node: nodes.writing(writer)?.to_owned(), hash, writer })
    });
    let mut target: Vec<QueryTarget> = target.collect();
    target.sort_unstable();
    target.dedup_by(|a, b| a.node == b.node);
    match target.len() {
        0 => Err(yet("the ROS 2 graph does not list the node that writes it")),
        count => Ok(target.swap_remove(query.before.times % count)),
    }
}

/// Parses the hash of a writer's type from the user data that nodes of Iron and newer announce with
/// a writer: `typehash=RIHS01_…;`.
pub(super) fn type_hash(user_data: &[u8]) -> Option<String> {
    const KEY: &[u8] = b"typehash=";
    const HASH: usize = "RIHS01_".len() + 64;
    let at = user_data.windows(KEY.len()).position(|window| window == KEY)?;
    let hash = str::from_utf8(user_data.get(at + KEY.len()..)?.get(..HASH)?).ok()?;
    let digits = hash.strip_prefix("RIHS01_")?;
    digits.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'a'..=b'f')).then(|| hash.to_owned())
}

impl ServiceCall {
    fn create(
        context: &ReceiveContext<'_>,
        token: Token,
        query: &TypeQuery,
        target: QueryTarget,
    ) -> Result<Self, NoTarget> {
        let service = dds_topic(&format!("{}/get_type_description", target.node));
        let Some(service) = service.as_deref().and_then(|service| service.strip_prefix("rt"))
        else {
            return Err(NoTarget::Ever(format!(
                "`{}` is not a valid node name",
                visible(&target.node)
            )));
        };
        let ever = |why: String| {
            NoTarget::Ever(format!("node `{}` cannot be queried: {why}", visible(&target.node)))
        };
        // Locked, so that no match is missed before the endpoints are followed.
        let mut peers = context.state.peers();
        let (writer, mut reader) = endpoints(context.participant, service)
            .map_err(|error| ever(visible(&error.to_string())))?;
        peers.follow(writer.guid());
        peers.follow(reader.guid());
        drop(peers);
        context
            .registry
            .register(&mut reader, token, Interest::READABLE)
            .map_err(|error| ever(error.to_string()))?;
        tracing::info!(
            type_name = query.type_name,
            node = visible(&target.node),
            hash = target.hash,
            "requesting definitions from a node"
        );
        Ok(Self { target, writer, reader, sent: None })
    }

    /// The header of request and answer, if the node's DDS uses one.
    fn header(&self, context: &ReceiveContext<'_>, query: &TypeQuery) -> Option<RequestHeader> {
        let guid = self.writer.guid().to_bytes();
        let vendor =
            context.state.peers().vendor(prefix(&rustdds::GUID::from_bytes(self.target.writer.0)));
        let with = match vendor {
            Some(CYCLONE) => true,
            Some(vendor) if OTHERS.contains(&vendor) => false,
            _ => query.before.unanswered % 2 == 1,
        };
        let own = *guid.last_chunk::<8>().expect("8 of 16 bytes");
        with.then(|| RequestHeader([u64::from_le_bytes(own), query.ticket]))
    }

    /// Sends the request once both endpoints are matched. Returns `None` until then.
    fn send(&mut self, context: &ReceiveContext<'_>, query: &TypeQuery) -> Option<()> {
        let peers = context.state.peers();
        let here =
            peers.connected(self.writer.guid()) > 0 && peers.connected(self.reader.guid()) > 0;
        drop(peers);
        if !here {
            return None;
        }
        let header = self.header(context, query);
        let question = Bytes::from(request(&query.type_name, &self.target.hash, header));
        // With it, Fast DDS waits for this reader before it answers. The sequence number is that of
        // the request, which it knows.
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

    /// Returns the answer or an error; `None` while there is neither.
    fn take(&mut self, context: &ReceiveContext<'_>) -> Option<Result<(Vec<u8>, Endian), String>> {
        let (sent, header) = self.sent?;
        self.reader.drain_read_notifications();
        for _ in 0..KEPT {
            let memory = CopyInto { sink: None, memory: context.memory, clock: context.clock };
            let change = match self.reader.try_take_one_with(memory) {
                Ok(None) => break,
                Ok(Some(change)) => change,
                // Any participant may write to this topic; this is not the answer.
                Err(_) => continue,
            };
            let (memory, endian) = (context.memory.borrow(), change.sample.endian);
            let own = match header {
                Some(header) => RequestHeader::split(&memory, endian)
                    .and_then(|(found, cdr)| (found == header).then_some(cdr)),
                None => change.related_sample_identity().and_then(|to| {
                    let guids = [self.reader.guid(), self.writer.guid()];
                    (to.sequence_number == sent && guids.contains(&to.writer_guid))
                        .then_some(memory.as_slice())
                }),
            };
            match own {
                // An answer to another client.
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

    fn close(mut self, context: &ReceiveContext<'_>) {
        drop(context.registry.deregister(&mut self.reader));
        let mut peers = context.state.peers();
        peers.forget(self.writer.guid());
        peers.forget(self.reader.guid());
    }
}

/// Creates the request writer and the answer reader of a service.
fn endpoints(
    participant: &DomainParticipant,
    service: &str,
) -> Result<(RawWriter, RawReader), CreateError> {
    let policies = QosPolicyBuilder::new()
        // This is the receive thread: it must not block.
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
    fn a_hash_is_found_among_other_user_data() {
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

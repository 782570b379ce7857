//! Publishes messages on a topic.

use bytes::Bytes;
use rustdds::dds::{CreateError, WriteError};
use rustdds::{DomainParticipant, Duration, GUID, QosPolicyBuilder, RTPSEntity, TopicKind, policy};

use std::sync::Arc;

use super::DdsError;
use super::names::{dds_topic, dds_type, visible};
use super::raw::RawWriter;
use super::receive::{ReceiverCommand, ReceiverHandle};
use super::state::ParticipantState;

/// Maximum time that a write waits for room in the history. The caller processes the next sample
/// after the write, and one stalled reader must not delay that.
const MAX_BLOCKING: Duration = Duration::ZERO;
/// Allowed number of samples that are kept for retransmission.
const DEPTH: std::ops::RangeInclusive<i32> = 1..=65_536;
/// Allowed number of samples that readers have not acknowledged: as many as are kept, but enough
/// for the time until an acknowledgement, and not more than RustDDS allows for one reader.
const UNACKNOWLEDGED: std::ops::RangeInclusive<i32> = 256..=8192;

pub struct TopicWriter {
    topic: String,
    writer: RawWriter,
    state: Arc<ParticipantState>,
    receiver: ReceiverHandle,
}

impl TopicWriter {
    pub(super) fn new(
        participant: &DomainParticipant,
        state: &Arc<ParticipantState>,
        receiver: &ReceiverHandle,
        topic: &str,
        type_name: &str,
        depth: usize,
    ) -> Result<Self, DdsError> {
        let name = |name: &str, what| DdsError::Name { name: visible(name), what };
        let dds_topic =
            dds_topic(topic).ok_or_else(|| name(topic, "the absolute name of a topic"))?;
        let dds_type = dds_type(type_name)
            .ok_or_else(|| name(type_name, "a message type, such as `std_msgs/msg/Empty`"))?;
        let depth = i32::try_from(depth).unwrap_or(i32::MAX);
        let depth = depth.clamp(*DEPTH.start(), *DEPTH.end());
        let window = depth.clamp(*UNACKNOWLEDGED.start(), *UNACKNOWLEDGED.end());
        let policies = QosPolicyBuilder::new()
            .reliability(policy::Reliability::Reliable { max_blocking_time: MAX_BLOCKING })
            .durability(policy::Durability::Volatile)
            .history(policy::History::KeepLast { depth })
            .build();
        // RustDDS keeps all that a reliable reader has not acknowledged, whatever the depth, up to
        // `max_samples`. Samples that were acknowledged stay for up to 6 s. Not for the topic: its
        // readers here would get the limit, too.
        let unacknowledged = policy::ResourceLimits {
            max_samples: window,
            max_instances: 1,
            max_samples_per_instance: window,
        };
        let writer_policies = QosPolicyBuilder::new().resource_limits(unacknowledged).build();
        let writer_policies = policies.modify_by(&writer_policies);
        // Locked until the matches of the writer are counted, so that none is missed.
        let mut peers = state.peers();
        let created = (|| {
            let topic =
                participant.create_topic(dds_topic, dds_type, &policies, TopicKind::NoKey)?;
            participant
                .create_publisher(&policies)?
                .create_datawriter_no_key(&topic, Some(writer_policies))
        })();
        let writer: RawWriter = created.map_err(|error: CreateError| DdsError::Advertise {
            topic: topic.to_owned(),
            source: error.into(),
        })?;
        peers.follow(writer.guid());
        drop(peers);
        receiver.send(ReceiverCommand::Writer(writer.guid()));
        Ok(Self {
            topic: topic.to_owned(),
            writer,
            state: state.clone(),
            receiver: receiver.clone(),
        })
    }

    /// Sends a message: little-endian CDR without its four bytes of encapsulation.
    ///
    /// # Errors
    ///
    /// [`DdsError::Write`] if DDS refuses the message, for example because a reader has not
    /// acknowledged as many earlier messages as are kept, or 256. The call does not wait for
    /// readers.
    pub fn write(&self, cdr: &[u8]) -> Result<(), DdsError> {
        let why = |error: WriteError<Bytes>| match error {
            WriteError::WouldBlock { .. } => "readers do not keep up".to_owned(),
            error => visible(&error.to_string()),
        };
        let sent = self.writer.write(Bytes::copy_from_slice(cdr), None);
        sent.map_err(|error| DdsError::Write { topic: self.topic.clone(), why: why(error) })
    }

    pub fn readers(&self) -> usize {
        self.state.peers().connected(self.guid())
    }

    fn guid(&self) -> GUID {
        self.writer.guid()
    }
}

impl Drop for TopicWriter {
    fn drop(&mut self) {
        self.state.peers().forget(self.guid());
        self.receiver.send(ReceiverCommand::WriterGone(self.guid()));
    }
}

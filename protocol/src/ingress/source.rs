//! Requests to a source of samples, and its state.

use serde::{Deserialize, Serialize};

use crate::counts::NetworkStatus;

/// The quality of service that a subscription requests. A replay delivers what it has.
#[derive(Copy, Clone, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Qos {
    /// The QoS that the writers offer.
    #[default]
    Auto,
    /// Exactly this QoS.
    Fixed {
        /// True if the subscription is reliable: writers send lost samples again.
        reliable: bool,
        /// Set if samples from before the subscription are requested, as far as writers keep them.
        transient_local: bool,
        /// Number of samples that DDS keeps until they are taken.
        depth: usize,
    },
}

/// State of a subscription.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct ReceptionStatus {
    /// Number of connected writers; `None` where there are none, as in a replay. A killed writer
    /// counts until its lease expires, with ROS 2 often after 10 to 20 s.
    pub writers: Option<usize>,
    /// Number of samples lost in transit, according to gaps in their sequence numbers; `None` if
    /// unknown.
    pub lost: Option<u64>,
    /// Number of samples that writers sent after the subscription and before they were matched with
    /// it, so that they were sent to others only; `None` if unknown. It is an estimate, by the
    /// interval of their samples, and at most the number of the first received one.
    #[serde(default)]
    pub before_match: Option<u64>,
    /// Number of samples that could not be parsed.
    pub malformed: u64,
    /// The requested QoS, as text: `reliable, volatile`.
    pub qos: Option<String>,
    /// Reasons why samples of writers are not received, in whole sentences, at most 16.
    pub qos_warnings: Vec<String>,
}

/// The state of a live source.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Health {
    /// State of the network below; `None` without one.
    pub network: Option<NetworkStatus>,
    /// The reason why the source, or one of its topics, delivers no further samples; `None` while
    /// it works.
    pub dead: Option<String>,
}

//! The signed data of a clip: who recorded what, when, and by which lambdas.

use gleaner_base::ByteSize;
use gleaner_lambda::manifest::{LambdaKind, LambdaName, Sha256, Version};
use serde::{Deserialize, Serialize};

use super::VehicleName;
use crate::payload::time;
use crate::{Payload, bounded};

/// Maximum number of lambdas of a clip; a recorder has no more.
const LAMBDAS_MAX: usize = 1024;
/// Maximum number of models of a lambda; a manifest has no more.
const MODELS_MAX: usize = gleaner_lambda::manifest::bounds::ITEMS_MAX;

/// The signed data of a clip.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClipStatement {
    #[serde(deserialize_with = "bounded::text")]
    pub vehicle: VehicleName,
    /// Name of the clip on the vehicle.
    pub clip: String,
    /// Time of signing, in seconds since 1970, by the clock of the vehicle.
    pub created: u64,
    /// The program that recorded it, with its version.
    pub recorder: String,
    /// SHA-256 of the file without the bytes that depend on the signature.
    #[serde(deserialize_with = "bounded::text")]
    pub sha256: Sha256,
    /// The clock of its times.
    pub clock: String,
    /// Begin of the requested time, in ns since the epoch of its clock.
    pub from_ns: i64,
    /// End of the requested time, inclusive.
    pub to_ns: i64,
    pub messages: u64,
    /// Number of its triggers and commands.
    pub triggers: u64,
    /// The lambdas whose windows it contains.
    #[serde(deserialize_with = "bounded::list::<_, _, LAMBDAS_MAX>")]
    pub lambdas: Vec<SignedLambda>,
    /// The journals in it, by the names of their attachments.
    #[serde(deserialize_with = "bounded::list::<_, _, LAMBDAS_MAX>")]
    pub journals: Vec<SignedFile>,
    pub losses: ClipLosses,
    /// True if its recorder died, and a later one recovered what was on the disk.
    pub recovered: bool,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SignedLambda {
    #[serde(deserialize_with = "bounded::text")]
    pub name: LambdaName,
    #[serde(deserialize_with = "bounded::text")]
    pub version: Version,
    pub kind: LambdaKind,
    /// SHA-256 over the files of its build, as `clips.jsonl` has it.
    #[serde(deserialize_with = "bounded::text")]
    pub digest: Sha256,
    /// The engine that ran it; `None` if unknown, as all below.
    pub engine: Option<String>,
    /// SHA-256 of the text `config` in its metadata record.
    #[serde(deserialize_with = "bounded::text_or_null")]
    pub config: Option<Sha256>,
    #[serde(deserialize_with = "bounded::list::<_, _, MODELS_MAX>")]
    pub models: Vec<SignedFile>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SignedFile {
    pub name: String,
    #[serde(deserialize_with = "bounded::text")]
    pub sha256: Sha256,
}

/// The data that a clip lacks: messages of all topics by cause; `None` if one topic's is unknown.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClipLosses {
    /// Messages lost before the recorder.
    pub lost: Option<u64>,
    /// Messages that the preroll evicted too early.
    pub overwritten: Option<u64>,
    /// Messages too large for the preroll.
    pub too_big: Option<u64>,
    /// Number of reasons why it is incomplete; `incomplete` in its metadata has them.
    pub reasons: u64,
}

impl Payload for ClipStatement {
    const NAME: &'static str = "statement of the clip";
    const TYPE: &'static str = "application/vnd.gleaner.clip.v1+json";
    // 256 lambdas, each with a model, take 150 KiB.
    const MAX: ByteSize = ByteSize::mib(4);

    fn check(&self) -> Result<(), String> {
        time(self.created)
    }
}

//! Signed data: what a release of a lambda consists of, what runs where, and which keys count.
//!
//! Fields that a type does not know are refused, and so are values and counts beyond their bounds.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use gleaner_base::{ByteSize, excerpt};
use gleaner_lambda::layout::{BUILD_MAX, FILE_MAX, FILES_MAX};
use gleaner_lambda::manifest::{
    ConfigValue, ItemName, LambdaKind, LambdaName, RelativePath, Sha256, TopicName, Version,
};
use serde::{Deserialize, Serialize};

use crate::{Payload, PublicKey, bounded};

/// Largest release counter: the largest whole number that every JSON parser reads exactly.
pub const COUNTER_MAX: u64 = (1 << 53) - 1;

/// Latest time of a payload, the end of the year 9999, in seconds since 1970.
const TIME_MAX: u64 = 253_402_300_799;
/// Maximum number of keys of a kind in a trust root, and of patterns of a key.
const KEYS_MAX: usize = 64;
/// Maximum number of labels, and of grants of a kind.
const LABELS_MAX: usize = 64;
/// Maximum number of config values; a manifest has no more.
const CONFIG_MAX: usize = gleaner_lambda::manifest::bounds::ITEMS_MAX;
/// Maximum length of a text in bytes.
const TEXT_MAX: usize = 4096;

/// Names and values that describe a vehicle, from its own configuration.
pub type Labels = BTreeMap<ItemName, String>;

/// A release of a lambda: every file of its build folder.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Revision {
    #[serde(deserialize_with = "bounded::text")]
    pub name: LambdaName,
    #[serde(deserialize_with = "bounded::text")]
    pub version: Version,
    pub kind: LambdaKind,
    /// Number of the release, 1 or more: it grows with each, and a vehicle accepts no lower one.
    pub release: u64,
    /// Time of signing, in seconds since 1970.
    pub created: u64,
    /// All files, sorted by path.
    #[serde(deserialize_with = "bounded::list::<_, _, FILES_MAX>")]
    pub files: Vec<RevisionFile>,
}

#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RevisionFile {
    /// Path in the build folder.
    #[serde(deserialize_with = "bounded::text")]
    pub path: RelativePath,
    pub bytes: u64,
    #[serde(deserialize_with = "bounded::text")]
    pub sha256: Sha256,
}

impl Payload for Revision {
    const NAME: &'static str = "revision";
    const TYPE: &'static str = "application/vnd.gleaner.revision.v1+json";
    // 4,000 files with paths of 255 bytes take 2 MiB.
    const MAX: ByteSize = ByteSize::mib(4);

    fn check(&self) -> Result<(), String> {
        counter(self.release)?;
        time(self.created)?;
        if !self.files.is_sorted_by(|a, b| a.path.as_str() < b.path.as_str()) {
            return Err("its files are not sorted by path, or a path appears twice".to_owned());
        }
        if let Some(file) = self.files.iter().find(|file| file.bytes > FILE_MAX.bytes()) {
            return Err(format!("`{}` has more than {FILE_MAX}", file.path));
        }
        // At most 4,000 files of 2 GiB: the sum cannot overflow.
        match self.files.iter().map(|file| file.bytes).sum::<u64>() <= BUILD_MAX.bytes() {
            true => Ok(()),
            false => Err(format!("its files have more than {BUILD_MAX}")),
        }
    }
}

/// The wish to run a revision on vehicles.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Deployment {
    #[serde(deserialize_with = "bounded::text")]
    pub id: ItemName,
    /// Number of its release, as of a revision.
    pub release: u64,
    /// Labels that a vehicle must have; without any, it is for all vehicles.
    #[serde(deserialize_with = "bounded::map::<_, _, _, LABELS_MAX>")]
    pub selector: Labels,
    #[serde(deserialize_with = "bounded::text")]
    pub revision: Sha256,
    /// Digest of the revision that runs if the first one fails; it may have a lower counter.
    #[serde(deserialize_with = "bounded::text_or_null")]
    pub fallback: Option<Sha256>,
    #[serde(deserialize_with = "bounded::map::<_, _, _, CONFIG_MAX>")]
    pub config: BTreeMap<ItemName, ConfigValue>,
    pub grants: Grants,
    /// Time of signing, in seconds since 1970.
    pub created: u64,
    /// Time from which it is not accepted for the first time any more, in seconds since 1970.
    pub expires: u64,
}

#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grants {
    /// Topics that it may read.
    #[serde(deserialize_with = "bounded::texts::<_, _, LABELS_MAX>")]
    pub topics: Vec<TopicName>,
    /// Models that it may run.
    #[serde(deserialize_with = "bounded::texts::<_, _, LABELS_MAX>")]
    pub models: Vec<ItemName>,
    /// Permission to record clips.
    pub record: bool,
}

impl Payload for Deployment {
    const NAME: &'static str = "deployment";
    const TYPE: &'static str = "application/vnd.gleaner.deployment.v1+json";
    const MAX: ByteSize = ByteSize::mib(1);

    fn check(&self) -> Result<(), String> {
        counter(self.release)?;
        time(self.created)?;
        time(self.expires)?;
        labels(&self.selector)?;
        let long =
            |value: &ConfigValue| matches!(value, ConfigValue::Text(text) if text.len() > TEXT_MAX);
        match self.config.iter().find(|(_, value)| long(value)) {
            Some((name, _)) => Err(format!("config `{name}` has more than {TEXT_MAX} bytes")),
            None => Ok(()),
        }
    }
}

/// The keys that a vehicle accepts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrustRoot {
    /// Number of this root; the next one has the next number.
    pub version: u64,
    /// Time of signing, in seconds since 1970.
    pub created: u64,
    /// Time from which nothing is accepted for the first time by it, in seconds since 1970.
    pub expires: u64,
    /// Keys that sign trust roots.
    pub root: RootKeys,
    /// Keys that sign revisions.
    #[serde(deserialize_with = "bounded::list::<_, _, KEYS_MAX>")]
    pub publishers: Vec<ScopedKey>,
    /// Keys that sign deployments.
    #[serde(deserialize_with = "bounded::list::<_, _, KEYS_MAX>")]
    pub deployers: Vec<ScopedKey>,
}

/// Keys that sign trust roots.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RootKeys {
    /// Number of these keys that must sign.
    pub threshold: usize,
    #[serde(deserialize_with = "bounded::list::<_, _, KEYS_MAX>")]
    pub keys: Vec<PublicKey>,
}

/// A key of a publisher or deployer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScopedKey {
    pub key: PublicKey,
    /// Lambdas that it may sign.
    #[serde(deserialize_with = "bounded::texts::<_, _, KEYS_MAX>")]
    pub lambdas: Vec<LambdaPattern>,
    /// Labels of the vehicles on which it counts; without any, on all.
    #[serde(deserialize_with = "bounded::map::<_, _, _, LABELS_MAX>")]
    pub labels: Labels,
}

impl Payload for TrustRoot {
    const NAME: &'static str = "trust root";
    const TYPE: &'static str = "application/vnd.gleaner.trust-root.v1+json";
    const MAX: ByteSize = ByteSize::mib(1);

    fn check(&self) -> Result<(), String> {
        counter(self.version)?;
        time(self.created)?;
        time(self.expires)?;
        let RootKeys { threshold, keys } = &self.root;
        // An envelope has no room for more signatures.
        let most = keys.len().min(crate::envelope::SIGNATURES_MAX);
        if !(1..=most).contains(threshold) {
            return Err(format!("its threshold is {threshold}, with {} root keys", keys.len()));
        }
        unique(keys.iter())?;
        for scoped in [&self.publishers, &self.deployers] {
            unique(scoped.iter().map(|scoped| &scoped.key))?;
            scoped.iter().try_for_each(|scoped| labels(&scoped.labels))?;
        }
        Ok(())
    }
}

/// The name of a lambda, or the start of names and `*`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct LambdaPattern(String);

impl LambdaPattern {
    pub fn covers(&self, name: &str) -> bool {
        match self.0.strip_suffix('*') {
            Some(start) => name.starts_with(start),
            None => name == self.0,
        }
    }
}

impl FromStr for LambdaPattern {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let start = text.strip_suffix('*');
        // With a letter added, the start of a name is a name.
        let name = start.map_or(text.to_owned(), |start| format!("{start}x"));
        match name.parse::<LambdaName>() {
            Ok(_) => Ok(Self(text.to_owned())),
            Err(_) => Err(format!("`{}` is not a pattern such as `brake-*`", excerpt(text))),
        }
    }
}

impl fmt::Display for LambdaPattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

fn counter(release: u64) -> Result<(), String> {
    match (1..=COUNTER_MAX).contains(&release) {
        true => Ok(()),
        false => Err(format!("its counter is {release}; it is 1 to {COUNTER_MAX}")),
    }
}

pub(crate) fn time(seconds: u64) -> Result<(), String> {
    match seconds <= TIME_MAX {
        true => Ok(()),
        false => Err(format!("{seconds} s since 1970 is after the year 9999")),
    }
}

fn labels(labels: &Labels) -> Result<(), String> {
    match labels.iter().find(|(_, value)| value.len() > 128 || value.contains(char::is_control)) {
        Some((name, _)) => Err(format!("label `{name}` is too long, or has control characters")),
        None => Ok(()),
    }
}

/// Refuses a key that appears twice: alone it would reach a threshold, or have two scopes.
fn unique<'k>(keys: impl Iterator<Item = &'k PublicKey>) -> Result<(), String> {
    let mut seen = std::collections::BTreeSet::new();
    match keys.map(PublicKey::id).find(|id| !seen.insert(id.clone())) {
        Some(id) => Err(format!("key {id} appears twice")),
        None => Ok(()),
    }
}

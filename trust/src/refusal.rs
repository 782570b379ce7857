//! The reasons why a vehicle does not accept signed data.

use gleaner_base::{ByteSize, Exit, Explain, UtcTime};
use gleaner_lambda::manifest::{ItemName, LambdaName, Sha256};

use crate::{Payload, TrustRoot};

/// The reason why signed data is refused. Times are in seconds since 1970.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Refusal {
    #[error("the {what} has {bytes} bytes; at most {most} are read")]
    TooLarge { what: &'static str, bytes: u64, most: ByteSize },
    #[error("the {what} is malformed: {reason}")]
    Malformed { what: &'static str, reason: String },
    #[error("the payload is of type `{found}`, not `{expected}`")]
    WrongType { expected: &'static str, found: String },
    #[error("the {what} is signed by {}, none of the {trusted} trusted keys", keys(found))]
    UnknownKey { what: &'static str, found: Vec<String>, trusted: usize },
    #[error("the {what} does not match its signature by key {key}")]
    WrongSignature { what: &'static str, key: Sha256 },
    #[error("key {key} may sign lambdas {allowed}, and this is lambda `{lambda}`")]
    Scope { key: Sha256, allowed: String, lambda: LambdaName },
    #[error("key {key} may sign lambdas {allowed}, and this is deployment `{id}`")]
    ScopeId { key: Sha256, allowed: String, id: ItemName },
    #[error("key {key} is valid on vehicles with `{label}` = `{wanted}`; here it is {}", or(found))]
    ScopeLabel { key: Sha256, label: String, wanted: String, found: Option<String> },
    #[error("the deployment is for vehicles with `{label}` = `{wanted}`; here it is {}", or(found))]
    NotSelected { label: String, wanted: String, found: Option<String> },
    #[error("trust root {version} has {valid} signatures of {by}; {needed} are needed")]
    Threshold { version: u64, by: &'static str, valid: usize, needed: usize },
    #[error("trust root {found} does not follow trust root {current}")]
    Sequence { current: u64, found: u64 },
    #[error("{what} has release {found}; release {floor} was accepted before")]
    RolledBack { what: String, found: u64, floor: u64 },
    #[error("the trust root has version {found}; version {floor} was accepted before")]
    OldRoot { found: u64, floor: u64 },
    #[error("{what} was accepted before with release {release} as {accepted}; this is {found}")]
    SameRelease { what: String, release: u64, accepted: Sha256, found: Sha256 },
    #[error("the {what} expired at {}; the trusted time is {}", date(*expires), date(*now))]
    Expired { what: &'static str, expires: u64, now: u64 },
    #[error("the deployment names {role} {wanted}; this is {}", or(found))]
    OtherRevision { role: &'static str, wanted: String, found: Option<Sha256> },
    #[error("the revision is of lambda `{revision}`, and its fallback of `{fallback}`")]
    OtherLambda { revision: LambdaName, fallback: LambdaName },
    #[error("the fallback has release {fallback}, its revision {revision}; it must be older")]
    NewerFallback { fallback: u64, revision: u64 },
    #[error(
        "the fallback has release {fallback} and never ran here; release {floor} was accepted before"
    )]
    UnknownFallback { fallback: u64, floor: u64 },
    #[error("`{path}` of the revision is missing")]
    MissingFile { path: String },
    #[error("`{path}` is not in the revision")]
    ExtraFile { path: String },
    #[error("`{path}` has {found} bytes; in the revision it has {signed}")]
    Length { path: String, signed: u64, found: u64 },
    #[error("`{path}` has the digest {found}; in the revision it has {signed}")]
    Digest { path: String, signed: Sha256, found: Sha256 },
    #[error("lambda.toml has the {what} `{found}`; the revision has `{signed}`")]
    OtherManifest { what: &'static str, signed: String, found: String },
    #[error("{count} names have release counters; no more are kept")]
    TooManyFloors { count: usize },
}

impl Explain for Refusal {
    fn help(&self) -> Option<String> {
        let help = match self {
            Self::TooLarge { .. } | Self::Malformed { .. } => {
                "transfer the file again, or sign it again with this version of gleaner"
            }
            Self::WrongType { .. } | Self::OtherRevision { .. } | Self::OtherLambda { .. } => {
                "name the file that belongs here"
            }
            Self::UnknownKey { what: TrustRoot::NAME, .. } => {
                "a trust root needs signatures by the keys of the current one: add them, or \
                 install the roots between, in their order"
            }
            Self::UnknownKey { .. } => {
                "sign it with a key of the trust root, or install the trust root that has the key"
            }
            Self::WrongSignature { .. } => {
                "it was changed after it was signed: transfer it again from a trusted source"
            }
            Self::ScopeId { .. } => {
                "use the name of the lambda as the id, or a key whose scope covers the id"
            }
            Self::Scope { .. } | Self::ScopeLabel { .. } => {
                "sign it with a key of this scope, or widen the scope in the next trust root"
            }
            Self::NotSelected { .. } => {
                "change the selector of the deployment, or the labels of the vehicle"
            }
            Self::Threshold { .. } => {
                "a trust root needs signatures by the keys of the current one and by its own"
            }
            Self::Sequence { .. } => "install every trust root in its order, none skipped",
            Self::OldRoot { .. } => {
                "install the newest trust root; an older one is never accepted again"
            }
            Self::RolledBack { .. } | Self::SameRelease { .. } => {
                "sign it again with a higher release"
            }
            Self::NewerFallback { .. } => {
                "sign the deployment again, with an older release as the fallback or without one"
            }
            Self::UnknownFallback { .. } => {
                "sign the deployment again with a fallback that ran on the vehicle, or without one"
            }
            Self::Expired { what: TrustRoot::NAME, .. } => {
                "install the next trust root; if the vehicle's clock is ahead, set it"
            }
            Self::Expired { .. } => {
                "sign it again with a later end; if the vehicle's clock is ahead, set it. The trusted \
                 time stays at the latest that the clock has shown, within a year"
            }
            Self::MissingFile { .. }
            | Self::ExtraFile { .. }
            | Self::Length { .. }
            | Self::Digest { .. } => "restore the published files, or publish the build again",
            Self::OtherManifest { .. } => "publish the build again",
            Self::TooManyFloors { .. } => "deploy under a name that was used before",
        };
        Some(help.to_owned())
    }

    fn exit(&self) -> Exit {
        Exit::Denied
    }
}

fn date(seconds: u64) -> UtcTime {
    UtcTime::of(i64::try_from(seconds).unwrap_or(i64::MAX))
}

fn keys(found: &[String]) -> String {
    if found.is_empty() { "no key".to_owned() } else { found.join(", ") }
}

fn or(found: &Option<impl AsRef<str>>) -> String {
    found.as_ref().map_or("nothing".to_owned(), |text| format!("`{}`", text.as_ref()))
}

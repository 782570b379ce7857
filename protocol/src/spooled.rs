//! The records that `gleaner-shim` keeps in the spool of a lambda: starts and ends of its
//! processes, decisions, log lines, summaries and losses.
//!
//! A record is its kind, a number, and a payload: JSON.

use std::num::NonZeroU8;
use std::str::FromStr;

use serde::{Deserialize, Serialize};

use gleaner_lambda::{Decision, LogLine};

use crate::{ExitRecord, LiveStatus};

/// Maximum length of a text of [`ProcessOrigin`], in bytes. A digest has 64.
const ORIGIN_TEXT_MAX: usize = 128;

/// Maximum length of a payload that is parsed, in bytes: that of a spool.
const PAYLOAD_MAX: usize = 1 << 20;

/// A record in the spool of a lambda.
///
/// As JSON, it has the keys `kind` and `record`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", content = "record", rename_all = "snake_case")]
pub enum SpooledRecord {
    /// A process of the lambda is about to start. The records up to the next one belong to it.
    Started(ProcessStart),
    /// A decision.
    Decision(Box<Decision>),
    /// A log line.
    Log(LogLine),
    /// The summary of a process that ended as requested.
    Summary(Box<LiveStatus>),
    /// The last record of a process. It is missing if `gleaner-shim` was killed.
    Ended(ExitRecord),
    /// Counts of lost items, whenever there are more of them.
    Lost(ItemLosses),
    /// A record that was too long to be kept.
    Omitted(OmittedRecord),
}

/// Identifies one start of a lambda's process; its parent assigns it.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ProcessOrigin {
    /// Id of the deployment.
    pub lambda: String,
    /// Digest of the revision.
    pub revision: String,
    /// Generation of the deployment.
    pub generation: u64,
    /// Number of earlier processes of this generation.
    pub start: u32,
}

/// The start of a process of a lambda.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct ProcessStart {
    /// Id of the deployment.
    pub lambda: String,
    /// Digest of the revision.
    pub revision: String,
    /// Generation of the deployment.
    pub generation: u64,
    /// Number of earlier processes of this generation.
    pub start: u32,
    /// Process id of `gleaner-shim`, the parent of the runtime. The record is durable before the
    /// runtime exists; the process id of the runtime is in [`ExitRecord`].
    pub pid: u32,
    /// Version of `gleaner-shim`.
    pub software: String,
}

/// Numbers of items of a process that are not in the spool, since its start.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ItemLosses {
    /// Lines from the process that were not valid items.
    pub invalid: u64,
    /// Items that the spool refused, as it could not write. Gap records have their sequence
    /// numbers.
    pub refused: u64,
    /// Items that were too long, each with an [`OmittedRecord`] in its place.
    pub too_long: u64,
}

/// A record that was longer than a record of its spool may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct OmittedRecord {
    /// Kind of the record, as a number.
    pub kind: u8,
    /// Time of the wake, of a decision or a log line, in ns.
    pub at_ns: Option<i64>,
    /// Number of triggers, of a decision.
    pub triggers: usize,
    /// Length of its payload, in bytes.
    pub bytes: usize,
    /// Maximum length of a payload, in bytes.
    pub allowed: usize,
}

/// The reason why a payload is not a [`SpooledRecord`]. A reader counts it, and continues.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum SpooledRecordError {
    /// The kind is that of another version, or of another stream.
    #[error("kind {kind} of a record is unknown")]
    Kind { kind: u8 },
    #[error("a record of kind {kind} has {bytes} bytes, above the maximum of {PAYLOAD_MAX}")]
    TooLong { kind: u8, bytes: usize },
    /// The payload is not the JSON of its kind.
    #[error("a record of kind {kind} is invalid")]
    Payload { kind: u8, source: serde_json::Error },
}

/// The reason why a text is not a [`ProcessOrigin`].
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs)]
pub enum OriginError {
    /// It is not JSON with exactly the keys of an origin.
    #[error("{0}")]
    Json(#[from] serde_json::Error),
    #[error("`{key}` must have 1 to {ORIGIN_TEXT_MAX} bytes without control characters")]
    Text { key: &'static str },
}

impl SpooledRecord {
    /// Returns the number that states the kind in a spool. A number never changes its meaning.
    pub fn kind(&self) -> NonZeroU8 {
        let kind = match self {
            Self::Started(_) => 1,
            Self::Decision(_) => 2,
            Self::Log(_) => 3,
            Self::Summary(_) => 4,
            Self::Ended(_) => 5,
            Self::Lost(_) => 6,
            Self::Omitted(_) => 7,
        };
        NonZeroU8::new(kind).expect("no kind is 0")
    }

    /// Returns the payload.
    pub fn to_payload(&self) -> Vec<u8> {
        let payload = match self {
            Self::Started(start) => serde_json::to_vec(start),
            Self::Decision(decision) => serde_json::to_vec(decision),
            Self::Log(line) => serde_json::to_vec(line),
            Self::Summary(status) => serde_json::to_vec(status),
            Self::Ended(record) => serde_json::to_vec(record),
            Self::Lost(losses) => serde_json::to_vec(losses),
            Self::Omitted(omitted) => serde_json::to_vec(omitted),
        };
        payload.expect("a record is plain data")
    }

    /// Parses a payload, of which nothing is trusted.
    ///
    /// # Errors
    ///
    /// [`SpooledRecordError`] for an unknown kind, and for a payload that is too long or not of its
    /// kind.
    pub fn parse(kind: NonZeroU8, payload: &[u8]) -> Result<Self, SpooledRecordError> {
        let kind = kind.get();
        if payload.len() > PAYLOAD_MAX {
            return Err(SpooledRecordError::TooLong { kind, bytes: payload.len() });
        }
        let parsed = match kind {
            1 => serde_json::from_slice(payload).map(Self::Started),
            2 => serde_json::from_slice(payload).map(Self::Decision),
            3 => serde_json::from_slice(payload).map(Self::Log),
            4 => serde_json::from_slice(payload).map(Self::Summary),
            5 => serde_json::from_slice(payload).map(Self::Ended),
            6 => serde_json::from_slice(payload).map(Self::Lost),
            7 => serde_json::from_slice(payload).map(Self::Omitted),
            _ => return Err(SpooledRecordError::Kind { kind }),
        };
        parsed.map_err(|source| SpooledRecordError::Payload { kind, source })
    }

    /// Returns what remains of this record if its payload, of `bytes`, is longer than `allowed`.
    pub fn omitted(&self, bytes: usize, allowed: usize) -> OmittedRecord {
        let (at_ns, triggers) = match self {
            Self::Decision(decision) => (Some(decision.at_ns), decision.triggers.len()),
            Self::Log(line) => (Some(line.at_ns), 0),
            _ => (None, 0),
        };
        OmittedRecord { kind: self.kind().get(), at_ns, triggers, bytes, allowed }
    }
}

impl ItemLosses {
    /// Returns the sum.
    pub fn total(&self) -> u64 {
        self.invalid.saturating_add(self.refused).saturating_add(self.too_long)
    }
}

impl ProcessOrigin {
    /// Returns the start of a process with this origin, whose `gleaner-shim` is process `pid`.
    pub fn started(&self, pid: u32) -> ProcessStart {
        ProcessStart {
            lambda: self.lambda.clone(),
            revision: self.revision.clone(),
            generation: self.generation,
            start: self.start,
            pid,
            software: gleaner_base::version().to_owned(),
        }
    }
}

impl FromStr for ProcessOrigin {
    type Err = OriginError;

    fn from_str(text: &str) -> Result<Self, OriginError> {
        let origin: Self = serde_json::from_str(text)?;
        for (key, text) in [("lambda", &origin.lambda), ("revision", &origin.revision)] {
            let fits = (1..=ORIGIN_TEXT_MAX).contains(&text.len());
            if !fits || text.contains(char::is_control) {
                return Err(OriginError::Text { key });
            }
        }
        Ok(origin)
    }
}

#[cfg(test)]
mod tests {
    use gleaner_lambda::{Cause, LogLevel};
    use serde_json::json;

    use super::*;
    use crate::WokenBy;

    fn origin() -> ProcessOrigin {
        let text = r#"{"lambda":"brake","revision":"0a1b","generation":3,"start":7}"#;
        text.parse().unwrap()
    }

    fn decision() -> Decision {
        let by = WokenBy { cause: Cause::Tick, input: None, topic: None };
        let fault = serde_json::from_value(json!({"kind": "trap", "message": "m"})).unwrap();
        by.faulted(5, 6, fault)
    }

    fn records() -> Vec<SpooledRecord> {
        let exit = json!({"pid": 1, "started_ns": 2, "ended_ns": 3, "code": 0, "signal": null,
            "killed": null, "out_of_memory": false, "max_rss_bytes": 4, "cpu_ns": 5, "orphans": 0});
        let log = LogLine { at_ns: 8, level: LogLevel::Warn, message: "\u{1b}\n\"".to_owned() };
        vec![
            SpooledRecord::Started(origin().started(17)),
            SpooledRecord::Decision(Box::new(decision())),
            SpooledRecord::Log(log.clone()),
            SpooledRecord::Ended(serde_json::from_value(exit).unwrap()),
            SpooledRecord::Lost(ItemLosses { invalid: 1, refused: 2, too_long: 3 }),
            SpooledRecord::Omitted(SpooledRecord::Log(log).omitted(5000, 2048)),
        ]
    }

    #[test]
    fn a_record_is_parsed_from_its_payload_and_no_other_kind_is() {
        for record in records() {
            let (kind, payload) = (record.kind(), record.to_payload());
            assert_eq!(SpooledRecord::parse(kind, &payload).unwrap(), record);
            for other in (1..=7).filter_map(NonZeroU8::new).filter(|other| *other != kind) {
                assert!(SpooledRecord::parse(other, &payload).is_err(), "{record:?} as {other}");
            }
        }
    }

    #[test]
    fn unknown_kinds_and_invalid_payloads_are_errors_that_name_the_kind() {
        let parse = |kind: u8, payload: &[u8]| {
            SpooledRecord::parse(NonZeroU8::new(kind).unwrap(), payload).unwrap_err().to_string()
        };
        assert_eq!(parse(200, b"{}"), "kind 200 of a record is unknown");
        assert_eq!(parse(3, b"\xff"), "a record of kind 3 is invalid");
        assert_eq!(parse(3, &b"[".repeat(1 << 20)), "a record of kind 3 is invalid");
        assert!(parse(3, &vec![b' '; (1 << 20) + 1]).contains("above the maximum"));
    }

    #[test]
    fn an_origin_has_exactly_its_keys_and_short_texts() {
        assert_eq!((origin().lambda.as_str(), origin().start), ("brake", 7));
        let refused = |change: fn(&mut serde_json::Value)| {
            let mut json = serde_json::to_value(origin()).unwrap();
            change(&mut json);
            json.to_string().parse::<ProcessOrigin>().unwrap_err().to_string()
        };
        assert!(refused(|json| json["more"] = json!(1)).contains("unknown field `more`"));
        assert!(refused(|json| json["start"] = json!(-1)).contains("-1"));
        assert!(refused(|json| json["lambda"] = json!("")).contains("`lambda` must have 1 to 128"));
        assert!(refused(|json| json["revision"] = json!("\n")).contains("`revision`"));
        assert!(refused(|json| json["revision"] = json!("x".repeat(129))).contains("`revision`"));
    }
}

//! Decodes the wakes of a journal.

use serde_json::{Map, Value};

use crate::entry::{InputView, JournalEntry, LogDigest, WakeSource};
use crate::number::{NUMBER_MAX, take, unfold};
use crate::previous::{
    FAULT_ALLOWED, FAULT_USED, PreviousInput, PreviousWake, TRIGGER_SCORE, flag, newest, seen,
};
use crate::{ATTRIBUTES_MAX, FAULTS, TRIGGERS_MAX};
use gleaner_lambda::{Fault, Trigger, TriggerKind};

/// The reason why bytes cannot be decoded as a wake.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum MalformedWake {
    #[error("a wake continues beyond the end of its block")]
    Short,
    /// A number is longer than 64 bits, or out of range.
    #[error("a number in a wake is too large")]
    Number,
    #[error("a wake has the unknown {what} {value}")]
    Unknown { what: &'static str, value: u8 },
    #[error("a text in a wake is not UTF-8")]
    Text,
    #[error("the score of a trigger is not finite")]
    Score,
    #[error("a wake has {found} triggers, above the maximum of {TRIGGERS_MAX}")]
    Triggers { found: u64 },
    #[error("a trigger has {found} bytes of attributes, above the maximum of {ATTRIBUTES_MAX}")]
    LongAttributes {
        /// The length of the attributes as JSON, in bytes.
        found: u64,
    },
    #[error("the attributes of a trigger are not a JSON object")]
    Attributes,
}

type Result<T> = std::result::Result<T, MalformedWake>;

/// Decodes the output of an [`Encoder`](crate::Encoder). Its input is untrusted: no memory is
/// allocated for a count before the counted bytes are known to exist.
pub struct Decoder {
    previous: PreviousWake,
}

impl Decoder {
    pub fn new(inputs: usize) -> Decoder {
        Decoder { previous: PreviousWake::none(inputs) }
    }

    /// Forgets the previous wake: the next one begins a block, and is encoded without reference to
    /// it.
    pub fn reset(&mut self) {
        self.previous.reset();
    }

    /// Decodes the wake at the start of `bytes`, and removes it.
    ///
    /// # Errors
    ///
    /// [`MalformedWake`]. Then neither the rest of `bytes` can be decoded, nor any wake that is
    /// encoded relative to this one.
    pub fn decode(&mut self, bytes: &mut &[u8]) -> Result<JournalEntry> {
        let previous = &self.previous;
        let [flags] = array(bytes)?;
        if flags & flag::RESERVED != 0 {
            return Err(MalformedWake::Unknown { what: "flags", value: flags });
        }
        let at_ns = difference(bytes, previous.expected_at_ns() as u64)? as i64;
        let cause = cause(flags, previous, bytes)?;
        let fuel = optional(flags & flag::FUEL, || difference(bytes, previous.fuel))?;
        // Each input is encoded in at least one byte: checked before memory is allocated for them.
        if bytes.len() < previous.inputs.len() {
            return Err(MalformedWake::Short);
        }
        let seen =
            previous.inputs.iter().map(|previous| input(previous, bytes)).collect::<Result<_>>()?;
        let triggers = if flags & flag::TRIGGERS != 0 { triggers(bytes)? } else { Vec::new() };
        let fault = optional(flags & flag::FAULT, || fault(bytes))?;
        let log = if flags & flag::LOG != 0 { log_digest(bytes)? } else { LogDigest::default() };
        let entry = JournalEntry { at_ns, cause, seen, triggers, fault, fuel, log };
        self.previous.update(&entry);
        Ok(entry)
    }
}

/// Takes a value whose presence `bit` states.
fn optional<T>(bit: u8, take: impl FnOnce() -> Result<T>) -> Result<Option<T>> {
    (bit != 0).then(take).transpose()
}

/// Removes and returns `N` bytes.
fn array<const N: usize>(bytes: &mut &[u8]) -> Result<[u8; N]> {
    let (array, rest) = bytes.split_first_chunk().ok_or(MalformedWake::Short)?;
    *bytes = rest;
    Ok(*array)
}

/// Removes and returns a number.
fn number(bytes: &mut &[u8]) -> Result<u64> {
    let ends = bytes.iter().take(NUMBER_MAX).any(|byte| byte & 0x80 == 0);
    let short = !ends && bytes.len() < NUMBER_MAX;
    take(bytes).ok_or(if short { MalformedWake::Short } else { MalformedWake::Number })
}

/// Removes a difference from `expected`, and returns the value.
fn difference(bytes: &mut &[u8], expected: u64) -> Result<u64> {
    number(bytes).map(|folded| expected.wrapping_add(unfold(folded)))
}

/// Removes and returns `len` bytes.
fn slice<'b>(bytes: &mut &'b [u8], len: u64) -> Result<&'b [u8]> {
    let len = usize::try_from(len).map_err(|_| MalformedWake::Short)?;
    let (slice, rest) = bytes.split_at_checked(len).ok_or(MalformedWake::Short)?;
    *bytes = rest;
    Ok(slice)
}

fn text(bytes: &mut &[u8]) -> Result<String> {
    let len = number(bytes)?;
    let text = std::str::from_utf8(slice(bytes, len)?).map_err(|_| MalformedWake::Text)?;
    Ok(text.to_owned())
}

fn cause(flags: u8, previous: &PreviousWake, bytes: &mut &[u8]) -> Result<WakeSource> {
    let (writer_follows, number_follows) = (flags & flag::WRITER != 0, flags & flag::NUMBER != 0);
    if flags & flag::TICK != 0 {
        if writer_follows {
            return Err(MalformedWake::Unknown { what: "flags", value: flags });
        }
        return Ok(WakeSource::Tick { missed: if number_follows { number(bytes)? } else { 0 } });
    }
    let writer = if writer_follows { array(bytes)? } else { previous.woken_by.0 };
    let expected = previous.expected_seq(!writer_follows);
    Ok(WakeSource::Sample {
        writer,
        seq: if number_follows { difference(bytes, expected)? } else { expected },
    })
}

fn input(previous: &PreviousInput, bytes: &mut &[u8]) -> Result<InputView> {
    let [bits] = array(bytes)?;
    let mut new = u64::from(bits & seen::NEW);
    if bits & seen::NEW == seen::NEW {
        new = new.checked_add(number(bytes)?).ok_or(MalformedWake::Number)?;
    }
    let digest = if bits & seen::DIGEST != 0 { u32::from_le_bytes(array(bytes)?) } else { 0 };
    let expected = previous.expected_newest(new);
    let newest = match bits & seen::NEWEST != 0 {
        false => expected,
        true => match (array(bytes)?, expected) {
            ([newest::NONE], _) => None,
            ([newest::SAME_WRITER], Some((writer, expected))) => {
                Some((writer, difference(bytes, expected)?))
            }
            ([newest::OTHER_WRITER], _) => Some((array(bytes)?, number(bytes)?)),
            ([value], _) => {
                return Err(MalformedWake::Unknown { what: "form of a newest sample", value });
            }
        },
    };
    let reach = if bits & seen::REACH != 0 { number(bytes)? } else { previous.reach };
    Ok(InputView { new, digest, newest, reach })
}

fn triggers(bytes: &mut &[u8]) -> Result<Vec<Trigger>> {
    let found = number(bytes)?;
    if found > TRIGGERS_MAX as u64 {
        return Err(MalformedWake::Triggers { found });
    }
    (0..found).map(|_| trigger(bytes)).collect()
}

fn trigger(bytes: &mut &[u8]) -> Result<Trigger> {
    let [first] = array(bytes)?;
    let kind = match first & !TRIGGER_SCORE {
        0 => TriggerKind::Event,
        1 => TriggerKind::Start,
        2 => TriggerKind::Stop,
        _ => return Err(MalformedWake::Unknown { what: "kind of trigger", value: first }),
    };
    let label = text(bytes)?;
    let score = optional(first & TRIGGER_SCORE, || array(bytes).map(f64::from_le_bytes))?;
    if score.is_some_and(|score| !score.is_finite()) {
        return Err(MalformedWake::Score);
    }
    Ok(Trigger { kind, label, score, attributes: attributes(bytes)? })
}

fn attributes(bytes: &mut &[u8]) -> Result<Map<String, Value>> {
    match number(bytes)? {
        0 => Ok(Map::new()),
        found if found > ATTRIBUTES_MAX as u64 => Err(MalformedWake::LongAttributes { found }),
        len => serde_json::from_slice(slice(bytes, len)?).map_err(|_| MalformedWake::Attributes),
    }
}

fn fault(bytes: &mut &[u8]) -> Result<Fault> {
    let [first] = array(bytes)?;
    let known = FAULTS.get(usize::from(first & !(FAULT_USED | FAULT_ALLOWED)));
    let Some((kind, _)) = known else {
        return Err(MalformedWake::Unknown { what: "kind of fault", value: first });
    };
    let message = text(bytes)?;
    let used = optional(first & FAULT_USED, || number(bytes))?;
    let allowed = optional(first & FAULT_ALLOWED, || number(bytes))?;
    Ok(Fault { kind: *kind, message, used, allowed })
}

fn log_digest(bytes: &mut &[u8]) -> Result<LogDigest> {
    let lines = u32::try_from(number(bytes)?).map_err(|_| MalformedWake::Number)?;
    Ok(LogDigest { lines, digest: u32::from_le_bytes(array(bytes)?) })
}

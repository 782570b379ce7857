use serde_json::{Map, Value};

use super::entry::{InputView, JournalEntry, LogDigest, WakeSource};
use super::number::{take, unfold};
use super::previous::{
    Before, FAULT_ALLOWED, FAULT_USED, InputBefore, TRIGGER_SCORE, flag, newest, seen,
};
use super::{ATTRIBUTES_MAX, FAULTS, TRIGGERS_MAX};
use gleaner_lambda::{Fault, Trigger, TriggerKind};

/// Why some bytes are no wake.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum Malformed {
    /// They end within a wake.
    #[error("a wake goes on beyond its block")]
    Short,
    /// A number is longer than 64 bits, or than what it counts.
    #[error("a number in a wake is too large")]
    Number,
    /// A bit is set, or a kind is used, that has no meaning.
    #[error("a wake has the unknown {what} {value}")]
    Unknown {
        /// What it should be.
        what: &'static str,
        /// What it is.
        value: u8,
    },
    /// A text is no UTF-8.
    #[error("a text in a wake is no UTF-8")]
    Text,
    /// A score is infinite or not a number.
    #[error("the score of a trigger is not finite")]
    Score,
    /// A wake has more triggers than any lambda may cause.
    #[error("a wake has {found} triggers, above the maximum of {TRIGGERS_MAX}")]
    Triggers {
        /// How many.
        found: u64,
    },
    /// Attributes are longer than any lambda may give.
    #[error("a trigger has {found} bytes of attributes, above the maximum of {ATTRIBUTES_MAX}")]
    LongAttributes {
        /// How many bytes.
        found: u64,
    },
    /// Attributes are no JSON object.
    #[error("the attributes of a trigger are no JSON object")]
    Attributes,
}

type Result<T> = std::result::Result<T, Malformed>;

/// Reads what an [`Encoder`](super::Encoder) wrote. Its input may be anything: no memory is taken
/// for a number before the bytes that it counts were seen.
pub struct Decoder {
    before: Before,
}

impl Decoder {
    /// For a lambda with so many inputs.
    pub fn new(inputs: usize) -> Decoder {
        Decoder { before: Before::nothing(inputs) }
    }

    /// The next wake was written whole.
    pub fn reset(&mut self) {
        self.before.forget();
    }

    /// The wake at the begin of `bytes`, which is taken off.
    ///
    /// # Errors
    ///
    /// [`Malformed`]; what is left of `bytes` then has no meaning, and neither have wakes that were
    /// written relative to this one.
    pub fn decode(&mut self, bytes: &mut &[u8]) -> Result<JournalEntry> {
        let before = &self.before;
        let [flags] = array(bytes)?;
        if flags & flag::RESERVED != 0 {
            return Err(Malformed::Unknown { what: "flags", value: flags });
        }
        let at_ns = difference(bytes, before.expected_at_ns() as u64)? as i64;
        let cause = cause(flags, before, bytes)?;
        let fuel = match flags & flag::FUEL != 0 {
            true => Some(difference(bytes, before.fuel)?),
            false => None,
        };
        // Each input has a byte at least.
        if bytes.len() < before.inputs.len() {
            return Err(Malformed::Short);
        }
        let seen =
            before.inputs.iter().map(|before| input(before, bytes)).collect::<Result<_>>()?;
        let triggers = if flags & flag::TRIGGERS != 0 { triggers(bytes)? } else { Vec::new() };
        let fault = if flags & flag::FAULT != 0 { Some(fault(bytes)?) } else { None };
        let log = if flags & flag::LOG != 0 { said(bytes)? } else { LogDigest::default() };
        let entry = JournalEntry { at_ns, cause, seen, triggers, fault, fuel, log };
        self.before.note(&entry);
        Ok(entry)
    }
}

fn array<const N: usize>(bytes: &mut &[u8]) -> Result<[u8; N]> {
    let (array, rest) = bytes.split_first_chunk().ok_or(Malformed::Short)?;
    *bytes = rest;
    Ok(*array)
}

fn number(bytes: &mut &[u8]) -> Result<u64> {
    let ends = bytes.iter().take(super::number::NUMBER_MAX).any(|byte| byte & 0x80 == 0);
    let short = !ends && bytes.len() < super::number::NUMBER_MAX;
    take(bytes).ok_or(if short { Malformed::Short } else { Malformed::Number })
}

fn difference(bytes: &mut &[u8], expected: u64) -> Result<u64> {
    number(bytes).map(|folded| expected.wrapping_add(unfold(folded)))
}

/// So many bytes, if they are there.
fn slice<'b>(bytes: &mut &'b [u8], len: u64) -> Result<&'b [u8]> {
    let len = usize::try_from(len).map_err(|_| Malformed::Short)?;
    let (slice, rest) = bytes.split_at_checked(len).ok_or(Malformed::Short)?;
    *bytes = rest;
    Ok(slice)
}

fn text(bytes: &mut &[u8]) -> Result<String> {
    let len = number(bytes)?;
    let text = std::str::from_utf8(slice(bytes, len)?).map_err(|_| Malformed::Text)?;
    Ok(text.to_owned())
}

fn cause(flags: u8, before: &Before, bytes: &mut &[u8]) -> Result<WakeSource> {
    let (writer_follows, number_follows) = (flags & flag::WRITER != 0, flags & flag::NUMBER != 0);
    if flags & flag::TICK != 0 {
        if writer_follows {
            return Err(Malformed::Unknown { what: "flags", value: flags });
        }
        return Ok(WakeSource::Tick { missed: if number_follows { number(bytes)? } else { 0 } });
    }
    let writer = if writer_follows { array(bytes)? } else { before.woken_by.0 };
    let expected = before.expected_seq(!writer_follows);
    Ok(WakeSource::Sample {
        writer,
        seq: if number_follows { difference(bytes, expected)? } else { expected },
    })
}

fn input(before: &InputBefore, bytes: &mut &[u8]) -> Result<InputView> {
    let [set] = array(bytes)?;
    let mut new = u64::from(set & seen::NEW);
    if set & seen::NEW == seen::NEW {
        new = new.checked_add(number(bytes)?).ok_or(Malformed::Number)?;
    }
    let digest = if set & seen::DIGEST != 0 { u32::from_le_bytes(array(bytes)?) } else { 0 };
    let expected = before.expected_newest(new);
    let newest = match set & seen::NEWEST != 0 {
        false => expected,
        true => match (array(bytes)?, expected) {
            ([newest::NONE], _) => None,
            ([newest::SAME_WRITER], Some((writer, expected))) => {
                Some((writer, difference(bytes, expected)?))
            }
            ([newest::OTHER_WRITER], _) => Some((array(bytes)?, number(bytes)?)),
            ([value], _) => {
                return Err(Malformed::Unknown { what: "form of a newest sample", value });
            }
        },
    };
    let reach = if set & seen::REACH != 0 { number(bytes)? } else { before.reach };
    Ok(InputView { new, digest, newest, reach })
}

fn triggers(bytes: &mut &[u8]) -> Result<Vec<Trigger>> {
    let found = number(bytes)?;
    if found > TRIGGERS_MAX as u64 {
        return Err(Malformed::Triggers { found });
    }
    (0..found).map(|_| trigger(bytes)).collect()
}

fn trigger(bytes: &mut &[u8]) -> Result<Trigger> {
    let [first] = array(bytes)?;
    let kind = match first & !TRIGGER_SCORE {
        0 => TriggerKind::Event,
        1 => TriggerKind::Start,
        2 => TriggerKind::Stop,
        _ => return Err(Malformed::Unknown { what: "kind of trigger", value: first }),
    };
    let label = text(bytes)?;
    let score = match first & TRIGGER_SCORE != 0 {
        true => Some(f64::from_le_bytes(array(bytes)?)),
        false => None,
    };
    if score.is_some_and(|score| !score.is_finite()) {
        return Err(Malformed::Score);
    }
    Ok(Trigger { kind, label, score, attributes: attributes(bytes)? })
}

fn attributes(bytes: &mut &[u8]) -> Result<Map<String, Value>> {
    match number(bytes)? {
        0 => Ok(Map::new()),
        found if found > ATTRIBUTES_MAX as u64 => Err(Malformed::LongAttributes { found }),
        len => serde_json::from_slice(slice(bytes, len)?).map_err(|_| Malformed::Attributes),
    }
}

fn fault(bytes: &mut &[u8]) -> Result<Fault> {
    let [first] = array(bytes)?;
    let known = FAULTS.get(usize::from(first & !(FAULT_USED | FAULT_ALLOWED)));
    let Some((kind, _)) = known else {
        return Err(Malformed::Unknown { what: "kind of fault", value: first });
    };
    let message = text(bytes)?;
    let used = if first & FAULT_USED != 0 { Some(number(bytes)?) } else { None };
    let allowed = if first & FAULT_ALLOWED != 0 { Some(number(bytes)?) } else { None };
    Ok(Fault { kind: *kind, message, used, allowed })
}

fn said(bytes: &mut &[u8]) -> Result<LogDigest> {
    let lines = u32::try_from(number(bytes)?).map_err(|_| Malformed::Number)?;
    Ok(LogDigest { lines, digest: u32::from_le_bytes(array(bytes)?) })
}

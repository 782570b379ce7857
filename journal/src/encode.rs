//! Encodes the wakes of a journal.

use crate::entry::{InputView, JournalEntry, WakeSource};
use crate::fault_code;
use crate::number::{fold, put};
use crate::previous::{
    FAULT_ALLOWED, FAULT_USED, PreviousInput, PreviousWake, TRIGGER_SCORE, flag, newest, seen,
};
use gleaner_lambda::{Fault, Trigger, TriggerKind};

/// Encodes wakes, each relative to the previous one. A wake without triggers needs no allocation.
pub struct Encoder {
    previous: PreviousWake,
    /// Buffer for attributes as JSON, whose length precedes them.
    json: Vec<u8>,
}

impl Encoder {
    pub fn new(inputs: usize) -> Encoder {
        Encoder { previous: PreviousWake::none(inputs), json: Vec::new() }
    }

    /// Encodes the next wake without reference to the previous one.
    pub fn reset(&mut self) {
        self.previous.reset();
    }

    /// Appends `entry` to `out`.
    ///
    /// # Panics
    ///
    /// If `entry` does not have the number of inputs given to [`new`](Self::new).
    pub fn encode(&mut self, entry: &JournalEntry, out: &mut Vec<u8>) {
        assert_eq!(entry.seen.len(), self.previous.inputs.len(), "number of inputs of a wake");
        let previous = &self.previous;
        let flags = out.len();
        out.push(0);
        put_difference(entry.at_ns as u64, previous.expected_at_ns() as u64, out);
        let mut set = cause(&entry.cause, previous, out);
        if let Some(fuel) = entry.fuel {
            set |= flag::FUEL;
            put_difference(fuel, previous.fuel, out);
        }
        for (now, previous) in entry.seen.iter().zip(&previous.inputs) {
            input(now, previous, out);
        }
        if !entry.triggers.is_empty() {
            set |= flag::TRIGGERS;
            put(entry.triggers.len() as u64, out);
            for one in &entry.triggers {
                trigger(one, &mut self.json, out);
            }
        }
        if let Some(one) = &entry.fault {
            set |= flag::FAULT;
            fault(one, out);
        }
        if entry.log.lines > 0 || entry.log.digest != 0 {
            set |= flag::LOG;
            put(entry.log.lines.into(), out);
            out.extend_from_slice(&entry.log.digest.to_le_bytes());
        }
        out[flags] = set;
        self.previous.update(entry);
    }
}

fn put_difference(number: u64, expected: u64, out: &mut Vec<u8>) {
    put(fold(number.wrapping_sub(expected)), out);
}

fn put_text(text: &str, out: &mut Vec<u8>) {
    put(text.len() as u64, out);
    out.extend_from_slice(text.as_bytes());
}

fn cause(cause: &WakeSource, previous: &PreviousWake, out: &mut Vec<u8>) -> u8 {
    match *cause {
        WakeSource::Tick { missed: 0 } => flag::TICK,
        WakeSource::Tick { missed } => {
            put(missed, out);
            flag::TICK | flag::NUMBER
        }
        WakeSource::Sample { writer, seq } => {
            let mut set = 0;
            let same_writer = writer == previous.woken_by.0;
            if !same_writer {
                set |= flag::WRITER;
                out.extend_from_slice(&writer);
            }
            let expected = previous.expected_seq(same_writer);
            if seq != expected {
                set |= flag::NUMBER;
                put_difference(seq, expected, out);
            }
            set
        }
    }
}

fn input(now: &InputView, previous: &PreviousInput, out: &mut Vec<u8>) {
    let first = out.len();
    out.push(0);
    let mut set = seen::NEW;
    match u8::try_from(now.new) {
        Ok(new) if new < seen::NEW => set = new,
        _ => put(now.new - u64::from(seen::NEW), out),
    }
    if now.digest != 0 {
        set |= seen::DIGEST;
        out.extend_from_slice(&now.digest.to_le_bytes());
    }
    let expected = previous.expected_newest(now.new);
    if now.newest != expected {
        set |= seen::NEWEST;
        match (now.newest, expected) {
            (None, _) => out.push(newest::NONE),
            (Some((writer, seq)), Some((known, expected))) if writer == known => {
                out.push(newest::SAME_WRITER);
                put_difference(seq, expected, out);
            }
            (Some((writer, seq)), _) => {
                out.push(newest::OTHER_WRITER);
                out.extend_from_slice(&writer);
                put(seq, out);
            }
        }
    }
    if now.reach != previous.reach {
        set |= seen::REACH;
        put(now.reach, out);
    }
    out[first] = set;
}

fn trigger(trigger: &Trigger, json: &mut Vec<u8>, out: &mut Vec<u8>) {
    let kind = match trigger.kind {
        TriggerKind::Event => 0,
        TriggerKind::Start => 1,
        TriggerKind::Stop => 2,
    };
    out.push(kind | if trigger.score.is_some() { TRIGGER_SCORE } else { 0 });
    put_text(&trigger.label, out);
    if let Some(score) = trigger.score {
        out.extend_from_slice(&score.to_le_bytes());
    }
    json.clear();
    if !trigger.attributes.is_empty() {
        serde_json::to_writer(&mut *json, &trigger.attributes)
            .expect("a map with texts as keys is JSON");
    }
    put(json.len() as u64, out);
    out.extend_from_slice(json);
}

fn fault(fault: &Fault, out: &mut Vec<u8>) {
    let first = out.len();
    out.push(fault_code(fault.kind) as u8);
    put_text(&fault.message, out);
    for (number, bit) in [(fault.used, FAULT_USED), (fault.allowed, FAULT_ALLOWED)] {
        if let Some(number) = number {
            out[first] |= bit;
            put(number, out);
        }
    }
}

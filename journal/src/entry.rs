//! One wake in a journal, and its comparison with a repetition.

use serde_json::Value;

use super::header::{Difference, JournalInput};
use super::{FAULTS, fault_code};
use gleaner_base::text::{excerpt, hex};
use gleaner_lambda::{Fault, Trigger};

/// One wake: its inputs and its decision.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct JournalEntry {
    /// Stamp of the sample or tick, in ns.
    pub at_ns: i64,
    pub cause: WakeSource,
    /// The state of each input, in the order of the header.
    pub seen: Vec<InputView>,
    pub triggers: Vec<Trigger>,
    pub fault: Option<Fault>,
    /// Fuel that the wake burnt; `None` for Python, which has none.
    pub fuel: Option<u64>,
    pub log: LogDigest,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WakeSource {
    /// A sample of the input that its schedule names.
    Sample {
        /// GUID of the sample's writer.
        writer: [u8; 16],
        /// Sequence number of the sample, which its writer counts.
        seq: u64,
    },
    Tick {
        /// Number of ticks without a wake since the previous wake.
        missed: u64,
    },
}

impl Default for WakeSource {
    fn default() -> Self {
        Self::Tick { missed: 0 }
    }
}

/// The state of one input in a wake, and the samples of it that the lambda read.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct InputView {
    /// Number of samples that arrived since the previous wake, including those without room in the
    /// ring.
    pub new: u64,
    /// Wrapping sum of the digests of the new samples in the ring, see `docs/journal.md`; 0 for
    /// none.
    pub digest: u32,
    /// Writer and sequence number of the newest sample in the ring.
    pub newest: Option<([u8; 16], u64)>,
    /// Number of samples, counted from the newest, that the lambda looked back; 0 for none.
    pub reach: u64,
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LogDigest {
    pub lines: u32,
    /// CRC-32 of the lines; 0 for none.
    pub digest: u32,
}

impl JournalEntry {
    /// Returns the first difference between the wake in the journal and its repetition `now`;
    /// `None` if inputs and decision are equal, bit for bit.
    ///
    /// `inputs` are those of the header. A clip keeps neither all writers nor more than 32 bits of
    /// a number: without `writers`, samples are compared as far as a clip keeps them.
    pub fn differs_from(
        &self,
        now: &JournalEntry,
        inputs: &[JournalInput],
        writers: bool,
    ) -> Option<Difference> {
        // The usual case, without formatting. Equal scores may differ in their bits, and equal maps
        // in their order.
        if self.triggers.is_empty() && self == now {
            return None;
        }
        Difference::of("stamp of the wake, in ns", self.at_ns, now.at_ns)
            .or_else(|| {
                Difference::of(
                    "cause of the wake",
                    self.cause_in_words(writers),
                    now.cause_in_words(writers),
                )
            })
            .or_else(|| Difference::of("number of inputs", self.seen.len(), now.seen.len()))
            .or_else(|| {
                let mut pairs = self.seen.iter().zip(&now.seen).enumerate();
                pairs.find_map(|(index, (journal, now))| {
                    seen_differs(journal, now, &in_words(inputs, index), writers)
                })
            })
            .or_else(|| {
                Difference::of("number of triggers", self.triggers.len(), now.triggers.len())
            })
            .or_else(|| {
                let mut pairs = self.triggers.iter().zip(&now.triggers).enumerate();
                pairs.find_map(|(index, (journal, now))| triggers_differ(journal, now, index + 1))
            })
            .or_else(|| {
                Difference::of("fault", fault_in_words(&self.fault), fault_in_words(&now.fault))
            })
            .or_else(|| Difference::of("fuel", number(self.fuel), number(now.fuel)))
            .or_else(|| Difference::of("number of log lines", self.log.lines, now.log.lines))
            .or_else(|| {
                Difference::of(
                    "text of the log lines",
                    digest(self.log.digest),
                    digest(now.log.digest),
                )
            })
    }

    fn cause_in_words(&self, writers: bool) -> String {
        match self.cause {
            WakeSource::Sample { writer, seq } => {
                format!("sample {}", identity((writer, seq), writers))
            }
            WakeSource::Tick { missed: 0 } => "a tick".to_owned(),
            WakeSource::Tick { missed } => format!("a tick after {missed} missed ones"),
        }
    }
}

fn in_words(inputs: &[JournalInput], index: usize) -> String {
    match inputs.get(index) {
        Some(input) => format!("input `{}` ({})", excerpt(&input.name), excerpt(&input.wire_topic)),
        None => format!("input {}", index + 1),
    }
}

fn seen_differs(
    journal: &InputView,
    now: &InputView,
    input: &str,
    writers: bool,
) -> Option<Difference> {
    // Called in every wake for every input: values are formatted only if they differ.
    if journal == now {
        return None;
    }
    let newest = |seen: &InputView| {
        seen.newest.map_or("none".to_owned(), |newest| identity(newest, writers))
    };
    Difference::of(format!("number of new samples of {input}"), journal.new, now.new)
        .or_else(|| {
            Difference::of(format!("newest sample of {input}"), newest(journal), newest(now))
        })
        .or_else(|| {
            Difference::of(
                format!("samples of {input}"),
                digest(journal.digest),
                digest(now.digest),
            )
        })
        .or_else(|| {
            let what = format!("number of samples of {input} that the lambda looked back");
            Difference::of(what, journal.reach, now.reach)
        })
}

fn identity((writer, seq): ([u8; 16], u64), writers: bool) -> String {
    if !writers {
        return (seq & u64::from(u32::MAX)).to_string();
    }
    format!("{seq} of writer {}", hex(&writer))
}

fn digest(digest: u32) -> String {
    format!("digest {digest:08x}")
}

fn number(number: Option<u64>) -> String {
    number.map_or("none".to_owned(), |number| number.to_string())
}

fn fault_in_words(fault: &Option<Fault>) -> String {
    let Some(Fault { kind, message, used, allowed }) = fault else { return "none".to_owned() };
    let (_, word) = FAULTS[fault_code(*kind)];
    format!("{word}, `{message}`, used {}, allowed {}", number(*used), number(*allowed))
}

/// Compares triggers as those of twins, but bit for bit and with attributes: it is the same lambda.
fn triggers_differ(journal: &Trigger, now: &Trigger, index: usize) -> Option<Difference> {
    let what = |part: &str| format!("trigger {index}: {part}");
    let score =
        |trigger: &Trigger| trigger.score.map_or("none".to_owned(), |score| score.to_string());
    let label = |trigger: &Trigger| format!("`{}`", trigger.label);
    let attribute = |value: Option<&Value>| value.map_or("none".to_owned(), Value::to_string);
    let keys =
        |trigger: &Trigger| trigger.attributes.keys().cloned().collect::<Vec<_>>().join(", ");
    Difference::of(what("kind"), journal.kind.as_str(), now.kind.as_str())
        .or_else(|| Difference::of(what("label"), label(journal), label(now)))
        .or_else(|| match journal.score.map(f64::to_bits) == now.score.map(f64::to_bits) {
            true => None,
            false => {
                Some(Difference { what: what("score"), journal: score(journal), now: score(now) })
            }
        })
        .or_else(|| {
            let (journal, now) = (&journal.attributes, &now.attributes);
            let mut all =
                journal.keys().chain(now.keys().filter(|key| !journal.contains_key(*key)));
            all.find_map(|key| {
                let what = what(&format!("attribute `{}`", excerpt(key)));
                Difference::of(what, attribute(journal.get(key)), attribute(now.get(key)))
            })
        })
        .or_else(|| Difference::of(what("order of its attributes"), keys(journal), keys(now)))
}

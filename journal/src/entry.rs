//! One wake in a journal, and its comparison with a repetition.

use serde_json::Value;

use crate::header::{Difference, JournalInput, differs};
use crate::{FAULTS, fault_code};
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

impl WakeSource {
    fn describe(self, writers: bool) -> String {
        match self {
            Self::Sample { writer, seq } => format!("sample {}", identity((writer, seq), writers)),
            Self::Tick { missed: 0 } => "a tick".to_owned(),
            Self::Tick { missed } => format!("a tick after {missed} missed ones"),
        }
    }
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
        let cause = |entry: &JournalEntry| entry.cause.describe(writers);
        let fault = |entry: &JournalEntry| fault_in_words(&entry.fault);
        let log = |entry: &JournalEntry| digest(entry.log.digest);
        differs("stamp of the wake, in ns", self.at_ns, now.at_ns)
            .or_else(|| differs("cause of the wake", cause(self), cause(now)))
            .or_else(|| differs("number of inputs", self.seen.len(), now.seen.len()))
            .or_else(|| {
                let mut pairs = self.seen.iter().zip(&now.seen).enumerate();
                pairs.find_map(|(index, (journal, now))| {
                    seen_differs(journal, now, &describe(inputs, index), writers)
                })
            })
            .or_else(|| differs("number of triggers", self.triggers.len(), now.triggers.len()))
            .or_else(|| {
                let mut pairs = self.triggers.iter().zip(&now.triggers).enumerate();
                pairs.find_map(|(index, (journal, now))| triggers_differ(journal, now, index + 1))
            })
            .or_else(|| differs("fault", fault(self), fault(now)))
            .or_else(|| differs("fuel", number(self.fuel), number(now.fuel)))
            .or_else(|| differs("number of log lines", self.log.lines, now.log.lines))
            .or_else(|| differs("text of the log lines", log(self), log(now)))
    }
}

fn describe(inputs: &[JournalInput], index: usize) -> String {
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
    let newest = |seen: &InputView| in_words_or_none(seen.newest, |it| identity(it, writers));
    let samples = |seen: &InputView| digest(seen.digest);
    let reach = format!("number of samples of {input} that the lambda looked back");
    differs(format!("number of new samples of {input}"), journal.new, now.new)
        .or_else(|| differs(format!("newest sample of {input}"), newest(journal), newest(now)))
        .or_else(|| differs(format!("samples of {input}"), samples(journal), samples(now)))
        .or_else(|| differs(reach, journal.reach, now.reach))
}

fn in_words_or_none<T>(value: Option<T>, describe: impl FnOnce(T) -> String) -> String {
    value.map_or("none".to_owned(), describe)
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
    in_words_or_none(number, |number| number.to_string())
}

fn fault_in_words(fault: &Option<Fault>) -> String {
    let Some(Fault { kind, message, used, allowed }) = fault else { return "none".to_owned() };
    let (_, word) = FAULTS[fault_code(*kind)];
    format!("{word}, `{message}`, used {}, allowed {}", number(*used), number(*allowed))
}

/// Compares triggers as those of twins, but bit for bit and with attributes: it is the same lambda.
fn triggers_differ(journal: &Trigger, now: &Trigger, index: usize) -> Option<Difference> {
    let what = |part: &str| format!("trigger {index}: {part}");
    let score = |trigger: &Trigger| in_words_or_none(trigger.score, |score| score.to_string());
    let label = |trigger: &Trigger| format!("`{}`", trigger.label);
    let attribute = |value: Option<&Value>| in_words_or_none(value, Value::to_string);
    let keys =
        |trigger: &Trigger| trigger.attributes.keys().cloned().collect::<Vec<_>>().join(", ");
    differs(what("kind"), journal.kind.as_str(), now.kind.as_str())
        .or_else(|| differs(what("label"), label(journal), label(now)))
        .or_else(|| {
            let is_equal = journal.score.map(f64::to_bits) == now.score.map(f64::to_bits);
            let (what, journal, now) = (what("score"), score(journal), score(now));
            (!is_equal).then_some(Difference { what, journal, now })
        })
        .or_else(|| {
            let (journal, now) = (&journal.attributes, &now.attributes);
            let mut all =
                journal.keys().chain(now.keys().filter(|key| !journal.contains_key(*key)));
            all.find_map(|key| {
                let what = what(&format!("attribute `{}`", excerpt(key)));
                differs(what, attribute(journal.get(key)), attribute(now.get(key)))
            })
        })
        .or_else(|| differs(what("order of its attributes"), keys(journal), keys(now)))
}

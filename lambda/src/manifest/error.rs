use std::fmt;
use std::io;
use std::path::PathBuf;

use super::ByteSize;
use super::bounds::INPUTS_MEMORY_MAX;
use gleaner_base::text::list;
use gleaner_base::{Exit, Explain, NotPlain};

/// A key in a manifest, as a user finds it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyLocation {
    /// The manifest, as it was named.
    pub file: String,
    /// The line, from 1.
    pub line: usize,
    /// The key with its table, for example `lambda.name`.
    pub key: String,
}

impl fmt::Display for KeyLocation {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, line {}: `{}`", self.file, self.line, self.key)
    }
}

/// Memory that one input asks for.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputMemory {
    /// The input's name.
    pub name: String,
    /// The line of its entry.
    pub line: usize,
    /// What its slots take.
    pub asked: ByteSize,
}

/// Why a manifest is refused.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The file cannot be read, or is no UTF-8.
    #[error("cannot read `{}`", path.display())]
    Read {
        /// The manifest.
        path: PathBuf,
        /// Why not.
        source: io::Error,
    },
    /// The file is longer than any manifest.
    #[error("`{}` is longer than {limit}", path.display())]
    TooLong {
        /// The manifest.
        path: PathBuf,
        /// The most that is read.
        limit: ByteSize,
    },
    /// The text is no TOML.
    #[error("{file}, line {line}: this is no TOML: {message}")]
    Syntax {
        /// The manifest, as it was named.
        file: String,
        /// Where the parser gave up.
        line: usize,
        /// What the parser says.
        message: String,
    },
    /// A required table is missing.
    #[error("{file} has no [{table}] table")]
    MissingTable {
        /// The manifest, as it was named.
        file: String,
        /// The table's name.
        table: &'static str,
        /// What to write.
        example: &'static str,
    },
    /// A required key is missing.
    #[error("{file}, line {line}: {table} has no `{key}`")]
    MissingKey {
        /// The manifest, as it was named.
        file: String,
        /// The line of the table.
        line: usize,
        /// The table as it is written, for example `[lambda]`.
        table: String,
        /// The key.
        key: &'static str,
        /// What to write.
        example: &'static str,
    },
    /// Nobody knows this key.
    #[error("{file}, line {line}: unknown key `{key}` {within}")]
    UnknownKey {
        /// The manifest, as it was named.
        file: String,
        /// The line of the key.
        line: usize,
        /// The key.
        key: String,
        /// Where it stands, for example `in [schedule]`.
        within: String,
        /// The known key that it resembles.
        near: Option<&'static str>,
        /// All keys that may stand there.
        known: &'static [&'static str],
    },
    /// A value has another TOML type.
    #[error("{at} is {found}")]
    WrongType {
        /// The key.
        at: Box<KeyLocation>,
        /// The type it has.
        found: &'static str,
        /// What it should be.
        wanted: String,
    },
    /// A text is not of the form that it needs.
    #[error("{at} is `{text}`, which is no {what}")]
    WrongForm {
        /// The key.
        at: Box<KeyLocation>,
        /// Its value.
        text: String,
        /// What it should be.
        what: &'static str,
        /// What such a text looks like.
        rule: &'static str,
    },
    /// A text is none of the few words that are possible.
    #[error("{at} is `{text}`, not {}", list(choices, "or"))]
    NoChoice {
        /// The key.
        at: Box<KeyLocation>,
        /// Its value.
        text: String,
        /// The words.
        choices: Vec<&'static str>,
        /// The word that it resembles.
        near: Option<&'static str>,
    },
    /// A number is too small.
    #[error("{at} is {value}, below the minimum of {min}")]
    TooSmall {
        /// The key.
        at: Box<KeyLocation>,
        /// Its value.
        value: String,
        /// The smallest value.
        min: String,
        /// The largest value, if there is one.
        max: Option<String>,
    },
    /// A number is too large.
    #[error("{at} is {value}, above the maximum of {max}")]
    TooLarge {
        /// The key.
        at: Box<KeyLocation>,
        /// Its value.
        value: String,
        /// The smallest value, if there is one.
        min: Option<String>,
        /// The largest value.
        max: String,
    },
    /// The same thing stands in two places.
    #[error("{what} `{name}` is listed twice in {file}, lines {first} and {second}")]
    Twice {
        /// `topic`, `input`, `key` or the like.
        what: &'static str,
        /// Its name.
        name: String,
        /// The manifest, as it was named.
        file: String,
        /// The first line.
        first: usize,
        /// The second line.
        second: usize,
        /// What to keep.
        way_out: &'static str,
    },
    /// The schedule waits for an input that does not exist.
    #[error("{at} is `{name}`, which is the name of no input")]
    NoSuchInput {
        /// The key.
        at: Box<KeyLocation>,
        /// The name.
        name: String,
        /// The input that it resembles.
        near: Option<String>,
        /// The inputs.
        inputs: Vec<String>,
    },
    /// The inputs ask for too much memory together.
    #[error(
        "the inputs in {file} ask for {} MiB together, above the maximum of {INPUTS_MEMORY_MAX}: {}",
        mebibytes(*total),
        shares(inputs)
    )]
    TooMuchMemory {
        /// The manifest, as it was named.
        file: String,
        /// What they ask for together.
        total: ByteSize,
        /// What each asks for.
        inputs: Vec<InputMemory>,
    },
    /// A key does not fit the others around it.
    #[error("{at} {why}")]
    Misplaced {
        /// The key.
        at: Box<KeyLocation>,
        /// What does not fit.
        why: String,
        /// What to write.
        way_out: String,
    },
}

impl Explain for ManifestError {
    fn help(&self) -> Option<String> {
        use ManifestError::*;
        Some(match self {
            Read { path, source } if source.kind() == io::ErrorKind::NotFound => {
                let is_manifest = path.ends_with("lambda.toml");
                let wanted = if is_manifest { "a folder that has a lambda.toml" } else { "the configuration of a vehicle" };
                format!("name {wanted}")
            }
            Read { source, .. } if source.kind() == io::ErrorKind::InvalidData => "save it as UTF-8".to_owned(),
            Read { source, .. } => return NotPlain::of(source).map(NotPlain::help),
            TooLong { .. } => "check that this is a manifest; data of a lambda belongs into files of its own".to_owned(),
            Syntax { .. } => {
                "write `key = value` with texts in quotes, and tables as [name], or as [[name]] where there can be several"
                    .to_owned()
            }
            MissingTable { example, .. } | MissingKey { example, .. } => format!("add {example}"),
            UnknownKey { near: Some(near), .. } | NoChoice { near: Some(near), .. } => format!("did you mean `{near}`?"),
            UnknownKey { known, .. } => format!("the known keys are {}", list(known, "and")),
            WrongType { wanted, .. } => format!("give {wanted}"),
            WrongForm { rule, .. } => (*rule).to_owned(),
            NoChoice { choices, .. } => format!("write {}", list(choices, "or")),
            TooSmall { min, max: Some(max), .. } | TooLarge { min: Some(min), max, .. } => {
                format!("give a value from {min} to {max}")
            }
            TooSmall { min, .. } => format!("give {min} or more"),
            TooLarge { max, .. } => format!("give {max} or less"),
            Twice { way_out, .. } => (*way_out).to_owned(),
            NoSuchInput { name, inputs, .. } if inputs.is_empty() => {
                format!("add an [[input]] with name = \"{name}\"; there is none yet")
            }
            NoSuchInput { near, inputs, .. } => {
                let inputs = format!("the inputs are {}", list(inputs, "and"));
                near.as_ref().map_or(inputs.clone(), |near| format!("did you mean `{near}`? {inputs}"))
            }
            TooMuchMemory { .. } => {
                "lower `depth`, `hold` or `max_size`: an input takes (depth + hold + 1) x max_size, and \
                 (hold + 1) x decoded_size for compressed images"
                    .to_owned()
            }
            Misplaced { way_out, .. } => way_out.clone(),
        })
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

/// Whole MiB, rounded up, so that a sum just above the maximum does not look equal to it.
fn mebibytes(size: ByteSize) -> u64 {
    size.bytes().div_ceil(1 << 20)
}

fn shares(inputs: &[InputMemory]) -> String {
    let share = |input: &InputMemory| {
        format!("`{}` (line {}) {} MiB", input.name, input.line, mebibytes(input.asked))
    };
    inputs.iter().map(share).collect::<Vec<_>>().join(", ")
}

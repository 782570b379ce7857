//! Errors of a manifest, with the line of each and help for the user.

use std::fmt;
use std::io;
use std::path::PathBuf;

use super::ByteSize;
use super::bounds::INPUTS_MEMORY_MAX;
use gleaner_base::text::list;
use gleaner_base::{Exit, Explain, NotPlain};

/// The location of a key in a manifest.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct KeyLocation {
    /// The path of the manifest, as given.
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

/// The memory of one input.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputMemory {
    /// The input's name.
    pub name: String,
    /// The line of its entry.
    pub line: usize,
    /// Memory of its slots.
    pub required: ByteSize,
}

/// The reason why a manifest is refused.
#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    /// The file cannot be read, or is not UTF-8.
    #[error("cannot read `{}`", path.display())]
    Read {
        /// The manifest.
        path: PathBuf,
        /// The cause.
        source: io::Error,
    },
    /// The file is too long for a manifest.
    #[error("`{}` is longer than {limit}", path.display())]
    TooLong {
        /// The manifest.
        path: PathBuf,
        /// The maximum length.
        limit: ByteSize,
    },
    /// The text is not TOML.
    #[error("{file}, line {line}: invalid TOML: {message}")]
    Syntax {
        /// The path of the manifest, as given.
        file: String,
        /// The line of the error.
        line: usize,
        /// The message of the parser.
        message: String,
    },
    /// A required table is missing.
    #[error("{file} has no [{table}] table")]
    MissingTable {
        /// The path of the manifest, as given.
        file: String,
        /// The table's name.
        table: &'static str,
        /// An example.
        example: &'static str,
    },
    /// A required key is missing.
    #[error("{file}, line {line}: {table} has no `{key}`")]
    MissingKey {
        /// The path of the manifest, as given.
        file: String,
        /// The line of the table.
        line: usize,
        /// The header of the table, for example `[lambda]`.
        table: String,
        /// The key.
        key: &'static str,
        /// An example.
        example: &'static str,
    },
    /// The key is unknown.
    #[error("{file}, line {line}: unknown key `{key}` {within}")]
    UnknownKey {
        /// The path of the manifest, as given.
        file: String,
        /// The line of the key.
        line: usize,
        /// The key.
        key: String,
        /// Table of the key, for example `in [schedule]`.
        within: String,
        /// A known key that is similar.
        near: Option<&'static str>,
        /// All known keys of that table.
        known: &'static [&'static str],
    },
    /// A value has the wrong TOML type.
    #[error("{at} is {found}")]
    WrongType {
        /// The key.
        at: Box<KeyLocation>,
        /// Type of the value.
        found: &'static str,
        /// The expected value.
        wanted: String,
    },
    /// A text has the wrong form.
    #[error("{at} is `{text}`, which is not a {what}")]
    WrongForm {
        /// The key.
        at: Box<KeyLocation>,
        /// Value of the key.
        text: String,
        /// The expected kind of text.
        what: &'static str,
        /// The form of such a text.
        rule: &'static str,
    },
    /// A text is not one of the possible words.
    #[error("{at} is `{text}`, not {}", list(choices, "or"))]
    NoChoice {
        /// The key.
        at: Box<KeyLocation>,
        /// Value of the key.
        text: String,
        /// The words.
        choices: Vec<&'static str>,
        /// A word that is similar.
        near: Option<&'static str>,
    },
    /// A number is too small.
    #[error("{at} is {value}, below the minimum of {min}")]
    TooSmall {
        /// The key.
        at: Box<KeyLocation>,
        /// Value of the key.
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
        /// Value of the key.
        value: String,
        /// The smallest value, if there is one.
        min: Option<String>,
        /// The largest value.
        max: String,
    },
    /// Something is listed twice.
    #[error("{what} `{name}` is listed twice in {file}, lines {first} and {second}")]
    Twice {
        /// `topic`, `input`, `key` or the like.
        what: &'static str,
        /// Name, topic or key that is listed twice.
        name: String,
        /// The path of the manifest, as given.
        file: String,
        /// The first line.
        first: usize,
        /// The second line.
        second: usize,
        /// Help for the user.
        help: &'static str,
    },
    /// The schedule names an input that does not exist.
    #[error("{at} is `{name}`, which is not the name of an input")]
    NoSuchInput {
        /// The key.
        at: Box<KeyLocation>,
        /// The name.
        name: String,
        /// An input with a similar name.
        near: Option<String>,
        /// The inputs.
        inputs: Vec<String>,
    },
    /// The inputs need too much memory together.
    #[error(
        "the inputs in {file} need {} MiB together, above the maximum of {INPUTS_MEMORY_MAX}: {}",
        mebibytes(*total),
        shares(inputs)
    )]
    TooMuchMemory {
        /// The path of the manifest, as given.
        file: String,
        /// The memory of all inputs.
        total: ByteSize,
        /// The memory of each input.
        inputs: Vec<InputMemory>,
    },
    /// A key conflicts with others.
    #[error("{at} {why}")]
    Misplaced {
        /// The key.
        at: Box<KeyLocation>,
        /// The conflict.
        why: String,
        /// Help for the user.
        help: String,
    },
}

impl Explain for ManifestError {
    fn help(&self) -> Option<String> {
        use ManifestError::*;
        Some(match self {
            Read { path, source } if source.kind() == io::ErrorKind::NotFound => {
                let is_manifest = path.ends_with("lambda.toml");
                let wanted = match is_manifest {
                    true => "a folder that has a lambda.toml",
                    false => "the vehicle's configuration file; see docs/limits.md",
                };
                format!("name {wanted}")
            }
            Read { source, .. } if source.kind() == io::ErrorKind::InvalidData => {
                "save it as UTF-8".to_owned()
            }
            Read { source, .. } => return NotPlain::of(source).map(NotPlain::help),
            TooLong { .. } => {
                "check that this is a manifest; data of a lambda belongs in files of its own"
                    .to_owned()
            }
            Syntax { .. } => "write `key = value` with texts in quotes, and tables as [name], \
                 or as [[name]] where there can be several"
                .to_owned(),
            MissingTable { example, .. } | MissingKey { example, .. } => format!("add {example}"),
            UnknownKey { near: Some(near), .. } | NoChoice { near: Some(near), .. } => {
                format!("did you mean `{near}`?")
            }
            UnknownKey { known, .. } => format!("the known keys are {}", list(known, "and")),
            WrongType { wanted, .. } => format!("give {wanted}"),
            WrongForm { rule, .. } => (*rule).to_owned(),
            NoChoice { choices, .. } => format!("write {}", list(choices, "or")),
            TooSmall { min, max: Some(max), .. } | TooLarge { min: Some(min), max, .. } => {
                format!("give a value from {min} to {max}")
            }
            TooSmall { min, .. } => format!("give {min} or more"),
            TooLarge { max, .. } => format!("give {max} or less"),
            Twice { help, .. } => (*help).to_owned(),
            NoSuchInput { name, inputs, .. } if inputs.is_empty() => {
                format!("add an [[input]] with name = \"{name}\"; there is none yet")
            }
            NoSuchInput { near, inputs, .. } => {
                let inputs = format!("the inputs are {}", list(inputs, "and"));
                match near {
                    Some(near) => format!("did you mean `{near}`? {inputs}"),
                    None => inputs,
                }
            }
            TooMuchMemory { .. } => "lower `depth`, `hold` or `max_size`: \
                 an input takes (depth + hold + 1) x max_size, \
                 and (hold + 1) x decoded_size for compressed images"
                .to_owned(),
            Misplaced { help, .. } => help.clone(),
        })
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

/// Returns whole MiB, rounded up, so that a sum just above the maximum does not look equal to it.
fn mebibytes(size: ByteSize) -> u64 {
    size.bytes().div_ceil(1 << 20)
}

fn shares(inputs: &[InputMemory]) -> String {
    let share = |input: &InputMemory| {
        format!("`{}` (line {}) {} MiB", input.name, input.line, mebibytes(input.required))
    };
    inputs.iter().map(share).collect::<Vec<_>>().join(", ")
}

//! Errors of a manifest, with the line of each and help for the user.

use std::fmt;
use std::io;
use std::path::PathBuf;

use super::ByteSize;
use super::bounds::INPUTS_MEMORY_MAX;
use gleaner_base::text::list;
use gleaner_base::{Exit, Explain, NotPlain};

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

#[derive(Debug, Clone, PartialEq, Eq)]
pub struct InputMemory {
    pub name: String,
    pub line: usize,
    /// Memory of its slots.
    pub required: ByteSize,
}

#[derive(Debug, thiserror::Error)]
pub enum ManifestError {
    #[error("cannot read `{}`", path.display())]
    Read { path: PathBuf, source: io::Error },
    #[error("`{}` is longer than {limit}", path.display())]
    TooLong { path: PathBuf, limit: ByteSize },
    #[error("{file}, line {line}: invalid TOML: {message}")]
    Syntax { file: String, line: usize, message: String },
    #[error("{file} has no [{table}] table")]
    MissingTable { file: String, table: &'static str, example: &'static str },
    #[error("{file}, line {line}: {table} has no `{key}`")]
    MissingKey {
        file: String,
        line: usize,
        /// The header of the table, for example `[lambda]`.
        table: String,
        key: &'static str,
        example: &'static str,
    },
    #[error("{file}, line {line}: unknown key `{key}` {within}")]
    UnknownKey {
        file: String,
        line: usize,
        key: String,
        /// Table of the key, for example `in [schedule]`.
        within: String,
        near: Option<&'static str>,
        known: &'static [&'static str],
    },
    #[error("{at} is {found}")]
    WrongType { at: Box<KeyLocation>, found: &'static str, wanted: String },
    #[error("{at} is `{text}`, which is not a {what}")]
    WrongForm { at: Box<KeyLocation>, text: String, what: &'static str, rule: &'static str },
    #[error("{at} is `{text}`, not {}", list(choices, "or"))]
    NoChoice {
        at: Box<KeyLocation>,
        text: String,
        choices: Vec<&'static str>,
        near: Option<&'static str>,
    },
    #[error("{at} is {value}, below the minimum of {min}")]
    TooSmall { at: Box<KeyLocation>, value: String, min: String, max: Option<String> },
    #[error("{at} is {value}, above the maximum of {max}")]
    TooLarge { at: Box<KeyLocation>, value: String, min: Option<String>, max: String },
    #[error("{what} `{name}` is listed twice in {file}, lines {first} and {second}")]
    Twice {
        /// `topic`, `input`, `key` or the like.
        what: &'static str,
        name: String,
        file: String,
        first: usize,
        second: usize,
        help: &'static str,
    },
    #[error("{at} is `{name}`, which is not the name of an input")]
    NoSuchInput { at: Box<KeyLocation>, name: String, near: Option<String>, inputs: Vec<String> },
    #[error(
        "the inputs in {file} need {} MiB together, above the maximum of {INPUTS_MEMORY_MAX}: {}",
        mebibytes(*total),
        shares(inputs)
    )]
    TooMuchMemory { file: String, total: ByteSize, inputs: Vec<InputMemory> },
    #[error("{at} {why}")]
    Misplaced { at: Box<KeyLocation>, why: String, help: String },
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

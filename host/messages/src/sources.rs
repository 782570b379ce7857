//! Where message definitions come from when no recording carries them.
//!
//! A type is looked for in folders of the user, then among those that are bundled, then where ROS 2
//! is installed. What is found is put together with all that it refers to, in the order and form in
//! which MCAP files carry it.
//!
//! What never happens here: a file being read whose path a type's name could choose. A name is
//! letters, digits and `_`.

use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::io::{self, Read};
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use super::definitions::{Definitions, MessageError, short_name};
use super::parse::{self, Element};

/// The largest file, the largest text and the most types. ROS 2's own stay below 20 KB, 40 KB and
/// 30.
const MAX_FILE: usize = 1 << 20;
const MAX_TEXT: usize = 8 << 20;
const MAX_TYPES: usize = 256;
/// The longest name of a package or of a type; longer ones are no names of files everywhere.
const MAX_NAME: usize = 128;

/// `pkg/Type`, with its text.
const BUNDLED: &str = include_str!("bundled.msgs");

/// The places where message definitions are looked for.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    folders: Vec<PathBuf>,
    ament_prefixes: Vec<PathBuf>,
}

/// Why the definitions of a type cannot be had, though something was found.
#[derive(Debug, thiserror::Error)]
pub enum SourcesError {
    /// What is no name of a message type is looked for nowhere.
    #[error("`{name}` is not the name of a message type, such as `std_msgs/msg/Header`")]
    Name {
        /// The name, cut at 80 characters and without control characters.
        name: String,
    },
    /// A file cannot be read.
    #[error("cannot read `{path}`, the definition of `{type_name}`")]
    Read {
        /// The type.
        type_name: String,
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file is no text, or more than 1 MiB of it.
    #[error("`{path}`, the definition of `{type_name}`, {what}")]
    NotText {
        /// The type.
        type_name: String,
        /// The file.
        path: PathBuf,
        /// In which way.
        what: &'static str,
    },
    /// The definition that was found in a file, or what it comes to with all it refers to, makes no
    /// sense.
    #[error("the definition of `{type_name}` cannot be used")]
    Unusable {
        /// The type.
        type_name: String,
        /// What is wrong with it.
        source: MessageError,
    },
    /// A file holds several definitions.
    #[error("the definition of `{type_name}` holds more than one type")]
    Several {
        /// The type.
        type_name: String,
    },
    /// A type refers to one that is nowhere to be found.
    #[error("`{type_name}` refers to `{missing}`, whose definition is not to be found")]
    Missing {
        /// The type that refers to it.
        type_name: String,
        /// The type that is missing.
        missing: String,
    },
    /// More than any sensible message.
    #[error("the definition of `{type_name}` takes more than {MAX_TYPES} types or 8 MiB")]
    TooLarge {
        /// The type that was asked for.
        type_name: String,
    },
}

impl Sources {
    /// Looks in `folders` first, then among the bundled definitions, then below `ament_prefixes`,
    /// each in this order.
    ///
    /// In a folder, `pkg/msg/Type` is `pkg/msg/Type.msg`, `pkg/Type.msg` or `Type.msg`; below a
    /// prefix, as ROS 2 installs it, `share/pkg/msg/Type.msg`.
    pub fn new(folders: &[PathBuf], ament_prefixes: &[PathBuf]) -> Self {
        Self { folders: folders.to_owned(), ament_prefixes: ament_prefixes.to_owned() }
    }

    /// The ros2msg text of `type_name` (`pkg/msg/Type` or `pkg/Type`) with all types it refers to,
    /// as [`Definitions::parse`] takes it; `None` if the type is nowhere.
    ///
    /// # Errors
    ///
    /// [`SourcesError`] if it is no name, or if what was found cannot be read, is incomplete or
    /// makes no sense.
    pub fn find(&self, type_name: &str) -> Result<Option<Arc<str>>, SourcesError> {
        let root = short_name(type_name);
        if !is_name(&root) {
            let shown = type_name.chars().filter(|c| !c.is_control()).take(80).collect();
            return Err(SourcesError::Name { name: shown });
        }
        gather(&root, &|name| self.one(name))
    }

    /// The text of one type, without those it refers to. `name` is a name.
    fn one(&self, name: &str) -> Result<Option<String>, SourcesError> {
        let Some((package, leaf)) = name.split_once('/') else {
            return Ok(None);
        };
        let file = format!("{leaf}.msg");
        for folder in &self.folders {
            let inside = folder.join(package);
            for path in [inside.join("msg").join(&file), inside.join(&file)] {
                if let Some(text) = read(name, path)? {
                    return Ok(Some(text));
                }
            }
        }
        if let Some(text) = bundled().get(name) {
            return Ok(Some((*text).to_owned()));
        }
        for prefix in &self.ament_prefixes {
            if let Some(text) =
                read(name, prefix.join("share").join(package).join("msg").join(&file))?
            {
                return Ok(Some(text));
            }
        }
        // Last, as it says no package: a `Header.msg` for a type of the lambda's own must not stand
        // for that of all others.
        for folder in &self.folders {
            if let Some(text) = read(name, folder.join(&file))? {
                return Ok(Some(text));
            }
        }
        Ok(None)
    }
}

/// The text of `root`, which is a name, with all types it refers to. `one` has the text of one
/// type, if there is one.
pub(super) fn gather(root: &str, one: &One<'_>) -> Result<Option<Arc<str>>, SourcesError> {
    let Some(text) = one(root)? else {
        return Ok(None);
    };
    let mut gathered = Gathered { one, root, known: HashSet::new(), text: String::new() };
    gathered.add(root, &text)?;
    let unusable = |source| SourcesError::Unusable { type_name: root.to_owned(), source };
    Definitions::parse(root, &gathered.text).map_err(unusable)?;
    Ok(Some(gathered.text.into()))
}

/// The text of one type, without those it refers to.
type One<'s> = dyn Fn(&str) -> Result<Option<String>, SourcesError> + 's;

/// A type and what it refers to, as far as they are known; depth first, each type where it is first
/// needed.
struct Gathered<'s> {
    one: &'s One<'s>,
    root: &'s str,
    known: HashSet<String>,
    text: String,
}

impl Gathered<'_> {
    /// Goes as deep as there are types, at most [`MAX_TYPES`]. Types that contain themselves are
    /// found by the parser later.
    fn add(&mut self, name: &str, text: &str) -> Result<(), SourcesError> {
        self.known.insert(name.to_owned());
        if self.known.len() > 1 {
            self.text += &format!("{}\nMSG: {name}\n", "=".repeat(80));
        }
        self.text += text;
        if !text.is_empty() && !text.ends_with('\n') {
            self.text.push('\n');
        }
        if self.known.len() > MAX_TYPES || self.text.len() > MAX_TEXT {
            return Err(SourcesError::TooLarge { type_name: self.root.to_owned() });
        }
        let unusable = |source| SourcesError::Unusable { type_name: name.to_owned(), source };
        let parts = parse::parts(text).map_err(unusable)?;
        let [part] = parts.as_slice() else {
            return Err(SourcesError::Several { type_name: name.to_owned() });
        };
        for field in &part.fields {
            if let Element::Struct(wanted) = &field.element {
                self.refer(name, wanted)?;
            }
        }
        Ok(())
    }

    /// Adds what `owner` calls `wanted`, by the rule of [`Definitions::parse`]: a bare name means
    /// the owner's package, or the `Header` that ROS 1 habits left behind.
    fn refer(&mut self, owner: &str, wanted: &str) -> Result<(), SourcesError> {
        let wanted = short_name(wanted);
        let candidates = match (wanted.contains('/'), owner.split_once('/')) {
            (false, Some((package, _))) => {
                vec![format!("{package}/{wanted}"), format!("std_msgs/{wanted}")]
            }
            _ => vec![wanted.clone()],
        };
        for candidate in candidates.into_iter().filter(|candidate| is_name(candidate)) {
            if self.known.contains(&candidate) {
                return Ok(());
            }
            if let Some(text) = (self.one)(&candidate)? {
                return self.add(&candidate, &text);
            }
        }
        Err(SourcesError::Missing {
            type_name: owner.to_owned(),
            missing: wanted.chars().take(80).collect(),
        })
    }
}

/// The bundled definitions by `pkg/Type`.
fn bundled() -> &'static HashMap<&'static str, &'static str> {
    static INDEX: OnceLock<HashMap<&str, &str>> = OnceLock::new();
    INDEX.get_or_init(|| {
        // What stands before the first `MSG:` is for people.
        let types = BUNDLED.split("MSG: ").skip(1);
        types.filter_map(|one| one.split_once('\n')).collect()
    })
}

/// Whether `name` is `pkg/Type`, both of them letters, digits and `_`, and a letter first.
pub(super) fn is_name(name: &str) -> bool {
    let is_word = |word: &str| {
        word.len() <= MAX_NAME
            && word.starts_with(|c: char| c.is_ascii_alphabetic())
            && word.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
    };
    name.split_once('/').is_some_and(|(package, leaf)| is_word(package) && is_word(leaf))
}

/// The text in `path`; `None` if there is no file.
fn read(type_name: &str, path: PathBuf) -> Result<Option<String>, SourcesError> {
    // Asked first: to open a pipe would wait for its writer.
    match std::fs::metadata(&path) {
        Ok(found) if found.is_file() => {}
        Ok(_) => return Ok(None),
        Err(error)
            if matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::NotADirectory) =>
        {
            return Ok(None);
        }
        Err(source) => {
            return Err(SourcesError::Read { type_name: type_name.to_owned(), path, source });
        }
    }
    let mut bytes = Vec::new();
    let read =
        File::open(&path).and_then(|file| file.take(MAX_FILE as u64 + 1).read_to_end(&mut bytes));
    if let Err(source) = read {
        return Err(SourcesError::Read { type_name: type_name.to_owned(), path, source });
    }
    let not_text = |what| SourcesError::NotText { type_name: type_name.to_owned(), path, what };
    if bytes.len() > MAX_FILE {
        return Err(not_text("is larger than 1 MiB"));
    }
    String::from_utf8(bytes).map(Some).map_err(|_| not_text("is not UTF-8"))
}

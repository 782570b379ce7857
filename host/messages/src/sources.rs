//! Finds message definitions that no recording carries.
//!
//! A type is searched in folders of the user, then among the bundled definitions, then in the
//! installation of ROS 2. The result contains all types it refers to, in the order and form of MCAP
//! files.
//!
//! The name of a type cannot choose the path of a file: it consists of letters, digits and `_`.
//! letters, digits and `_`.

use std::collections::{HashMap, HashSet};
use std::fs::File;
use std::io::{self, Read};
use std::path::PathBuf;
use std::sync::{Arc, OnceLock};

use super::definitions::{Definitions, MessageError, short_name};
use super::parse::{self, Element};

/// Limits of the file size, of the text and of the number of types. ROS 2's own stay below 20 KB,
/// 40 KB and 30.
const MAX_FILE: usize = 1 << 20;
const MAX_TEXT: usize = 8 << 20;
const MAX_TYPES: usize = 256;
/// Limit of the names of packages and types; not every file system takes longer ones.
const MAX_NAME: usize = 128;

/// Bundled definitions: `pkg/Type`, each with its text.
const BUNDLED: &str = include_str!("bundled.msgs");

/// The places to search for message definitions.
#[derive(Clone, Debug, Default)]
pub struct Sources {
    folders: Vec<PathBuf>,
    ament_prefixes: Vec<PathBuf>,
}

/// Errors of finding the definitions of a type; that no place has it is not one.
#[derive(Debug, thiserror::Error)]
pub enum SourcesError {
    #[error("`{name}` is not the name of a message type, such as `std_msgs/msg/Header`")]
    Name {
        /// The name, truncated to 80 characters and without control characters.
        name: String,
    },
    #[error("cannot read `{path}`, the definition of `{type_name}`")]
    Read { type_name: String, path: PathBuf, source: io::Error },
    /// A file is not text, or larger than 1 MiB.
    #[error("`{path}`, the definition of `{type_name}`, {what}")]
    NotText { type_name: String, path: PathBuf, what: &'static str },
    /// The definition in a file, or the result with all types it refers to, is invalid.
    #[error("the definition of `{type_name}` cannot be used")]
    Unusable { type_name: String, source: MessageError },
    #[error("the definition of `{type_name}` contains more than one type")]
    Several { type_name: String },
    #[error("`{type_name}` refers to `{missing}`, whose definition cannot be found")]
    Missing { type_name: String, missing: String },
    #[error("the definition of `{type_name}` takes more than {MAX_TYPES} types or 8 MiB")]
    TooLarge { type_name: String },
}

impl Sources {
    /// Searches `folders` first, then the bundled definitions, then `ament_prefixes`, each in this
    /// order.
    ///
    /// In a folder, `pkg/msg/Type` is `pkg/msg/Type.msg`, `pkg/Type.msg` or `Type.msg`; below a
    /// prefix, as ROS 2 installs it, `share/pkg/msg/Type.msg`.
    pub fn new(folders: &[PathBuf], ament_prefixes: &[PathBuf]) -> Self {
        Self { folders: folders.to_owned(), ament_prefixes: ament_prefixes.to_owned() }
    }

    /// Returns the ros2msg text of `type_name` (`pkg/msg/Type` or `pkg/Type`) with all types it
    /// refers to, as [`Definitions::parse`] expects it; `None` if no place has the type.
    ///
    /// # Errors
    ///
    /// [`SourcesError`] if the name is invalid, or if a file cannot be read, or its content is
    /// incomplete or invalid.
    pub fn find(&self, type_name: &str) -> Result<Option<Arc<str>>, SourcesError> {
        let root = short_name(type_name);
        if !is_name(&root) {
            let shown = type_name.chars().filter(|c| !c.is_control()).take(80).collect();
            return Err(SourcesError::Name { name: shown });
        }
        collect_types(&root, &|name| self.find_type(name))
    }

    /// Returns the text of one type, without those it refers to. `name` is a valid name.
    fn find_type(&self, name: &str) -> Result<Option<String>, SourcesError> {
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
        // Last, as this path contains no package: a `Header.msg` for a type of the lambda's own
        // must not replace the `Header` of all others.
        for folder in &self.folders {
            if let Some(text) = read(name, folder.join(&file))? {
                return Ok(Some(text));
            }
        }
        Ok(None)
    }
}

/// Returns the text of `root`, a valid name, with all types it refers to. `find_type` returns the
/// text of one type, if it exists.
pub(super) fn collect_types(
    root: &str,
    find_type: &FindType<'_>,
) -> Result<Option<Arc<str>>, SourcesError> {
    let Some(text) = find_type(root)? else {
        return Ok(None);
    };
    let mut collected =
        TypeCollector { find_type, root, known: HashSet::new(), text: String::new() };
    collected.add(root, &text)?;
    let unusable = |source| SourcesError::Unusable { type_name: root.to_owned(), source };
    Definitions::parse(root, &collected.text).map_err(unusable)?;
    Ok(Some(collected.text.into()))
}

/// Returns the text of one type, without those it refers to.
type FindType<'s> = dyn Fn(&str) -> Result<Option<String>, SourcesError> + 's;

/// Collects a type and the types it refers to; depth first, each type where it is first needed.
struct TypeCollector<'s> {
    find_type: &'s FindType<'s>,
    root: &'s str,
    known: HashSet<String>,
    text: String,
}

impl TypeCollector<'_> {
    /// Recurses at most [`MAX_TYPES`] deep. Types that contain themselves are found by the parser
    /// later.
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

    /// Adds the type that `owner` calls `wanted`, by the rule of [`Definitions::parse`]: a bare
    /// name means the owner's package, or `std_msgs/Header`, as in ROS 1.
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
            if let Some(text) = (self.find_type)(&candidate)? {
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
        // The text before the first `MSG:` is a comment.
        let types = BUNDLED.split("MSG: ").skip(1);
        types.filter_map(|part| part.split_once('\n')).collect()
    })
}

/// Returns whether `name` is `pkg/Type`, both of letters, digits and `_`, beginning with a letter.
pub(super) fn is_name(name: &str) -> bool {
    let is_word = |word: &str| {
        word.len() <= MAX_NAME
            && word.starts_with(|c: char| c.is_ascii_alphabetic())
            && word.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
    };
    name.split_once('/').is_some_and(|(package, leaf)| is_word(package) && is_word(leaf))
}

/// Reads the text in `path`; `None` if there is no file.
fn read(type_name: &str, path: PathBuf) -> Result<Option<String>, SourcesError> {
    // Checked first: opening a pipe would wait for its writer.
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

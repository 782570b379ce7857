//! Counts openings without a subject and discouraged words in comments, pages and the texts of
//! programs. See CONTRIBUTING.md.

/// The kind of text that a finding lies in. Each kind has an allowance of its own.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Kind {
    /// The `//!` lines of a module open with a clause instead of a noun or a verb.
    ModuleOpening,
    /// The documentation of a public item opens so; items of WIT files and of Python modules count
    /// as public.
    PublicOpening,
    /// The documentation of another item opens so.
    PrivateOpening,
    /// A comment, documentation or a page has a discouraged word.
    Word,
    /// A text that a program prints has a discouraged word or phrase.
    Text,
}

/// A place that should be worded in another way.
#[derive(Debug)]
pub struct Finding {
    /// The kind of text it lies in.
    pub kind: Kind,
    /// The line, from 1.
    pub line: usize,
    /// The opening or the word.
    pub what: String,
}

/// Words that a clause without a subject begins with.
const OPENINGS: &[&str] = &[
    "What",
    "Whatever",
    "Whether",
    "Who",
    "Whoever",
    "Whom",
    "Whose",
    "Which",
    "How",
    "However",
    "Where",
    "When",
    "Why",
    "By what",
    "By when",
    "By which",
    "For what",
    "For which",
    "For whom",
    "From what",
    "From when",
    "From where",
    "From which",
    "In what",
    "In which",
    "Of what",
    "Of which",
    "On what",
    "On which",
    "So far",
    "So long",
    "So many",
    "So much",
    "To what",
    "To which",
    "To whom",
    "Under which",
    "Until when",
    "Up to what",
    "Up to when",
    "Up to which",
    "With what",
    "With which",
];

/// Words for programs that send, print or check something, and for actors that have a name.
const WORDS: &[&str] = &[
    "anew", "believe", "believed", "believes", "hear", "heard", "hearing", "hears", "nobody",
    "ours", "said", "say", "saying", "says", "somebody", "tell", "telling", "tells", "theirs",
    "told", "whoever",
];

/// Phrases that stand for a thing, where a reader without context needs its name: "is no address",
/// "a digest is none". After `there`, they are right, and so is `is none of`.
const PHRASES: &[&str] = &[" is no ", " are no ", " is none", " are none", " any more", " for now"];

/// The texts of a Rust file, each with its line, from 1. In them, `there is` and `none of` are one
/// word.
fn texts(text: &str) -> Vec<(usize, String)> {
    let mut texts = Vec::new();
    let mut rest = text;
    while let Some(at) = rest.find(['"', '\'', '/']) {
        let begin = &rest[at..];
        // A character or a lifetime, a comment, a raw text, another text.
        let length = match begin.as_bytes() {
            [b'\'', b'\\', _, rest @ ..] => {
                rest.iter().position(|byte| *byte == b'\'').map_or(3, |end| end + 4)
            }
            [b'\'', b'"' | b'/', b'\'', ..] => 3,
            [b'/', b'/', ..] => begin.find('\n').unwrap_or(begin.len()),
            [b'"', ..] if rest[..at].ends_with('#') => {
                let hashes = rest[..at].len() - rest[..at].trim_end_matches('#').len();
                begin.find(&format!("\"{}", "#".repeat(hashes))).map_or(begin.len(), |end| end + 1)
            }
            [b'"', ..] => {
                let mut is_escaped = true;
                let end = begin.find(|c| {
                    let ends = c == '"' && !is_escaped;
                    is_escaped = c == '\\' && !is_escaped;
                    ends
                });
                end.map_or(begin.len(), |end| end + 1)
            }
            _ => 1,
        };
        if begin.starts_with('"') {
            let line = text[..text.len() - begin.len()].lines().count().max(1);
            let found = begin[1..length].replace("here ", "here-").replace("no longer", "-");
            let found = found.replace("none of", "-");
            texts.push((line, format!(" {found} ")));
        }
        rest = &begin[length.max(1)..];
    }
    texts
}

/// The discouraged words and phrases of the texts of a program in Rust.
pub fn findings_in_texts(text: &str) -> Vec<Finding> {
    let product = text.split("\nmod tests {").next().unwrap_or_default();
    let mut found = Vec::new();
    for (line, text) in texts(product) {
        let phrases = PHRASES.iter().copied().filter(|phrase| text.contains(phrase));
        for what in words(&text).into_iter().chain(phrases) {
            found.push(Finding { kind: Kind::Text, line, what: what.to_owned() });
        }
    }
    found
}

/// The places of a file that should be worded in another way, in the order of its lines.
///
/// Rust and WIT files are read for comments, Python files for docstrings and comments, and pages
/// (`md`) as a whole but for their blocks of code. Words between backquotes or double quotes are
/// quotations and do not count.
pub fn findings(path: &str, text: &str) -> Vec<Finding> {
    let language = path.rsplit_once('.').map_or("", |(_, extension)| extension);
    let mut found = Vec::new();
    let lines: Vec<&str> = text.lines().collect();
    let mut prose = Prose::new(language);
    let mut opened = false;
    for (index, line) in lines.iter().enumerate() {
        let Some(Piece { text, doc }) = prose.piece(line) else {
            opened = false;
            continue;
        };
        let mut add =
            |kind, what: &str| found.push(Finding { kind, line: index + 1, what: what.to_owned() });
        match doc {
            Some(kind) if !opened => {
                if let Some(opening) = opening(text) {
                    let kind = match kind {
                        Doc::Module => Kind::ModuleOpening,
                        Doc::Item if language != "rs" || is_public(&lines[index..]) => {
                            Kind::PublicOpening
                        }
                        Doc::Item => Kind::PrivateOpening,
                    };
                    add(kind, opening);
                }
                opened = true;
            }
            Some(_) => {}
            None => opened = false,
        }
        for word in words(text) {
            add(Kind::Word, word);
        }
    }
    found
}

/// The opening of `text` that has no subject.
fn opening(text: &str) -> Option<&'static str> {
    let begins = |opening: &str| {
        text.strip_prefix(opening)
            .is_some_and(|rest| !rest.starts_with(|c: char| c.is_alphanumeric()))
    };
    OPENINGS.iter().copied().filter(|opening| begins(opening)).max_by_key(|opening| opening.len())
}

/// The discouraged words of `text` outside of quotations.
fn words(text: &str) -> Vec<&'static str> {
    let mut found = Vec::new();
    for (index, part) in text.split(['`', '"']).enumerate() {
        if index % 2 == 1 {
            continue;
        }
        for word in part.split(|c: char| !(c.is_alphanumeric() || c == '_' || c == '\'')) {
            found.extend(WORDS.iter().copied().find(|listed| word.eq_ignore_ascii_case(listed)));
        }
    }
    found
}

/// Returns whether the item below the documentation at the start of `lines` is public.
fn is_public(lines: &[&str]) -> bool {
    let mut code = lines.iter().map(|line| line.trim()).filter(|line| !line.starts_with("//"));
    code.find(|line| !line.is_empty() && !line.starts_with("#["))
        .is_some_and(|line| line.starts_with("pub "))
}

/// The subject of a piece of documentation.
#[derive(Clone, Copy)]
enum Doc {
    Module,
    Item,
}

/// The prose of one line.
struct Piece<'a> {
    text: &'a str,
    doc: Option<Doc>,
}

/// Finds the prose in the lines of a file of one language.
struct Prose<'a> {
    language: &'a str,
    fenced: bool,
    docstring: bool,
    code_seen: bool,
}

impl<'a> Prose<'a> {
    fn new(language: &'a str) -> Prose<'a> {
        Prose { language, fenced: false, docstring: false, code_seen: false }
    }

    fn piece<'b>(&mut self, line: &'b str) -> Option<Piece<'b>> {
        match self.language {
            "rs" | "wit" => self.slashes(line),
            "py" => self.python(line),
            "md" => self.page(line),
            _ => None,
        }
    }

    fn slashes<'b>(&mut self, line: &'b str) -> Option<Piece<'b>> {
        let start = line.trim_start();
        let docs = [("//!", Doc::Module), ("///", Doc::Item)];
        for (mark, doc) in docs {
            if let Some(text) = start.strip_prefix(mark) {
                return self.unfenced(text.trim()).map(|text| Piece { text, doc: Some(doc) });
            }
        }
        self.fenced = false;
        // A comment after code, but not the `//` of an address.
        let at =
            if start.starts_with("//") { Some(0) } else { start.find(" // ").map(|at| at + 1) };
        at.map(|at| Piece { text: start[at..].trim_start_matches('/').trim(), doc: None })
    }

    fn python<'b>(&mut self, line: &'b str) -> Option<Piece<'b>> {
        let start = line.trim();
        if self.docstring {
            self.docstring = !start.ends_with("\"\"\"");
            return Some(Piece { text: start.trim_end_matches("\"\"\""), doc: None });
        }
        if let Some(text) = start.strip_prefix("\"\"\"") {
            self.docstring = !(text.ends_with("\"\"\""));
            let doc = if self.code_seen { Doc::Item } else { Doc::Module };
            return Some(Piece { text: text.trim_end_matches("\"\"\""), doc: Some(doc) });
        }
        if let Some(text) = start.strip_prefix('#') {
            return Some(Piece { text: text.trim_start_matches([':', ' ']), doc: None });
        }
        self.code_seen |= !start.is_empty();
        start.split_once("  # ").map(|(_, text)| Piece { text, doc: None })
    }

    fn page<'b>(&mut self, line: &'b str) -> Option<Piece<'b>> {
        self.unfenced(line).map(|text| Piece { text, doc: None })
    }

    fn unfenced<'b>(&mut self, text: &'b str) -> Option<&'b str> {
        if text.trim_start().starts_with("```") {
            self.fenced = !self.fenced;
            return None;
        }
        (!self.fenced).then_some(text)
    }
}

/// Names of types that several crates share, as they are one concept seen from several sides: the
/// resources and values of `wit/`, which the host, both skins, the SDK and its fake host declare
/// each for itself.
pub const SHARED_TYPES: &[&str] = &[
    "Args",
    "CallResult",
    "Column",
    "Field",
    "Frame",
    "Model",
    "Result",
    "Sample",
    "Tensor",
    "Topic",
];

/// The names of all types that a Rust file defines; associated types do not count.
pub fn type_names(text: &str) -> Vec<&str> {
    let defined = |line: &'_ str| -> Option<usize> {
        let code = line.trim_start();
        let visible = match code.strip_prefix("pub") {
            Some(rest) if rest.starts_with('(') => {
                rest.split_once(") ").map_or("", |(_, rest)| rest)
            }
            Some(rest) => rest.trim_start(),
            None => code,
        };
        let kinds = ["struct ", "enum ", "trait ", "union ", "type "];
        let kind = kinds.into_iter().find(|kind| visible.starts_with(kind))?;
        let is_associated = kind == "type " && line.starts_with(' ');
        (!is_associated).then(|| line.len() - visible.len() + kind.len())
    };
    let name = |line: &'_ str, at: usize| {
        line[at..]
            .find(|c: char| !c.is_alphanumeric() && c != '_')
            .map_or(line.len(), |end| at + end)
    };
    let names = text.lines().filter_map(|line| defined(line).map(|at| &line[at..name(line, at)]));
    names.filter(|name| name.starts_with(char::is_uppercase)).collect()
}

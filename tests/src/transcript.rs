//! Pages that show what commands print: each `text` block that begins with `$ ` is a transcript,
//! which a test does again.

use std::path::Path;
use std::process::{Command, Stdio};

use gleaner_parts::Parts;

use crate::markdown::{Block, blocks};
use crate::{program, root};

/// A command of a page, and what the page says that it prints.
#[derive(Debug)]
pub struct Step {
    /// The line of the block's fence, from 1.
    pub line: usize,
    /// For a shell.
    pub command: String,
    /// Its lines; `[..]` stands for anything within a line, and a line `...` for any lines.
    pub shown: Vec<String>,
}

/// The commands of a page, in its order.
pub fn steps(page: &str) -> Vec<Step> {
    let is_transcript = |block: &Block| {
        block.language == "text" && block.lines.first().is_some_and(|line| line.starts_with("$ "))
    };
    let mut steps: Vec<Step> = Vec::new();
    for block in blocks(page).into_iter().filter(is_transcript) {
        for text in block.lines {
            match text.strip_prefix("$ ") {
                Some(command) => steps.push(Step {
                    line: block.line,
                    command: command.to_owned(),
                    shown: Vec::new(),
                }),
                None => {
                    steps.last_mut().expect("a transcript begins with a command").shown.push(text)
                }
            }
        }
    }
    steps
}

/// Does what a step says in `folder`: what it printed, on both streams, and its exit code, if that
/// is not 0. Paths within the folder are shown as those relative to it.
///
/// # Panics
///
/// If there is no shell, or no Python.
pub fn perform(folder: &Path, command: &str) -> Vec<String> {
    let gleaner = program("gleaner");
    let programs = gleaner.parent().expect("a program lies in a folder");
    let path = std::env::var_os("PATH").unwrap_or_default();
    let python = Parts::find().and_then(|parts| parts.python(None)).expect("a Python");
    let first =
        [programs, python.parent().expect("a program lies in a folder")].map(Path::to_owned);
    let path = std::env::join_paths(first.into_iter().chain(std::env::split_paths(&path)));
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("{{ {command}\n}} 2>&1")]).current_dir(folder).stdin(Stdio::null());
    shell
        .env("PATH", path.expect("folders of programs"))
        .env("XDG_CACHE_HOME", root().join("target/test-cache"));
    // What is compiled is that of this workspace, of which all is here.
    shell.env("CARGO_NET_OFFLINE", "true").env("CARGO_TARGET_DIR", root().join("target/test-new"));
    let output = shell.output().expect("there is a shell");
    let text =
        String::from_utf8_lossy(&output.stdout).replace(&format!("{}/", folder.display()), "");
    let mut lines: Vec<String> = text.lines().map(|line| line.trim_end().to_owned()).collect();
    while lines.last().is_some_and(String::is_empty) {
        lines.pop();
    }
    if let Some(code) = output.status.code().filter(|code| *code != 0) {
        lines.push(format!("[exit code {code}]"));
    }
    lines
}

/// Whether `lines` are those that `shown` says.
pub fn fits(shown: &[String], lines: &[String]) -> bool {
    match (shown, lines) {
        ([], lines) => lines.is_empty(),
        ([any, rest @ ..], lines) if any == "..." => {
            (0..=lines.len()).any(|skipped| fits(rest, &lines[skipped..]))
        }
        ([_, ..], []) => false,
        ([first, rest @ ..], [line, lines @ ..]) => line_fits(first, line) && fits(rest, lines),
    }
}

fn line_fits(shown: &str, line: &str) -> bool {
    let mut pieces = shown.split("[..]");
    let Some(mut rest) = line.strip_prefix(pieces.next().unwrap_or_default()) else { return false };
    let pieces: Vec<_> = pieces.collect();
    for (index, piece) in pieces.iter().enumerate() {
        let is_last = index + 1 == pieces.len();
        let at = if is_last {
            rest.ends_with(piece).then(|| rest.len() - piece.len())
        } else {
            rest.find(piece)
        };
        let Some(at) = at else { return false };
        rest = &rest[at + piece.len()..];
    }
    rest.is_empty()
}

/// The page with what each command printed now, where it does not fit: for whoever changed a
/// message.
pub fn rewritten(page: &str, printed: &[(Step, Vec<String>)]) -> String {
    let mut page = page.to_owned();
    for (step, lines) in printed.iter().filter(|(step, lines)| !fits(&step.shown, lines)) {
        let block = |lines: &[String]| {
            let lines: String = lines.iter().flat_map(|line| [line, "\n"]).collect();
            format!("$ {}\n{lines}", step.command)
        };
        page = page.replacen(&block(&step.shown), &block(lines), 1);
    }
    page
}

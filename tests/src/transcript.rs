//! Checks pages that show output of commands: each `text` block that begins with `$ ` is a
//! transcript, which a test repeats.

use std::path::Path;
use std::process::{Command, Stdio};

use gleaner_base::programs::InstalledPrograms;

use crate::markdown::{Block, blocks};
use crate::{program, root};

/// A command of a page with its documented output.
#[derive(Debug)]
pub struct TranscriptStep {
    /// Line of the block's fence, from 1.
    pub line: usize,
    pub command: String,
    /// Lines of the output; `[..]` stands for any text within a line, and a line `...` for any
    /// lines.
    pub shown: Vec<String>,
}

/// The commands of a page, in its order.
pub fn steps(page: &str) -> Vec<TranscriptStep> {
    let is_transcript = |block: &Block| {
        block.language == "text" && block.lines.first().is_some_and(|line| line.starts_with("$ "))
    };
    let mut steps: Vec<TranscriptStep> = Vec::new();
    for block in blocks(page).into_iter().filter(is_transcript) {
        for text in block.lines {
            match text.strip_prefix("$ ") {
                Some(command) => steps.push(TranscriptStep {
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

/// Runs `command` in `folder`; returns its output on both streams, and its exit code unless it is
/// 0. Paths within the folder become relative to it.
pub fn perform(folder: &Path, command: &str) -> Vec<String> {
    let gleaner = program("gleaner");
    let programs = gleaner.parent().expect("a program lies in a folder");
    let path = std::env::var_os("PATH").unwrap_or_default();
    let python = InstalledPrograms::find().and_then(|parts| parts.python(None)).expect("a Python");
    let first =
        [programs, python.parent().expect("a program lies in a folder")].map(Path::to_owned);
    let path = std::env::join_paths(first.into_iter().chain(std::env::split_paths(&path)));
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("{{ {command}\n}} 2>&1")]).current_dir(folder).stdin(Stdio::null());
    shell
        .env("PATH", path.expect("folders of programs"))
        .env("XDG_CACHE_HOME", root().join("target/test-cache"));
    // Cargo compiles crates of this workspace, so all dependencies are available offline.
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

/// Returns whether `lines` match `shown`.
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

/// The page with the new output of each command whose output does not match.
pub fn rewritten(page: &str, printed: &[(TranscriptStep, Vec<String>)]) -> String {
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

//! The order of the house: which room may name which, and where unsafe code has its address. See
//! ARCHITECTURE.md.

use std::collections::BTreeSet;
use std::process::Command;

use crate::root;
use crate::tree::File;

/// The files that may hold unsafe code. Each says so below its `//!` lines, and states the fact
/// that makes each block sound.
pub const UNSAFE_FILES: &[&str] = &[
    "guest-sdk-rust/src/bindings.rs",
    "host/buffers/src/lease.rs",
    "host/buffers/src/pool.rs",
    "host/buffers/src/region.rs",
    "host/buffers/src/ring.rs",
    "host/dds/src/joins.rs",
    "host/jail/src/cgroup_join.rs",
    "host/python/src/array.rs",
    "host/python/src/memory.rs",
    "host/src/guest/wasm/load.rs",
    "host/src/memory.rs",
    "host/vitals/src/inherited_file.rs",
    "host/vitals/src/pulse.rs",
    "player/src/cyclone.rs",
];

/// The crates of ours that a crate may depend on. A crate that is not listed may depend on what it
/// likes: tests, benches and lambdas stand outside of the house.
pub const CRATES: &[(&str, &[&str])] = &[
    ("gleaner-base", &["gleaner-rules"]),
    ("gleaner-buffers", &[]),
    (
        "gleaner-cli",
        &[
            "gleaner-base",
            "gleaner-journal",
            "gleaner-lambda",
            "gleaner-parts",
            "gleaner-protocol",
            "gleaner-report",
        ],
    ),
    ("gleaner-compile", &["gleaner-base", "gleaner-jail", "gleaner-lambda"]),
    ("gleaner-dds", &["gleaner-base", "gleaner-messages", "gleaner-protocol", "gleaner-transport"]),
    ("gleaner-drives", &["gleaner-base", "gleaner-messages", "gleaner-transport"]),
    (
        "gleaner-host",
        &[
            "gleaner-base",
            "gleaner-buffers",
            "gleaner-compile",
            "gleaner-dds",
            "gleaner-drives",
            "gleaner-image",
            "gleaner-jail",
            "gleaner-journal",
            "gleaner-lambda",
            "gleaner-messages",
            "gleaner-parts",
            "gleaner-protocol",
            "gleaner-recorder",
            "gleaner-rules",
            "gleaner-transport",
            "gleaner-vitals",
        ],
    ),
    ("gleaner-image", &["gleaner-rules"]),
    ("gleaner-jail", &["gleaner-protocol"]),
    ("gleaner-journal", &["gleaner-base", "gleaner-lambda"]),
    ("gleaner-lambda", &["gleaner-base", "gleaner-rules"]),
    ("gleaner-messages", &["gleaner-base", "gleaner-rules"]),
    ("gleaner-parts", &["gleaner-base"]),
    (
        "gleaner-player",
        &[
            "gleaner-base",
            "gleaner-drives",
            "gleaner-image",
            "gleaner-lambda",
            "gleaner-messages",
            "gleaner-transport",
        ],
    ),
    ("gleaner-protocol", &["gleaner-base", "gleaner-journal", "gleaner-lambda"]),
    (
        "gleaner-python",
        &[
            "gleaner-host",
            "gleaner-image",
            "gleaner-lambda",
            "gleaner-messages",
            "gleaner-transport",
            "gleaner-vitals",
        ],
    ),
    (
        "gleaner-recorder",
        &[
            "gleaner-base",
            "gleaner-dds",
            "gleaner-drives",
            "gleaner-image",
            "gleaner-journal",
            "gleaner-lambda",
            "gleaner-messages",
            "gleaner-protocol",
            "gleaner-transport",
            "gleaner-vitals",
        ],
    ),
    ("gleaner-report", &["gleaner-base", "gleaner-lambda", "gleaner-protocol"]),
    ("gleaner-rules", &[]),
    ("gleaner-sdk", &["gleaner-rules"]),
    (
        "gleaner-shim",
        &["gleaner-base", "gleaner-jail", "gleaner-lambda", "gleaner-protocol", "gleaner-vitals"],
    ),
    ("gleaner-transport", &["gleaner-base", "gleaner-messages", "gleaner-protocol"]),
    ("gleaner-vitals", &["gleaner-protocol"]),
];

/// Crates that are not linked into a crate of ours, whatever its features.
pub const WITHOUT: &[(&str, &[&str])] = &[
    ("gleaner-cli", &["wasmtime", "pyo3", "rustdds"]),
    ("gleaner-dds", &["mcap", "rusqlite"]),
    ("gleaner-drives", &["pyo3", "rustdds"]),
    // Native code is loaded by the runtime and made by `gleaner-compile` alone.
    ("gleaner-host", &["cranelift-codegen", "pyo3"]),
    ("gleaner-player", &["pyo3", "rustdds"]),
    // The cloud's page can use it.
    ("gleaner-report", &["clap", "indicatif"]),
];

/// Inside of `host/src`: a room, and the rooms that it must not name.
pub const ROOMS: &[(&str, &[&str])] = &[
    (
        "memory",
        &[
            "api",
            "guest",
            "input",
            "invoker",
            "live",
            "program",
            "replay",
            "schedule",
            "session_setup",
        ],
    ),
    (
        "api",
        &["guest", "input", "invoker", "live", "program", "replay", "schedule", "session_setup"],
    ),
    ("input", &["guest", "invoker", "live", "program", "replay", "schedule", "session_setup"]),
    (
        "isolation",
        &[
            "api",
            "guest",
            "input",
            "journal",
            "invoker",
            "live",
            "program",
            "replay",
            "schedule",
            "session_setup",
        ],
    ),
    ("journal", &["guest", "invoker", "live", "program", "replay", "schedule", "session_setup"]),
    ("schedule", &["guest", "invoker", "live", "program", "replay", "session_setup"]),
    ("invoker", &["live", "program", "replay", "schedule", "session_setup"]),
    ("guest", &["input", "invoker", "live", "program", "replay", "schedule", "session_setup"]),
    ("session_setup", &["invoker", "live", "program", "replay", "schedule"]),
    ("replay", &["live", "program"]),
    ("live", &["program", "replay"]),
    (
        "network",
        &[
            "api",
            "guest",
            "input",
            "invoker",
            "live",
            "program",
            "replay",
            "schedule",
            "session_setup",
        ],
    ),
    (
        "topics",
        &[
            "api",
            "guest",
            "input",
            "invoker",
            "live",
            "program",
            "replay",
            "schedule",
            "session_setup",
        ],
    ),
];

/// Whether `file` declares that it holds unsafe code.
pub fn allows_unsafe(file: &File) -> bool {
    file.text
        .lines()
        .map(str::trim)
        .any(|line| line.starts_with('#') && line.contains("allow(unsafe_code"))
}

/// The lines of a Rust file that hold unsafe code, from 1.
pub fn unsafe_lines(file: &File) -> Vec<usize> {
    // Put together here, so that this file does not hold what it looks for.
    let signs = ["{", "impl", "fn", "extern"].map(|what| ["unsafe", what].join(" "));
    let lines = code(&file.text).enumerate();
    lines
        .filter(|(_, line)| signs.iter().any(|sign| line.contains(sign.as_str())))
        .map(|(index, _)| index + 1)
        .collect()
}

/// The lines of a Rust file without what follows `//`; good enough to tell code from comments.
pub fn code(text: &str) -> impl Iterator<Item = &str> {
    text.lines().map(|line| line.split_once("//").map_or(line, |(code, _)| code))
}

/// The room in `host/src` that a file belongs to: `guest` of `host/src/guest/mod.rs`.
pub fn room_of(path: &str) -> Option<&str> {
    let inside = path.strip_prefix("host/src/")?;
    let room = inside.split('/').next()?;
    Some(room.strip_suffix(".rs").unwrap_or(room))
}

/// The rooms of its crate that a Rust file names, as in `crate::api::Session` or `use crate::{api,
/// input::Remap}`.
pub fn rooms_named(text: &str) -> BTreeSet<String> {
    let code: String = code(text).flat_map(|line| [line, "\n"]).collect();
    let mut named = BTreeSet::new();
    for (at, start) in code.match_indices("crate::") {
        let begins_a_word =
            !code[..at].ends_with(|c: char| c.is_alphanumeric() || c == '_' || c == '$');
        if begins_a_word {
            named.extend(first_words(&code[at + start.len()..]));
        }
    }
    named
}

/// The first word of a path, or those of each path in a group in braces.
fn first_words(path: &str) -> Vec<String> {
    let word = |text: &str| {
        let text = text.trim_start();
        let end = text.find(|c: char| !(c.is_alphanumeric() || c == '_')).unwrap_or(text.len());
        text[..end].to_owned()
    };
    let Some(group) = path.strip_prefix('{') else {
        return vec![word(path)];
    };
    let (mut words, mut depth, mut start) = (Vec::new(), 0, 0);
    for (at, character) in group.char_indices() {
        match character {
            '{' => depth += 1,
            '}' | ',' if depth == 0 => {
                words.push(word(&group[start..at]));
                start = at + 1;
                if character == '}' {
                    break;
                }
            }
            '}' => depth -= 1,
            _ => {}
        }
    }
    words.retain(|word| !word.is_empty());
    words
}

/// The packages that a `Cargo.toml` depends on for what it makes, on any platform; not those of its
/// own tests.
pub fn dependencies(manifest: &toml::Table) -> BTreeSet<String> {
    let platforms = manifest
        .get("target")
        .and_then(toml::Value::as_table)
        .into_iter()
        .flat_map(toml::Table::values);
    let sections = platforms.filter_map(toml::Value::as_table).chain([manifest]);
    let tables = sections
        .flat_map(|section| ["dependencies", "build-dependencies"].map(|key| section.get(key)));
    let entries = tables.flatten().filter_map(toml::Value::as_table).flatten();
    // An entry may give the package another name; then the package is what counts.
    let package = |(name, entry): (&String, &toml::Value)| {
        entry.get("package").and_then(toml::Value::as_str).unwrap_or(name).to_owned()
    };
    entries.map(package).collect()
}

/// The crates that are linked into `package` with all its features, those of its tests left out.
///
/// # Panics
///
/// If cargo does not know the package.
pub fn contents(package: &str) -> BTreeSet<String> {
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.args([
        "tree",
        "--offline",
        "--all-features",
        "--edges",
        "normal",
        "--prefix",
        "none",
        "--package",
        package,
    ]);
    let output = cargo.current_dir(root()).output().expect("cargo starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout);
    text.lines().filter_map(|line| line.split(' ').next()).map(str::to_owned).collect()
}

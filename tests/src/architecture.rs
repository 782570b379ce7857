//! The rules of the repository's structure: which room may use which, and which files may contain
//! unsafe code. See ARCHITECTURE.md.

use std::collections::BTreeSet;
use std::process::Command;

use crate::root;
use crate::tree::File;

/// The files that may contain unsafe code. Each declares it below its `//!` lines, and states for
/// each block why it is sound, unless it is [`GENERATED`].
pub const UNSAFE_FILES: &[&str] = &[
    "bench/benches/parts.rs",
    "guest-sdk-rust/src/bindings.rs",
    "host/buffers/src/lease.rs",
    "host/buffers/src/pool.rs",
    "host/buffers/src/region.rs",
    "host/buffers/src/ring.rs",
    "host/buffers/src/shared/control.rs",
    "host/buffers/src/shared/hold.rs",
    "host/buffers/src/shared/layout.rs",
    "host/buffers/src/shared/reader.rs",
    "host/buffers/src/shared/writer.rs",
    "host/buffers/tests/loom/shared.rs",
    "host/buffers/tests/suite/shared.rs",
    "host/buffers/tests/suite/shared_ring.rs",
    "host/dds/src/joins.rs",
    "host/dds/src/key_hash.rs",
    "host/ingress/src/program/real_time.rs",
    "host/ingress/tests/kills.rs",
    "host/ingress/tests/suite/hostile.rs",
    "host/python/src/array.rs",
    "host/python/src/memory.rs",
    "host/samples/src/regions/control.rs",
    "host/samples/src/regions/topic.rs",
    "host/samples/src/topic.rs",
    "host/samples/tests/processes.rs",
    "host/sandbox/src/cgroup_join.rs",
    "host/sandbox/src/needed.rs",
    "host/sandbox/src/priority.rs",
    "host/sandbox/tests/start.rs",
    "host/src/guest/wasm/load.rs",
    "host/src/memory.rs",
    "player/src/cyclone.rs",
    "protocol/src/process_stats/heartbeat.rs",
    "protocol/src/process_stats/inherited_file.rs",
];

/// Code that a program of others generates. Rules on length, words and names are not for it.
pub const GENERATED: &[&str] = &["guest-sdk-rust/src/bindings.rs"];

/// The workspace crates that a crate may depend on, separated by spaces, all without `gleaner-`. A
/// crate that is not listed may depend on anything: tests, benches and lambdas are outside of the
/// rules.
pub const CRATES: &[(&str, &str)] = &[
    ("artifacts", "base"),
    ("base", "rules"),
    ("buffers", ""),
    ("cli", "artifacts base fleet journal lambda protocol report supervisor trust"),
    ("cloud", "base fleet lambda pixels protocol trust"),
    ("compile", "artifacts base lambda sandbox"),
    ("dds", "base messages protocol"),
    ("drives", "base messages"),
    ("fleet", "base protocol"),
    (
        "host",
        "artifacts base buffers compile drives journal lambda messages pixels protocol recorder \
         rules samples sandbox",
    ),
    ("inference", "artifacts base protocol sandbox"),
    ("ingress", "base buffers dds drives messages protocol samples sandbox"),
    ("journal", "base lambda"),
    ("lambda", "base rules"),
    ("messages", "base protocol rules"),
    ("orchestrator", "base fleet lambda protocol spool supervisor trust"),
    ("pixels", "rules"),
    ("player", "base drives lambda messages pixels"),
    ("protocol", "base journal lambda"),
    ("python", "host lambda messages pixels protocol"),
    ("recorder", "base drives journal lambda messages pixels protocol samples sandbox trust"),
    ("report", "base lambda protocol"),
    ("rules", ""),
    ("samples", "base buffers messages protocol"),
    ("sandbox", "base lambda protocol spool"),
    ("sdk", "rules"),
    ("spool", "base"),
    ("supervisor", "artifacts base lambda protocol spool trust"),
    ("trust", "base lambda"),
];

/// Crates that must not be linked into a crate, with any of its features.
pub const WITHOUT: &[(&str, &[&str])] = &[
    ("gleaner-cli", &["wasmtime", "pyo3", "rustdds"]),
    // It stores and forwards what was signed, and runs none of it.
    ("gleaner-cloud", &["wasmtime", "pyo3", "rustdds", "ort"]),
    ("gleaner-dds", &["mcap", "rusqlite"]),
    ("gleaner-drives", &["pyo3", "rustdds"]),
    // The runtime loads native code; only `gleaner-compile` generates it.
    ("gleaner-host", &["cranelift-codegen", "pyo3"]),
    // It reads what untrusted peers send, and runs no code.
    ("gleaner-orchestrator", &["wasmtime", "pyo3", "rustdds"]),
    ("gleaner-player", &["pyo3", "rustdds"]),
    // A web page may use it.
    ("gleaner-report", &["clap", "indicatif", "ratatui"]),
    // A daemon uses it as well as a terminal.
    ("gleaner-supervisor", &["clap", "indicatif", "ratatui", "wasmtime", "pyo3", "rustdds"]),
];

/// For each room of `host/src`, the rooms that it must not use, separated by spaces.
pub const ROOMS: &[(&str, &str)] = &[
    ("memory", "api guest input invoker live program replay schedule session_setup"),
    ("api", "guest input invoker live program replay schedule session_setup"),
    ("input", "guest invoker live program replay schedule session_setup"),
    ("isolation", "api guest input journal invoker live program replay schedule session_setup"),
    ("journal", "guest invoker live program replay schedule session_setup"),
    ("schedule", "guest invoker live program replay session_setup"),
    ("invoker", "live program replay schedule session_setup"),
    ("guest", "input invoker live program replay schedule session_setup"),
    ("session_setup", "invoker live program replay schedule"),
    ("replay", "live program"),
    ("live", "program replay"),
    ("network", "api guest input invoker live program replay schedule session_setup"),
    ("topics", "api guest input invoker live program replay schedule session_setup"),
];

/// Returns whether `file` declares unsafe code.
pub fn allows_unsafe(file: &File) -> bool {
    file.text
        .lines()
        .map(str::trim)
        .any(|line| line.starts_with('#') && line.contains("allow(unsafe_code"))
}

/// The lines of a Rust file with unsafe code, from 1.
pub fn unsafe_lines(file: &File) -> Vec<usize> {
    // Joined here, so that this file does not contain the patterns.
    let signs = ["{", "impl", "fn", "extern"].map(|what| ["unsafe", what].join(" "));
    let lines = code(&file.text).enumerate();
    lines
        .filter(|(_, line)| signs.iter().any(|sign| line.contains(sign.as_str())))
        .map(|(index, _)| index + 1)
        .collect()
}

/// The lines of a Rust file without the text after `//`; a good approximation of its code.
pub fn code(text: &str) -> impl Iterator<Item = &str> {
    text.lines().map(|line| line.split_once("//").map_or(line, |(code, _)| code))
}

/// The room of `host/src` that a file belongs to: `guest` for `host/src/guest/mod.rs`.
pub fn room_of(path: &str) -> Option<&str> {
    let inside = path.strip_prefix("host/src/")?;
    let room = inside.split('/').next()?;
    Some(room.strip_suffix(".rs").unwrap_or(room))
}

/// The rooms of its crate that a Rust file uses, as in `crate::api::Session` or
/// `use crate::{api, input::Remap}`.
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

/// The first word of a path, or of each path in a group in braces.
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

/// The packages that a `Cargo.toml` depends on, on any platform, without those for tests.
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
    // An entry may rename the package; the package counts.
    let package = |(name, entry): (&String, &toml::Value)| {
        entry.get("package").and_then(toml::Value::as_str).unwrap_or(name).to_owned()
    };
    entries.map(package).collect()
}

/// The crates that are linked into `package` with all its features, without those for tests.
pub fn contents(package: &str) -> BTreeSet<String> {
    let mut cargo = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    cargo.args("tree --offline --all-features --edges normal --prefix none".split(' '));
    cargo.args(["--package", package]);
    let output = cargo.current_dir(root()).output().expect("cargo starts");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8_lossy(&output.stdout);
    text.lines().filter_map(|line| line.split(' ').next()).map(str::to_owned).collect()
}

//! The language stays plain: no openings without a subject, few discouraged words, short lines, and
//! one meaning for each type name.

use std::collections::BTreeMap;

use gleaner_tests::architecture::GENERATED;
use gleaner_tests::tree::{File, files};
use gleaner_tests::words::{Kind, SHARED_TYPES, findings, findings_in_texts, type_names};

/// Documentation of private items that opens without a subject. Lower it when you mend some.
const PRIVATE_OPENINGS_MAX: usize = 0;

/// Discouraged words in comments and pages: some are right where they stand. Lower it when you mend
/// some.
const WORDS_MAX: usize = 0;

const CODE_COLUMNS: usize = 100;

/// Columns of pages, but for tables and blocks.
const PAGE_COLUMNS: usize = 119;

fn written() -> Vec<File> {
    let mut files = files();
    // Without licences and code that others wrote.
    files.retain(|file| {
        file.is_one_of(&["rs", "py", "wit", "md"])
            && file.path != "THIRD_PARTY.md"
            && !GENERATED.contains(&file.path.as_str())
    });
    files
}

/// Fails if there are more than `allowed` findings of `kind`, and lists them.
#[track_caller]
fn at_most(allowed: usize, kind: Kind) {
    let mut found = Vec::new();
    for file in written() {
        let of_kind =
            findings(&file.path, &file.text).into_iter().filter(|finding| finding.kind == kind);
        found.extend(
            of_kind.map(|finding| format!("{}:{}: {}", file.path, finding.line, finding.what)),
        );
    }
    assert!(
        found.len() <= allowed,
        "{} places, {allowed} allowed: open with a noun or a verb, name the actor\n{}",
        found.len(),
        found.join("\n")
    );
}

#[test]
fn documentation_of_modules_opens_with_a_noun_or_a_verb() {
    at_most(0, Kind::ModuleOpening);
}

#[test]
fn documentation_of_public_items_opens_with_a_noun_or_a_verb() {
    at_most(0, Kind::PublicOpening);
}

#[test]
fn documentation_of_private_items_opens_no_worse_than_before() {
    at_most(PRIVATE_OPENINGS_MAX, Kind::PrivateOpening);
}

#[test]
fn discouraged_words_do_not_become_more() {
    at_most(WORDS_MAX, Kind::Word);
}

/// Folders of programs, whose texts users read.
const PROGRAMS: [&str; 13] = [
    "artifacts/",
    "base/",
    "cli/",
    "cloud/",
    "host/",
    "journal/",
    "lambda/",
    "orchestrator/",
    "pixels/",
    "protocol/",
    "report/",
    "spool/",
    "trust/",
];

#[test]
fn texts_of_programs_name_things() {
    let mut found = Vec::new();
    for file in written() {
        let is_test = ["/tests/", "/tests.rs", "/benches/"].iter().any(|it| file.path.contains(it));
        if is_test || !PROGRAMS.iter().any(|it| file.path.starts_with(it)) {
            continue;
        }
        let of_file = findings_in_texts(&file.text).into_iter().filter(|_| file.is_one_of(&["rs"]));
        found.extend(of_file.map(|it| format!("{}:{}: {}", file.path, it.line, it.what)));
    }
    // An error of the data interface: a lambda may compare it.
    found.retain(|it| !it.starts_with("host/src/api/inference.rs:"));
    assert!(found.is_empty(), "name the thing\n{}", found.join("\n"));
}

#[test]
fn texts_are_found_beside_comments_and_characters() {
    let text = r#"
        // "This is no text."
        fn a<'a>(it: &'a str) -> char { '"' }
        const A: &str = "it is no \"name\"";
        const B: &str = "there is no name; one is none of them";
        fn c() { print("who said that", '\'', "for now not", "a \
            digest is none") }
    "#;
    let found = findings_in_texts(text);
    let found: Vec<_> = found.iter().map(|it| (it.line, it.what.as_str())).collect();
    assert_eq!(found, [(4, " is no "), (6, "said"), (6, " for now"), (6, " is none")]);
}

#[test]
fn findings_are_of_the_kind_of_their_text() {
    let text = [
        "//! What is read.",
        "",
        "/// Whether it is.",
        "pub fn a() {}",
        "/// Who tells.",
        "fn b() {}",
        "// nobody, `told`",
        // In two parts, because this file is checked, too.
        concat!("let url = \"a//told\"; /", "/ anew"),
    ];
    let text = text.join("\n");
    let found = |path: &str, text: &str| {
        let all = findings(path, text).into_iter();
        all.map(|finding| (finding.line, finding.kind, finding.what)).collect::<Vec<_>>()
    };
    let expected = [
        (1, Kind::ModuleOpening, "What"),
        (3, Kind::PublicOpening, "Whether"),
        (5, Kind::PrivateOpening, "Who"),
        (5, Kind::Word, "tells"),
        (7, Kind::Word, "nobody"),
        (8, Kind::Word, "anew"),
    ];
    assert_eq!(
        found("a.rs", &text),
        expected.map(|(line, kind, what)| (line, kind, what.to_owned()))
    );
    let python = "\"\"\"What it is.\"\"\"\ndef f():\n    \"\"\"How to.\n\n    It tells.\"\"\"\n    x = 1  # said\n";
    let kinds: Vec<_> =
        found("a.py", python).into_iter().map(|(line, kind, _)| (line, kind)).collect();
    let expected =
        [(1, Kind::ModuleOpening), (3, Kind::PublicOpening), (5, Kind::Word), (6, Kind::Word)];
    assert_eq!(kinds, expected);
    assert_eq!(found("a.md", "It says.\n```\nit says\n```\n").len(), 1);
}

#[test]
fn lines_are_short_enough_to_read() {
    let mut problems = Vec::new();
    for file in written() {
        let is_page = file.is_one_of(&["md"]);
        let mut is_block = false;
        for (index, line) in file.text.lines().enumerate() {
            is_block ^= is_page && line.trim_start().starts_with("```");
            let start = line.trim_start();
            // The formatter leaves long texts in code as they are.
            let counts = match is_page {
                true => !is_block && !start.starts_with('|') && line.contains(' '),
                false => start.starts_with("//") || file.is_one_of(&["py", "wit"]),
            };
            let columns = if is_page { PAGE_COLUMNS } else { CODE_COLUMNS };
            if counts && line.chars().count() > columns {
                problems.push(format!("{}:{}: more than {columns} columns", file.path, index + 1));
            }
        }
    }
    assert!(problems.is_empty(), "\n{}", problems.join("\n"));
}

#[test]
fn a_type_name_has_one_meaning() {
    let mut places: BTreeMap<String, Vec<String>> = BTreeMap::new();
    for file in written().into_iter().filter(|file| file.is_one_of(&["rs"])) {
        for name in type_names(&file.text) {
            places.entry(name.to_owned()).or_default().push(file.path.clone());
        }
    }
    let repeated = places
        .iter()
        .filter(|(name, places)| places.len() >= 3 && !SHARED_TYPES.contains(&name.as_str()));
    let problems: Vec<_> = repeated
        .map(|(name, places)| format!("`{name}` is the name of types in {}", places.join(", ")))
        .collect();
    assert!(problems.is_empty(), "qualify the names by their room:\n{}", problems.join("\n"));
    for name in SHARED_TYPES {
        assert!(
            places.get(*name).is_some_and(|places| places.len() >= 3),
            "`{name}` is not shared any more"
        );
    }
}

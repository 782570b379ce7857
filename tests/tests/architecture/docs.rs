//! The pages are correct: links resolve, commands exist, code is quoted from tested files, and
//! documented output is real output.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::Write;
use std::path::Path;
use std::process::{Command, Stdio};

use gleaner_base::programs::InstalledPrograms;
use gleaner_lambda::Manifest;
use gleaner_lambda::manifest::GENERATED;
use gleaner_tests::markdown::{anchors, blocks, links};
use gleaner_tests::tree::{File, files};
use gleaner_tests::{program, root};

use super::none;

/// Pages whose Rust code is all quoted from files. Other pages show fragments of their own.
const EXCERPTS_ONLY: [&str; 4] =
    ["docs/first-rust.md", "docs/data.md", "docs/cookbook.md", "docs/errors.md"];

fn pages() -> Vec<File> {
    files()
        .into_iter()
        .filter(|file| file.is_one_of(&["md"]) && !file.path.starts_with("cli/src/new/"))
        .collect()
}

#[test]
fn every_link_leads_to_an_existing_file_and_heading() {
    let mut problems = Vec::new();
    let mut seen = 0;
    for page in pages() {
        let folder = root().join(&page.path).parent().expect("a page lies in a folder").to_owned();
        for (line, target) in links(&page.text) {
            if target.contains("://") {
                continue;
            }
            seen += 1;
            let (path, anchor) = target
                .split_once('#')
                .map_or((&*target, None), |(path, anchor)| (path, Some(anchor)));
            let file = if path.is_empty() { root().join(&page.path) } else { folder.join(path) };
            let known = || {
                fs::read_to_string(&file)
                    .is_ok_and(|text| anchors(&text).iter().any(|a| Some(&**a) == anchor))
            };
            if !file.exists() || anchor.is_some() && !known() {
                problems.push(format!("{}:{line}: `{target}` does not exist", page.path));
            }
        }
    }
    assert!(seen > 50, "{seen} links were found");
    none(problems);
}

#[test]
fn pages_and_headings_that_comments_of_toml_files_name_exist() {
    let mut problems = Vec::new();
    for file in files().into_iter().filter(|file| file.is_one_of(&["toml"])) {
        for line in file.text.lines().filter(|line| line.starts_with('#')) {
            let Some((before, after)) = line.split_once(".md") else { continue };
            let page = before.rsplit([' ', '(']).next().unwrap_or_default();
            // Comments of installed files name pages of `docs`.
            let page = page.replace("/usr/share/doc/gleaner/", "") + ".md";
            let pages = [root().join(&page), root().join("docs").join(&page)];
            let text = pages.iter().find_map(|page| fs::read_to_string(page).ok());
            let heading = after.strip_prefix(", \"").and_then(|rest| rest.split('"').next());
            let has_heading = |text: String| {
                heading.is_none_or(|heading| text.contains(&format!("# {heading}\n")))
            };
            if !text.is_some_and(has_heading) {
                problems.push(format!("{}: `{line}`: there is no such page", file.path));
            }
        }
    }
    none(problems);
}

#[test]
fn the_book_has_every_page_once_and_its_pages_link_to_files_and_pages_of_the_book() {
    let summary = fs::read_to_string(root().join("docs/SUMMARY.md")).expect("docs/SUMMARY.md");
    let chapters: Vec<_> =
        links(&summary).into_iter().map(|(_, target)| normal("docs", &target)).collect();
    let distinct: BTreeSet<_> = chapters.iter().cloned().collect();
    assert_eq!(distinct.len(), chapters.len(), "a page is twice in docs/SUMMARY.md");
    let mut problems = Vec::new();
    for page in pages() {
        if page.path.starts_with("docs/")
            && page.path != "docs/SUMMARY.md"
            && !distinct.contains(&page.path)
        {
            problems.push(format!("missing in docs/SUMMARY.md: {}", page.path));
        }
        if !distinct.contains(&page.path) {
            continue;
        }
        let folder = page.path.rsplit_once('/').map_or("", |(folder, _)| folder);
        for (line, target) in links(&page.text) {
            let to = normal(folder, target.split('#').next().unwrap_or_default());
            if target.contains("://") || target.starts_with('#') {
                continue;
            }
            // A book cannot show a folder, and does not render pages of others.
            if root().join(&to).is_dir() || to.ends_with(".md") && !distinct.contains(&to) {
                problems.push(format!(
                    "{}:{line}: `{target}` is not in the book; link to a file or a chapter",
                    page.path
                ));
            }
        }
    }
    none(problems);
}

/// Resolves `target` relative to `folder`, without `..`.
fn normal(folder: &str, target: &str) -> String {
    let mut parts: Vec<&str> = folder.split('/').filter(|part| !part.is_empty()).collect();
    for part in target.split('/').filter(|part| !part.is_empty() && *part != ".") {
        if part == ".." {
            parts.pop();
        } else {
            parts.push(part);
        }
    }
    parts.join("/")
}

#[test]
fn every_excerpt_is_in_the_file_that_it_names() {
    let mut problems = Vec::new();
    let mut seen = 0;
    for page in pages() {
        for block in blocks(&page.text) {
            let Some(file) = &block.file else {
                if block.language.starts_with("rust") && EXCERPTS_ONLY.contains(&&*page.path) {
                    problems
                        .push(format!("{}:{}: this excerpt names no file", page.path, block.line));
                }
                continue;
            };
            seen += 1;
            let text = fs::read_to_string(root().join(file)).unwrap_or_default();
            let lines: Vec<_> = text.lines().collect();
            let excerpt: Vec<_> = block.lines.iter().map(String::as_str).collect();
            if excerpt.is_empty()
                || !lines.windows(excerpt.len()).any(|window| indented_alike(window, &excerpt))
            {
                problems.push(format!("{}:{}: this is not in `{file}`", page.path, block.line));
            }
        }
    }
    assert!(seen >= 10, "{seen} excerpts were found");
    none(problems);
}

/// Returns whether the lines are equal, except for a common indentation of the first ones.
fn indented_alike(lines: &[&str], excerpt: &[&str]) -> bool {
    let indent = |line: &str| line.len() - line.trim_start().len();
    let shift = indent(lines[0]).saturating_sub(indent(excerpt[0]));
    let same = |(line, shown): (&&str, &&str)| {
        line.is_empty() && shown.is_empty() || line.get(shift..) == Some(shown)
    };
    lines.iter().zip(excerpt).all(same)
}

#[test]
fn complete_manifests_on_pages_are_valid() {
    let mut seen = 0;
    for page in pages() {
        for block in blocks(&page.text).into_iter().filter(|block| block.language == "toml") {
            let text = block.lines.join("\n");
            if text.contains("[lambda]") && text.contains("[schedule]") {
                let error =
                    Manifest::parse(&text, "lambda.toml").err().map(|error| error.to_string());
                assert_eq!(error, None, "{}:{}", page.path, block.line);
                seen += 1;
            }
        }
    }
    assert!(seen > 0);
}

#[test]
fn python_on_pages_compiles() {
    let mut python = Command::new(
        InstalledPrograms::find().and_then(|parts| parts.python(None)).expect("a Python"),
    );
    // A fragment may return or await outside of a function, so each is tried as a function body.
    let check = "import ast, json, sys, textwrap\n\
                 for name, text in json.load(sys.stdin):\n try:\n  try: ast.parse(text)\n  \
                 except SyntaxError: ast.parse('async def fragment():\\n' + \
                 textwrap.indent(text, ' '))\n except SyntaxError as error: print(name, error)";
    let mut shown = Vec::new();
    for page in pages() {
        for block in blocks(&page.text).into_iter().filter(|block| block.language == "python") {
            shown.push((format!("{}:{}", page.path, block.line), block.lines.join("\n")));
        }
    }
    assert!(shown.len() > 5, "{} blocks were found", shown.len());
    let mut child = python
        .args(["-c", check])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .expect("Python starts");
    let json = serde_json::to_vec(&shown).expect("texts are JSON");
    child.stdin.take().expect("a pipe").write_all(&json).expect("Python reads");
    let output = child.wait_with_output().expect("Python ends");
    assert!(output.status.success());
    assert_eq!(String::from_utf8_lossy(&output.stdout), "");
}

/// Commands that are passed on to another program.
const PASSED_ON: [&str; 2] = ["cloud", "play"];

#[test]
fn every_command_on_pages_exists_with_its_flags() {
    let mut helps = BTreeMap::new();
    let mut problems = Vec::new();
    let mut seen = 0;
    for page in pages() {
        for block in blocks(&page.text)
            .into_iter()
            .filter(|block| ["sh", "text"].contains(&&*block.language))
        {
            for line in &block.lines {
                let line = line.strip_prefix("$ ").unwrap_or(line);
                let command = line
                    .split(['#', '|', '>', ';'])
                    .next()
                    .unwrap_or_default()
                    .replace(['[', ']'], " ");
                let mut words = command.split_whitespace().peekable();
                if words.next() != Some("gleaner") {
                    continue;
                }
                seen += 1;
                let mut name = words.next().unwrap_or_default().to_owned();
                // These have commands of their own.
                if ["clips", "keys", "tokens", "trust", "users", "vehicles"].contains(&&*name)
                    && let Some(second) = words.next_if(|word| !word.starts_with("--"))
                {
                    name = format!("{name} {second}");
                }
                let help = helps.entry(name.clone()).or_insert_with(|| help(&name));
                match help {
                    None => {
                        problems.push(format!("{}: `gleaner {name}` does not exist", page.path))
                    }
                    // The arguments are those of another program, which may not be built.
                    Some(_) if PASSED_ON.contains(&&*name) => {}
                    Some(help) => {
                        let flags = words.filter(|word| word.starts_with("--"));
                        let flags =
                            flags.filter_map(|flag| flag.split('=').next().map(str::to_owned));
                        let lacking = flags.filter(|flag| {
                            !help.split([' ', ',', '\n', '=']).any(|word| word == flag)
                        });
                        problems.extend(
                            lacking.map(|flag| {
                                format!("{}: `gleaner {name}` has no {flag}", page.path)
                            }),
                        );
                    }
                }
            }
        }
    }
    assert!(seen > 40, "{seen} commands were found");
    none(problems);
}

/// The output of `gleaner NAME --help`; `None` if there is no such command.
fn help(name: &str) -> Option<String> {
    if name.starts_with("--") {
        return Some(name.to_owned());
    }
    if PASSED_ON.contains(&name) {
        return Some(String::new());
    }
    let output = Command::new(program("gleaner")).args(name.split(" ")).arg("--help").output();
    let output = output.expect("gleaner starts");
    output.status.success().then(|| String::from_utf8_lossy(&output.stdout).into_owned())
}

#[test]
fn every_recipe_is_in_the_book_with_its_output() {
    let book = fs::read_to_string(root().join("docs/cookbook.md")).expect("docs/cookbook.md");
    for folder in fs::read_dir(root().join("examples/cookbook")).expect("a cookbook") {
        let folder = folder.expect("it can be listed").path();
        let Ok(expected) = fs::read_to_string(folder.join("expected.txt")) else { continue };
        let name = folder.file_name().unwrap().to_string_lossy();
        assert!(
            book.contains(&format!("](../examples/cookbook/{name}/lambda.toml)")),
            "{name} is missing in docs/cookbook.md"
        );
        let transcript = format!("```text\n$ {}\n```", expected.trim_end());
        assert!(book.contains(&transcript), "docs/cookbook.md should contain:\n{transcript}");
    }
}

#[test]
fn files_generated_from_the_manifests_types_are_up_to_date() {
    for file in GENERATED {
        let now = fs::read_to_string(root().join(file.path)).expect(file.path);
        let text = file.text(&now).unwrap_or_else(|why| panic!("{why}"));
        assert!(text == now, "run `cargo xtask bless`, which writes {}", file.path);
    }
}

#[test]
fn every_file_that_a_recipe_for_changes_names_exists() {
    let page = fs::read_to_string(root().join("CONTRIBUTING.md")).expect("CONTRIBUTING.md");
    let (mut seen, mut problems) = (0, Vec::new());
    for (index, line) in page.lines().enumerate() {
        // Every second part between backticks is code.
        for word in line.split('`').skip(1).step_by(2) {
            let is_file = Path::new(word)
                .extension()
                .is_some_and(|end| end.to_str().is_some_and(is_source_extension));
            if is_file || word.contains('/') && !word.contains(' ') {
                seen += 1;
                if !root().join(word).exists() {
                    problems
                        .push(format!("CONTRIBUTING.md:{}: `{word}` does not exist", index + 1));
                }
            }
        }
    }
    assert!(seen > 60, "{seen} files were found");
    none(problems);
}

#[test]
fn each_test_that_the_specification_names_is_in_the_file_that_it_names() {
    let page = fs::read_to_string(root().join("SPECIFICATION.md")).expect("SPECIFICATION.md");
    let (mut text, mut seen, mut problems) = (String::new(), 0, Vec::new());
    for (index, line) in page.lines().enumerate() {
        if let Some((_, file)) = links(line).into_iter().find(|(_, file)| file.ends_with(".rs")) {
            text = fs::read_to_string(root().join(file)).unwrap_or_default();
        }
        // Every second part between backticks is code.
        let code = line.split('`').skip(1).step_by(2);
        for name in code.filter(|word| word.contains('_') && !word.contains(['/', '='])) {
            seen += 1;
            if !text.contains(&format!("fn {name}(")) && !text.contains(&format!("\"{name}\"")) {
                problems.push(format!("SPECIFICATION.md:{}: there is no `{name}`", index + 1));
            }
        }
    }
    assert!(seen > 20, "{seen} tests were found");
    none(problems);
}

fn is_source_extension(end: &str) -> bool {
    ["css", "js", "md", "py", "rs", "sh", "toml", "txt", "wit"].contains(&end)
}

#[test]
fn the_book_does_not_leave_the_checkout() {
    let book = fs::read_to_string(root().join("docs/book.toml")).expect("docs/book.toml");
    let book: toml::Table = book.parse().expect("TOML");
    assert!(Path::new(book["build"]["build-dir"].as_str().expect("a folder")).is_relative());
}

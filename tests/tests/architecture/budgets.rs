//! The checkout stays within its budgets, which only go down.

use std::collections::{BTreeMap, BTreeSet};

use gleaner_tests::architecture::{GENERATED, rooms_named};
use gleaner_tests::budgets::{CIRCLES, LINES, LONG_FUNCTIONS};
use gleaner_tests::tree::{File, files};

/// Lines by which a budget may lie above what there is.
const SLACK: usize = 100;

fn sources(extensions: &[&str]) -> Vec<File> {
    let files = files().into_iter().filter(|file| file.is_one_of(extensions));
    files.filter(|file| !GENERATED.contains(&file.path.as_str())).collect()
}

/// Lines of a file: of its source, and of its tests.
fn lines(file: &File) -> (usize, usize) {
    let all = file.text.lines().count();
    let is_test = file.path.contains("/tests/") || file.path.ends_with("/tests.rs");
    let of_source = file.text.lines().position(|line| line == "#[cfg(test)]");
    match of_source {
        _ if is_test => (0, all),
        Some(source) if file.text.contains("\nmod tests {") => (source, all - source),
        _ => (all, 0),
    }
}

#[test]
fn rooms_have_no_more_lines_than_their_budgets() {
    let mut found = BTreeMap::<_, (usize, usize)>::new();
    for file in sources(&["rs", "py"]) {
        let room = file.path.split('/').next().unwrap_or_default().to_owned();
        let (source, tests) = lines(&file);
        let sum = found.entry(room).or_default();
        *sum = (sum.0 + source, sum.1 + tests);
    }
    let fits = |found: usize, budget: usize| found <= budget && budget <= found + SLACK;
    let is_kept = |room: &str, (source, tests): (usize, usize)| {
        let listed = LINES.iter().find(|(listed, ..)| *listed == room);
        listed.is_some_and(|(_, of_source, of_tests)| {
            fits(source, *of_source) && fits(tests, *of_tests)
        })
    };
    let wrong: Vec<_> = found
        .iter()
        .filter(|(room, lines)| !is_kept(room, **lines))
        .map(|(room, (source, tests))| format!("    (\"{room}\", {source}, {tests}),"))
        .collect();
    let help = "above the budget, shorten something; below, lower it in tests/src/budgets.rs";
    assert!(wrong.is_empty(), "{help}:\n{}", wrong.join("\n"));
    assert_eq!(found.len(), LINES.len(), "a folder was removed, and its budget not");
}

#[test]
fn long_functions_are_those_listed() {
    // In two pieces, so that this file does not hold what it looks for.
    let expected = ["expect(clippy::", "too_many_lines"].concat();
    let found: Vec<_> = sources(&["rs"])
        .into_iter()
        .filter(|file| file.text.contains(&expected))
        .map(|file| file.path)
        .collect();
    assert_eq!(found, LONG_FUNCTIONS, "split the function, or remove the file from the list");
}

/// Modules at the top of each crate, with those that they use, by the folder of the crate.
fn uses() -> BTreeMap<String, BTreeMap<String, BTreeSet<String>>> {
    let mut crates = BTreeMap::<_, BTreeMap<_, BTreeSet<String>>>::new();
    for file in sources(&["rs"]) {
        let Some((folder, path)) = file.path.split_once("/src/") else { continue };
        let module = path.split('/').next().unwrap_or_default().trim_end_matches(".rs");
        let own = crates.entry(folder.to_owned()).or_default();
        own.entry(module.to_owned()).or_default().extend(rooms_named(&file.text));
    }
    crates
}

/// Pairs of modules in a circle: the first uses the second, which uses it over any others.
fn circles(uses: &BTreeMap<String, BTreeSet<String>>) -> Vec<(&str, &str)> {
    let used_by = |module: &str| uses.get(module).into_iter().flatten().map(String::as_str);
    let leads = |from: &str, to: &str| {
        let (mut seen, mut waiting) = (BTreeSet::new(), vec![from.to_owned()]);
        while let Some(module) = waiting.pop() {
            if module == to {
                return true;
            }
            if seen.insert(module.clone()) {
                waiting.extend(used_by(&module).map(str::to_owned));
            }
        }
        false
    };
    let pairs = uses.keys().flat_map(|from| used_by(from).map(move |to| (from.as_str(), to)));
    pairs.filter(|(from, to)| from != to && uses.contains_key(*to) && leads(to, from)).collect()
}

#[test]
fn no_more_modules_use_each_other_in_a_circle() {
    let uses = uses();
    let found = uses.iter().map(|(folder, uses)| (folder.as_str(), circles(uses)));
    let found: Vec<_> = found.filter(|(_, pairs)| !pairs.is_empty()).collect();
    let counts: Vec<_> = found.iter().map(|(folder, pairs)| (*folder, pairs.len())).collect();
    assert_eq!(counts, CIRCLES, "the pairs are: {found:#?}");
}

#[test]
fn a_circle_is_found_over_other_modules() {
    let uses = [("a", "b"), ("b", "c"), ("c", "a"), ("d", "a")];
    let uses = uses.map(|(from, to)| (from.to_owned(), BTreeSet::from([to.to_owned()])));
    assert_eq!(circles(&uses.into()), [("a", "b"), ("b", "c"), ("c", "a")]);
}

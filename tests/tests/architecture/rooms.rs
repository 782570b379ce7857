//! The house is in order: rooms name only those they may, unsafe code is at its addresses, files
//! stay readable, nothing of one machine is written down, and twins are declared alike.

use std::collections::BTreeSet;

use gleaner_lambda::Manifest;
use gleaner_tests::architecture::{
    CRATES, GENERATED, ROOMS, UNSAFE_FILES, WITHOUT, allows_unsafe, code, contents, dependencies,
    room_of, rooms_named, unsafe_lines,
};
use gleaner_tests::budgets::CRATES_MAX;
use gleaner_tests::tree::{File, files};

use super::none;

/// A longer file is split: it should be readable without opening five others, and in one sitting.
const LINES_MAX: usize = 500;

fn rust_files() -> Vec<File> {
    files().into_iter().filter(|file| file.is_one_of(&["rs"])).collect()
}

fn toml_of(path: &str) -> toml::Table {
    let file = files()
        .into_iter()
        .find(|file| file.path == path)
        .unwrap_or_else(|| panic!("there is no `{path}`"));
    file.text.parse().unwrap_or_else(|error| panic!("`{path}` is no TOML: {error}"))
}

#[test]
fn the_files_that_allow_unsafe_code_are_those_listed() {
    let found: Vec<_> =
        rust_files().into_iter().filter(allows_unsafe).map(|file| file.path).collect();
    assert_eq!(
        found, UNSAFE_FILES,
        "found on the left, listed in tests/src/architecture.rs on the right"
    );
}

#[test]
fn there_is_no_unsafe_code_outside_of_those_files() {
    let outside =
        rust_files().into_iter().filter(|file| !UNSAFE_FILES.contains(&file.path.as_str()));
    none(
        outside
            .flat_map(|file| {
                unsafe_lines(&file).into_iter().map(move |line| format!("{}:{line}", file.path))
            })
            .collect(),
    );
}

#[test]
fn crates_depend_only_on_the_crates_they_may() {
    let mut seen = BTreeSet::new();
    let mut problems = Vec::new();
    for file in files().iter().filter(|file| file.path.ends_with("/Cargo.toml")) {
        let manifest = toml_of(&file.path);
        let name = manifest["package"]["name"].as_str().unwrap_or_default();
        let name = name.strip_prefix("gleaner-").unwrap_or_default();
        let Some((_, allowed)) = CRATES.iter().find(|(listed, _)| *listed == name) else {
            let is_product = file.path.starts_with("host/");
            problems.extend(is_product.then(|| format!("gleaner-{name} is not in the list")));
            continue;
        };
        let dependencies = dependencies(&manifest);
        let ours = dependencies.iter().filter_map(|package| package.strip_prefix("gleaner-"));
        let forbidden = ours.filter(|package| !allowed.split(' ').any(|it| it == *package));
        problems.extend(
            forbidden.map(|package| format!("gleaner-{name} depends on gleaner-{package}")),
        );
        seen.insert(name.to_owned());
    }
    none(problems);
    let listed: BTreeSet<_> = CRATES.iter().map(|(name, _)| (*name).to_owned()).collect();
    assert_eq!(seen, listed, "a crate was renamed or removed");
}

#[test]
fn buffers_depend_on_nothing_but_the_standard_library() {
    let manifest = toml_of("host/buffers/Cargo.toml");
    let needs = dependencies(&manifest);
    assert!(needs.iter().all(|package| package == "loom"), "{needs:?}");
    let always = manifest["dependencies"].as_table().map_or(0, toml::Table::len);
    assert_eq!(always, 0, "loom is for `cfg(loom)` only");
}

/// They travel with the SDK into the folder of every new lambda, and into its component.
#[test]
fn rules_depend_on_nothing_but_the_standard_library() {
    let manifest = toml_of("rules/Cargo.toml");
    assert_eq!(dependencies(&manifest), BTreeSet::new());
}

#[test]
fn crates_do_without_what_they_should_not_link() {
    let mut problems = Vec::new();
    for (package, without) in WITHOUT {
        let contents = contents(package);
        let found = without.iter().filter(|name| contents.contains(**name));
        problems.extend(found.map(|name| format!("{package} has {name}")));
    }
    none(problems);
    assert!(
        contents("gleaner-compile").contains("cranelift-codegen"),
        "these tests look for the wrong names"
    );
}

#[test]
fn rooms_of_the_host_name_only_those_they_may() {
    let mut problems = Vec::new();
    for file in rust_files() {
        let Some(room) = room_of(&file.path) else { continue };
        let Some((_, forbidden)) = ROOMS.iter().find(|(listed, _)| *listed == room) else {
            continue;
        };
        let named = rooms_named(&file.text);
        // A step up from the door of a room leads into the crate, which has a plainer name.
        let sideways =
            |other: &&str| code(&file.text).any(|line| line.contains(&format!("super::{other}::")));
        let found = forbidden.split(' ').filter(|other| named.contains(*other) || sideways(other));
        problems.extend(found.map(|other| format!("{} names `{other}`", file.path)));
    }
    none(problems);
}

#[test]
fn nothing_outside_of_guest_knows_the_webassembly_engine() {
    let may = |path: &str| path == "host/src/program.rs" || path.starts_with("host/src/guest/");
    let others = rust_files()
        .into_iter()
        .filter(|file| file.path.starts_with("host/src/") && !may(&file.path));
    none(
        others
            .filter(|file| code(&file.text).any(|line| line.contains("wasmtime")))
            .map(|file| file.path)
            .collect(),
    );
}

#[test]
fn files_are_short_enough_to_be_read() {
    let ours = files().into_iter().filter(|file| file.is_one_of(&["css", "js", "py", "rs", "wit"]));
    let ours = ours.filter(|file| !GENERATED.contains(&file.path.as_str()));
    let lengths = ours.map(|file| (file.text.lines().count(), file.path));
    none(
        lengths
            .filter(|(lines, _)| *lines >= LINES_MAX)
            .map(|(lines, path)| format!("{path}: {lines} lines"))
            .collect(),
    );
}

#[test]
fn nothing_of_one_machine_is_written_down() {
    // In two pieces each, so that this file does not hold what it looks for.
    let homes = [("/wo", "rk/"), ("/ro", "ot/"), ("/ho", "me/")];
    let hosts = [("crates", ".io"), ("py", "pi.org"), ("python", "hosted.org"), ("npm", "js.org")];
    let mut problems = Vec::new();
    // Cargo writes its own names into the lock file; the next test looks at them.
    for file in files().iter().filter(|file| file.path != "Cargo.lock") {
        for (index, line) in file.text.lines().enumerate() {
            let home = homes.iter().any(|(a, b)| begins_a_path(line, &format!("{a}{b}")));
            let host = hosts.iter().any(|(a, b)| line.contains(&format!("{a}{b}")));
            if home || host {
                problems.push(format!("{}:{}: {line}", file.path, index + 1));
            }
        }
    }
    none(problems);
}

/// Returns whether `line` has an absolute path that begins with `home`. Tests use the user `u`,
/// which does not exist.
fn begins_a_path(line: &str, home: &str) -> bool {
    let inside_a_path = |c: char| c.is_alphanumeric() || "_-.}".contains(c);
    let places = line.match_indices(home);
    let mut real = places.filter(|(at, home)| {
        !line[..*at].ends_with(inside_a_path) && !is_user_u(&line[at + home.len()..])
    });
    real.next().is_some()
}

fn is_user_u(rest: &str) -> bool {
    rest.strip_prefix('u').is_some_and(|rest| !rest.starts_with(|c: char| c.is_alphanumeric()))
}

#[test]
fn every_foreign_crate_comes_from_the_one_public_registry() {
    let lock = toml_of("Cargo.lock");
    let packages = lock["package"].as_array().expect("Cargo.lock lists packages");
    let sources: BTreeSet<_> =
        packages.iter().filter_map(|package| package.get("source")?.as_str()).collect();
    let one = ["registry+https://github.com/rust-lang/", "crates", ".io-index"].concat();
    assert_eq!(sources, BTreeSet::from([one.as_str()]));
}

#[test]
fn twins_are_declared_alike_but_for_kind_entry_and_limits() {
    let files = files();
    let manifest = |path: &str| files.iter().find(|file| file.path == path);
    let mut pairs = 0;
    for rust in files.iter().filter(|file| file.path.ends_with("/rust/lambda.toml")) {
        let python = rust.path.replace("/rust/", "/python/");
        match manifest(&python) {
            Some(python) => {
                assert_eq!(declared(rust), declared(python), "{} and {}", rust.path, python.path)
            }
            None => assert!(!rust.path.starts_with("examples/"), "`{python}` is missing"),
        }
        pairs += 1;
    }
    assert!(pairs >= 2, "where are the examples?");
}

/// The manifest of a twin without the keys that may differ.
fn declared(file: &File) -> serde_json::Value {
    let manifest = Manifest::parse(&file.text, &file.path)
        .unwrap_or_else(|error| panic!("{}: {error}", file.path));
    let mut json = manifest.to_json();
    json["lambda"]
        .as_object_mut()
        .expect("[lambda] is a table")
        .retain(|key, _| key != "kind" && key != "entry");
    json.as_object_mut().expect("a manifest is a table").remove("limits");
    json
}

// The search itself is tested, too: a blind rule finds nothing.

fn named_in(text: &str) -> Vec<String> {
    rooms_named(text).into_iter().collect()
}

#[test]
fn a_room_is_named_by_any_path_that_begins_at_the_crate() {
    assert_eq!(named_in("use crate::api::Session;"), ["api"]);
    assert_eq!(named_in("let x = crate::guest::wasm::new();"), ["guest"]);
    assert_eq!(
        named_in("use crate::{api::{Session, data}, guest,\n    input};"),
        ["api", "guest", "input"]
    );
    assert_eq!(named_in("pub(crate) fn x() {} // see crate::guest"), Vec::<String>::new());
    assert_eq!(named_in("use mycrate::guest; $crate::invoker!()"), Vec::<String>::new());
}

#[test]
fn unsafe_code_is_found_outside_of_comments() {
    let text = ["// unsafe", " { }\nlet x = unsafe", " { y };\nuns", "afe_code"].concat();
    let file = File { path: String::new(), text };
    assert_eq!(unsafe_lines(&file), [2]);
    assert!(!allows_unsafe(&file));
}

#[test]
fn dependencies_are_those_of_all_platforms_but_not_of_the_tests() {
    let manifest = "[dependencies]\na = '1'\nb = { package = 'c', version = '1' }\n[dev-dependencies]\nd = '1'\n\
                    [target.'cfg(loom)'.dependencies]\ne = { workspace = true }\n[build-dependencies]\nf = '1'";
    let found = dependencies(&manifest.parse().unwrap());
    assert_eq!(found.into_iter().collect::<Vec<_>>(), ["a", "c", "e", "f"]);
}

#[test]
fn crates_are_few_and_named_like_their_folders() {
    let files = files();
    let is_counted = |folder: &&str| {
        !folder.starts_with("bench")
            && !folder.starts_with("examples/")
            && !folder.contains("/lambdas/")
    };
    let folders = files.iter().filter_map(|file| file.path.strip_suffix("/Cargo.toml"));
    let folders: Vec<_> = folders.filter(is_counted).collect();
    assert!(folders.len() <= CRATES_MAX, "{} crates: {folders:?}", folders.len());
    let name = |folder: &str| {
        let name = &toml_of(&format!("{folder}/Cargo.toml"))["package"]["name"];
        name.as_str().unwrap_or_default().trim_start_matches("gleaner-").to_owned()
    };
    let others = folders.iter().filter(|it| !it.ends_with(&name(it)) && **it != "guest-sdk-rust");
    none(others.map(|folder| format!("{folder} has the crate {}", name(folder))).collect());
}

#[test]
fn modules_are_the_files_in_their_folders() {
    // In two pieces, so that this file does not hold what it looks for.
    let attribute = ["#[", "path"].concat();
    let outside = rust_files().into_iter().filter(|file| file.text.contains(&attribute));
    none(outside.map(|file| format!("{} has a module of another folder", file.path)).collect());
}

/// A file that no module declares is compiled nowhere, and its tests do not run.
#[test]
fn every_file_is_declared_as_a_module_or_is_a_root() {
    let all = rust_files();
    let text = |path: &str| all.iter().find(|file| file.path == path).map(|file| &*file.text);
    let roots: BTreeSet<String> = files()
        .iter()
        .filter(|file| file.path.ends_with("Cargo.toml"))
        .flat_map(|file| {
            let folder = file.path.trim_end_matches("Cargo.toml").to_owned();
            let named =
                file.text.split("path = \"").skip(1).filter_map(|rest| rest.split('"').next());
            let named: Vec<_> = named.map(|path| folder.clone() + path).collect();
            let usual = ["build.rs", "src/lib.rs", "src/main.rs"].map(|path| folder.clone() + path);
            named.into_iter().chain(usual)
        })
        .collect();
    let is_declared = |path: &str| {
        let (folder, name) = path.rsplit_once('/').unwrap_or(("", path));
        let (folder, module) = match name {
            "mod.rs" | "main.rs" => folder.rsplit_once('/').unwrap_or(("", folder)),
            _ => (folder, name.trim_end_matches(".rs")),
        };
        // Cargo finds these by their folder.
        if ["/tests", "/examples", "/benches", "/bin"].iter().any(|it| folder.ends_with(it)) {
            return true;
        }
        let declared = format!("mod {module};");
        let in_folder = all.iter().filter(|file| {
            file.path
                .strip_prefix(folder)
                .and_then(|rest| rest.strip_prefix('/'))
                .is_some_and(|rest| !rest.contains('/') && file.path != path)
        });
        let parent = text(&format!("{folder}.rs"));
        in_folder.map(|file| &*file.text).chain(parent).any(|text| text.contains(&declared))
    };
    let orphans = all.iter().filter(|file| !roots.contains(&file.path) && !is_declared(&file.path));
    none(orphans.map(|file| format!("{} is in no module", file.path)).collect());
}

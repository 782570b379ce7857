//! `cargo xtask full`: runs every part of `.ci/run`, and records the heavy ones in `.ci/full.json`:
//! for each the digest of the sources that it tests. `.ci/run` then runs a heavy part only if its
//! sources have another digest.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs;
use std::path::Path;

use gleaner_base::{Exit, Failure};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use crate::checkout::Checkout;
use crate::metadata::Metadata;
use crate::setup::PROGRAMS;
use crate::steps::{self, cannot};

/// File of the records, relative to the checkout.
const FILE: &str = ".ci/full.json";

/// A part of `.ci/run` that takes minutes, and whose result depends only on some of the sources.
struct HeavyPart {
    name: &'static str,
    /// Packages whose programs it runs, beside the installed programs; with their dependencies in
    /// the workspace.
    packages: &'static [&'static str],
    has_programs: bool,
    /// Further files and folders that it reads, relative to the checkout.
    files: &'static [&'static str],
    /// Least number of its results, their unit, and the text in each line of its output that is
    /// counted.
    counted: (usize, &'static str, &'static str),
    /// True if it only installs what tests need, and they are of the last part.
    tests_follow: bool,
}

const HEAVY: [HeavyPart; 8] = [
    HeavyPart {
        name: "lints: gleaner-host and gleaner-cloud with fewer features",
        packages: &["gleaner-cloud", "gleaner-host"],
        has_programs: false,
        files: &["clippy.toml"],
        counted: (4, "kinds checked", "Finished "),
        tests_follow: false,
    },
    HeavyPart {
        name: "peers, on Cyclone DDS and Fast DDS",
        packages: &["gleaner-tests"],
        has_programs: true,
        files: &["xtask/src/peers.rs", "examples", "tests/lambdas", "guest-sdk-python/gleaner"],
        counted: (1, "steps", "] "),
        tests_follow: true,
    },
    HeavyPart {
        name: "page, in a browser",
        packages: &["gleaner-cloud"],
        has_programs: false,
        files: &["xtask/src/page.rs"],
        counted: (19, "flows", "ok "),
        tests_follow: false,
    },
    HeavyPart {
        name: "models, by the tests of ONNX",
        packages: &["gleaner-inference"],
        has_programs: false,
        files: &["docs/models.md", "tests/models", "xtask/src/models.rs"],
        counted: (2, "backends", " right "),
        tests_follow: false,
    },
    HeavyPart {
        name: "benches, quick",
        packages: &["gleaner-bench"],
        has_programs: true,
        files: &["bench", "examples", "guest-sdk-python/gleaner", "xtask/src/bench.rs"],
        counted: (9, "benches measured", ": measured"),
        tests_follow: false,
    },
    HeavyPart {
        name: "benches, quick: fleet",
        packages: &["gleaner-bench", "gleaner-cloud"],
        has_programs: false,
        files: &["xtask/src/bench.rs"],
        counted: (1, "measurements", "| "),
        tests_follow: false,
    },
    HeavyPart {
        name: "cloud of three replicas, with kills",
        packages: &["gleaner-bench", "gleaner-cloud"],
        has_programs: false,
        files: &["xtask/src/fleet", "xtask/src/private_folder.rs"],
        counted: (4, "kills", "kill "),
        tests_follow: true,
    },
    HeavyPart {
        name: "demo, with a cloud",
        packages: &["gleaner-player"],
        has_programs: true,
        files: &[
            "examples",
            "guest-sdk-python/gleaner",
            "xtask/src/demo",
            "xtask/src/examples.rs",
            "xtask/src/onnxruntime.rs",
            "xtask/src/private_folder.rs",
        ],
        counted: (1, "verified clips", "signed by the vehicle"),
        tests_follow: false,
    },
];

/// Files and folders on which every part depends: `.ci/run` has the commands of all.
const COMMON: [&str; 14] = [
    ".cargo/config.toml",
    ".ci/run",
    "Cargo.lock",
    "Cargo.toml",
    "guest-sdk-python/LICENSE",
    "guest-sdk-python/pyproject.toml",
    "rust-toolchain.toml",
    "wit",
    "xtask/Cargo.toml",
    "xtask/src/checkout.rs",
    "xtask/src/main.rs",
    "xtask/src/setup.rs",
    "xtask/src/steps.rs",
    "xtask/src/venv.rs",
];

/// Tests of the source itself and their lists, on which no part depends.
const HOUSE: [&str; 4] = [
    "tests/src/budgets.rs",
    "tests/src/architecture.rs",
    "tests/src/words.rs",
    "tests/tests/architecture",
];

#[derive(Debug, Serialize, Deserialize)]
struct Record {
    digest: String,
    commit: String,
    seconds: u64,
    cpu_seconds: u64,
    result: String,
}

type PartRecords = BTreeMap<String, Record>;

/// Runs all parts, and writes their records.
pub(crate) fn full(checkout: &Checkout) -> Result<Exit, Failure> {
    let changed = git(checkout, &["status", "--porcelain", "--untracked-files=all"])?;
    if !changed.is_empty() {
        let message = format!("a record names a commit, and there are other changes:\n{changed}");
        return Err(Failure::new(Exit::Usage, message).with_help("commit them first"));
    }
    let state = || Ok::<_, Failure>((git(checkout, &["rev-parse", "HEAD"])?, digests(checkout)?));
    let tested = state()?;
    let results = checkout.target().join("full");
    // Those of an earlier run would count if this one ended before it wrote its own.
    steps::remove_folder(&results)?;
    steps::make_folder(&results)?;
    let mut run = checkout.script(checkout.path(".ci/run"));
    let ended = steps::run(
        run.arg("--full").arg(&results),
        "see the first error above; parts that ended before it are recorded",
    );
    if state()? != tested {
        let message = "the sources have changed during the run: nothing is recorded";
        return Err(Failure::new(Exit::Differs, message).with_help("run it again"));
    }
    write(checkout, &results, &tested, ended.is_ok())?;
    ended.map(|()| Exit::Ok)
}

fn git(checkout: &Checkout, arguments: &[&str]) -> Result<String, Failure> {
    let mut git = checkout.command("git");
    Ok(steps::output(git.args(arguments), "run it in a checkout")?.trim().to_owned())
}

/// The digest of the sources of each part, by its name.
fn digests(checkout: &Checkout) -> Result<BTreeMap<&'static str, String>, Failure> {
    let sources = CheckoutSources::read(checkout)?;
    HEAVY.iter().map(|part| Ok((part.name, sources.digest(checkout, part)?))).collect()
}

/// Writes the records of the parts in `results`, which were tested at this commit with these
/// digests; those of other parts stay. After a run that failed, those of parts whose tests are in
/// the last part of the run stay, too.
fn write(
    checkout: &Checkout,
    results: &Path,
    (commit, digests): &(String, BTreeMap<&'static str, String>),
    has_passed: bool,
) -> Result<(), Failure> {
    let mut records = read(checkout)?;
    records.retain(|name, _| digests.contains_key(name.as_str()));
    for part in HEAVY.iter().filter(|part| has_passed || !part.tests_follow) {
        let Some((seconds, cpu_seconds, result)) = part.result(results)? else { continue };
        let (digest, commit) = (digests[part.name].clone(), commit.clone());
        let record = Record { digest, commit, seconds, cpu_seconds, result };
        records.insert(part.name.to_owned(), record);
    }
    save(checkout, &records)
}

fn save(checkout: &Checkout, records: &PartRecords) -> Result<(), Failure> {
    let json = serde_json::to_string_pretty(records)
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot write records", &error))?;
    let file = checkout.path(FILE);
    fs::write(&file, json + "\n").map_err(|error| cannot("write", &file, &error))?;
    println!("wrote {FILE}; commit it");
    Ok(())
}

/// After a change of the rule which files a part depends on, writes the digests of the parts of
/// which no such file has changed since the commit of their records. If one has, the exit code is
/// [`Exit::Differs`].
fn renew(checkout: &Checkout) -> Result<Exit, Failure> {
    let sources = CheckoutSources::read(checkout)?;
    let mut records = read(checkout)?;
    let mut exit = Exit::Ok;
    for part in &HEAVY {
        let Some(record) = records.get_mut(part.name) else { continue };
        let changed = git(checkout, &["diff", "--name-only", "--no-renames", &record.commit])?;
        let is_used = sources.used_by(part);
        match changed.lines().find(|path| is_used(path)) {
            Some(path) => {
                println!("not renewed: `{}`, as {path} has changed", part.name);
                exit = Exit::Differs;
            }
            None => record.digest = sources.digest(checkout, part)?,
        }
    }
    save(checkout, &records)?;
    Ok(exit)
}

fn read(checkout: &Checkout) -> Result<PartRecords, Failure> {
    let file = checkout.path(FILE);
    match fs::read_to_string(&file) {
        Ok(text) => serde_json::from_str(&text).map_err(|error| cannot("read", &file, &error)),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(PartRecords::new()),
        Err(error) => Err(cannot("read", &file, &error)),
    }
}

/// Prints the record of a part as a row of the table of `.ci/run`, if its sources are the same as
/// then; otherwise the exit code is [`Exit::Differs`]. With the file of its output, counts the
/// results in that. `--renew` writes digests by a new rule.
pub(crate) fn print(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let name = arguments.first().and_then(|name| name.to_str()).unwrap_or_default();
    if name == "--renew" {
        return renew(checkout);
    }
    let Some(part) = HEAVY.iter().find(|part| part.name == name) else {
        return Err(Failure::new(Exit::Usage, format!("there is no heavy part `{name}`")));
    };
    if let Some(output) = arguments.get(1) {
        println!("{}", part.count(Path::new(output))?);
        return Ok(Exit::Ok);
    }
    let records = read(checkout)?;
    let Some(record) = records.get(name) else {
        eprintln!("`{name}` has no record in {FILE}");
        return Ok(Exit::Differs);
    };
    if CheckoutSources::read(checkout)?.digest(checkout, part)? != record.digest {
        eprintln!("the sources of `{name}` have changed since {}", record.commit);
        return Ok(Exit::Differs);
    }
    let Record { commit, seconds, cpu_seconds, result, .. } = record;
    println!("{name:<44} {seconds:>7} {cpu_seconds:>7}  of {commit:.8}: {result}");
    Ok(Exit::Ok)
}

impl HeavyPart {
    /// The seconds, CPU seconds and counts of this part in a run whose results are in `folder`;
    /// `None` if the run ended before it.
    fn result(&self, folder: &Path) -> Result<Option<(u64, u64, String)>, Failure> {
        let [table, output] = ["parts", self.name].map(|name| folder.join(name));
        let table = fs::read_to_string(&table).map_err(|error| cannot("read", &table, &error))?;
        // Another part may have a longer name that begins alike.
        let mut rows = table.lines().filter_map(|row| row.strip_prefix(self.name));
        let Some(row) = rows.find(|rest| rest.starts_with(' ')) else { return Ok(None) };
        let mut numbers = row.split_whitespace().filter_map(|number| number.parse().ok());
        let (Some(seconds), Some(cpu_seconds)) = (numbers.next(), numbers.next()) else {
            return Err(Failure::new(Exit::Internal, format!("no seconds in `{row}`")));
        };
        Ok(Some((seconds, cpu_seconds, self.count(&output)?)))
    }

    /// Counts the results in its output: a part that was skipped ends well, and has none.
    fn count(&self, output: &Path) -> Result<String, Failure> {
        let text = fs::read_to_string(output).map_err(|error| cannot("read", output, &error))?;
        let (least, unit, sign) = self.counted;
        let count = text.lines().filter(|line| line.contains(sign)).count();
        if count < least {
            let message = format!("`{}` ended with {count} {unit}, not {least}", self.name);
            return Err(Failure::new(Exit::Internal, message)
                .with_help(format!("see `{}`: it may have been skipped", output.display())));
        }
        Ok(format!("{count} {unit}"))
    }
}

/// The files of the checkout, and the packages of its workspace.
struct CheckoutSources {
    /// Paths of all files that git knows, relative to the checkout.
    files: Vec<String>,
    /// Folder of each package, relative to the checkout.
    folders: BTreeMap<String, String>,
    /// Packages of the workspace that a package depends on.
    dependencies: BTreeMap<String, Vec<String>>,
}

impl CheckoutSources {
    fn read(checkout: &Checkout) -> Result<Self, Failure> {
        let mut list = checkout.command("git");
        let files = steps::output(list.args(["ls-files", "-z"]), "run it in a checkout")?;
        let files = files.split('\0').filter(|path| !path.is_empty()).map(str::to_owned);
        let metadata = Metadata::read(checkout, "--no-deps")?;
        let root = checkout.path("");
        let mut sources = Self {
            files: files.collect(),
            folders: BTreeMap::new(),
            dependencies: BTreeMap::new(),
        };
        for package in metadata.packages {
            let folder = Path::new(&package.manifest_path).parent().unwrap_or(&root);
            let folder = folder.strip_prefix(&root).unwrap_or(folder);
            sources.folders.insert(package.name.clone(), folder.display().to_string());
            let own = package.dependencies.into_iter().filter(|it| it.path.is_some());
            sources.dependencies.insert(package.name, own.map(|it| it.name).collect());
        }
        Ok(sources)
    }

    /// Returns which files a part depends on.
    fn used_by<'s>(&'s self, part: &'s HeavyPart) -> impl Fn(&str) -> bool + use<'s> {
        let folders: BTreeSet<&str> = self.folders.values().map(String::as_str).collect();
        let used: BTreeSet<&str> =
            self.packages(part).iter().map(|name| self.folders[*name].as_str()).collect();
        move |path: &str| {
            let named = |name: &&str| Path::new(path).starts_with(name);
            // The innermost package that has the file.
            let package = Path::new(path).ancestors().skip(1).find_map(|folder| {
                let folder = folder.to_str()?;
                folders.contains(folder).then_some(folder)
            });
            let is_apart = path.ends_with(".md") || HOUSE.iter().any(&named);
            // Test programs of packages that it only links or starts are not among its programs.
            let is_test = |package: &str| {
                Path::new(path).starts_with(Path::new(package).join("tests"))
                    && !part.packages.iter().any(|name| self.folders[*name] == package)
            };
            package.is_some_and(|it| used.contains(it) && !is_apart && !is_test(it))
                || part.files.iter().chain(&COMMON).any(named)
        }
    }

    /// The digest of all files on which a part depends.
    fn digest(&self, checkout: &Checkout, part: &HeavyPart) -> Result<String, Failure> {
        let is_used = self.used_by(part);
        let mut digest = Sha256::new();
        for path in self.files.iter().filter(|path| is_used(path)) {
            let file = checkout.path(path);
            let bytes = fs::read(&file).map_err(|error| cannot("read", &file, &error))?;
            digest.update(format!("{path}\0{}\0", bytes.len()));
            digest.update(&bytes);
        }
        Ok(digest.finalize().iter().map(|byte| format!("{byte:02x}")).collect())
    }

    /// The packages of a part, with those that they depend on.
    fn packages(&self, part: &HeavyPart) -> BTreeSet<&str> {
        let mut waiting: Vec<&str> = part.packages.to_vec();
        if part.has_programs {
            waiting.extend(PROGRAMS);
        }
        let mut found = BTreeSet::new();
        while let Some(name) = waiting.pop() {
            if found.insert(name) {
                waiting.extend(self.dependencies[name].iter().map(String::as_str));
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    #[test]
    fn the_heavy_parts_are_those_of_the_script() {
        let script = include_str!("../../.ci/run");
        let named = script.lines().filter_map(|line| line.strip_prefix("heavy \""));
        let named: Vec<_> = named.filter_map(|rest| rest.split('"').next()).collect();
        assert_eq!(named, HEAVY.map(|part| part.name));
    }

    #[test]
    fn a_part_that_stays_stale_is_a_failure() {
        let folder = TestFolder::new();
        // A workspace of one package.
        let cargo = r#"#!/bin/sh
echo '{"packages": [{"name": "gleaner-inference", "manifest_path": "'$PWD'/host/Cargo.toml",
"version": "1.0.0", "dependencies": []}]}'"#;
        let cargo = folder.write_program("target/cargo", cargo);
        let checkout = Checkout::with_cargo(folder.root().to_owned(), cargo.into());
        for (file, text) in [(".gitignore", "target\n"), (FILE, "{}"), ("host/lib.rs", "one")] {
            folder.write(file, text);
        }
        let (name, digest) = ("models, by the tests of ONNX", "by an older rule".to_owned());
        let commit = checkout.commit_all();
        let record = Record { digest, commit, seconds: 1, cpu_seconds: 1, result: String::new() };
        save(&checkout, &PartRecords::from([(name.to_owned(), record)])).unwrap();
        let renewed = || {
            let exit = renew(&checkout).unwrap();
            (exit, read(&checkout).unwrap().remove(name).unwrap().digest)
        };
        let (exit, current) = renewed();
        assert_eq!((exit, current.len()), (Exit::Ok, 64));
        folder.write("host/lib.rs", "two");
        assert_eq!(renewed(), (Exit::Differs, current));
    }
}

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
use crate::steps;

/// File of the records, relative to the checkout.
const FILE: &str = ".ci/full.json";

/// A part of `.ci/run` that takes minutes, and whose result depends only on some of the sources.
struct HeavyPart {
    name: &'static str,
    /// Packages whose programs it runs, beside the installed programs; with their dependencies in
    /// the workspace.
    packages: &'static [&'static str],
    /// True if it starts installed programs.
    has_programs: bool,
    /// Further files and folders that it reads, relative to the checkout.
    files: &'static [&'static str],
    /// Unit of its result, and the text in each line of its output that is counted.
    counted: (&'static str, &'static str),
}

/// The part that builds test programs on other DDS implementations.
const PEERS: &str = "peers, on Cyclone DDS and Fast DDS";

const HEAVY: [HeavyPart; 8] = [
    HeavyPart {
        name: "lints: gleaner-host for fewer kinds of lambdas",
        packages: &["gleaner-host"],
        has_programs: false,
        files: &["rustfmt.toml", "rust-toolchain.toml"],
        counted: ("kinds checked", "Finished "),
    },
    HeavyPart {
        name: PEERS,
        packages: &["gleaner-tests"],
        has_programs: true,
        files: &["xtask/src/peers.rs", "examples", "tests/lambdas", "guest-sdk-python/gleaner"],
        counted: ("steps", "] "),
    },
    HeavyPart {
        name: "page, in a browser",
        packages: &["gleaner-cloud"],
        has_programs: false,
        files: &["xtask/src/page.rs"],
        counted: ("flows", "ok "),
    },
    HeavyPart {
        name: "models, by the tests of ONNX",
        packages: &["gleaner-inference"],
        has_programs: false,
        files: &["xtask/src/models.rs", "tests/models"],
        counted: ("backends", " right "),
    },
    HeavyPart {
        name: "benches, quick",
        packages: &["gleaner-bench"],
        has_programs: true,
        files: &[
            "bench",
            "examples",
            "guest-sdk-python/gleaner",
            "xtask/src/bench.rs",
            "xtask/src/setup.rs",
        ],
        counted: ("benches measured", ": measured"),
    },
    HeavyPart {
        name: "benches, quick: fleet",
        packages: &["gleaner-fleet-bench", "gleaner-cloud"],
        has_programs: false,
        files: &["xtask/src/bench.rs"],
        counted: ("measurements", "| "),
    },
    HeavyPart {
        name: "cloud of three replicas, with kills",
        packages: &["gleaner-fleet-bench", "gleaner-cloud"],
        has_programs: false,
        files: &["xtask/src/fleet"],
        counted: ("kills", "kill "),
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
        ],
        counted: ("verified clips", "signed by the vehicle"),
    },
];

/// Files and folders on which every part depends.
const COMMON: [&str; 4] = [".cargo/config.toml", "Cargo.lock", "Cargo.toml", "wit"];

/// Tests of the source itself and their lists, on which no part depends.
const HOUSE: [&str; 4] =
    ["tests/src/budgets.rs", "tests/src/rooms.rs", "tests/src/words.rs", "tests/tests/house"];

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
    let mut status = checkout.command("git");
    let changed = steps::output(status.args(["status", "--porcelain"]), "run it in a checkout")?;
    if !changed.is_empty() {
        let message = format!("a record names a commit, and there are other changes:\n{changed}");
        return Err(Failure::new(Exit::Usage, message).with_help("commit them first"));
    }
    let mut head = checkout.command("git");
    let commit = steps::output(head.args(["rev-parse", "HEAD"]), "run it in a checkout")?;
    let results = checkout.target().join("full");
    fs::create_dir_all(&results).map_err(|error| cannot("make", &results, &error))?;
    let mut run = checkout.script(".ci/run");
    let ended = steps::run(
        run.arg("--full").arg(&results),
        "see the first error above; parts that ended before it are recorded",
    );
    write(checkout, &results, commit.trim(), ended.is_ok())?;
    ended.map(|()| Exit::Ok)
}

/// Writes the records of the parts in `results`; those of other parts stay. After a run that
/// failed, that of the peers stays, too, as the last part of the run has their tests.
fn write(
    checkout: &Checkout,
    results: &Path,
    commit: &str,
    has_passed: bool,
) -> Result<(), Failure> {
    let sources = CheckoutSources::read(checkout)?;
    let mut records = read(checkout)?;
    for part in HEAVY.iter().filter(|part| has_passed || part.name != PEERS) {
        let Some((seconds, cpu_seconds, result)) = part.result(results)? else { continue };
        let digest = sources.digest(checkout, part)?;
        let commit = commit.to_owned();
        let record = Record { digest, commit, seconds, cpu_seconds, result };
        records.insert(part.name.to_owned(), record);
    }
    let json = serde_json::to_string_pretty(&records)
        .map_err(|error| Failure::caused_by(Exit::Internal, "cannot write records", &error))?;
    let file = checkout.path(FILE);
    fs::write(&file, json + "\n").map_err(|error| cannot("write", &file, &error))?;
    println!("wrote {FILE}; commit it");
    Ok(())
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
/// then; otherwise the exit code is [`Exit::Differs`].
pub(crate) fn print(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let name = arguments.first().and_then(|name| name.to_str()).unwrap_or_default();
    let Some(part) = HEAVY.iter().find(|part| part.name == name) else {
        return Err(Failure::new(Exit::Usage, format!("there is no heavy part `{name}`")));
    };
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
        let text = fs::read_to_string(&output).map_err(|error| cannot("read", &output, &error))?;
        let (unit, sign) = self.counted;
        let count = text.lines().filter(|line| line.contains(sign)).count();
        if count == 0 {
            let message = format!("`{}` ended, and has no {unit}", output.display());
            return Err(Failure::new(Exit::Internal, message));
        }
        Ok(Some((seconds, cpu_seconds, format!("{count} {unit}"))))
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
        let metadata = Metadata::read(checkout)?;
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

    /// The digest of all files on which a part depends.
    fn digest(&self, checkout: &Checkout, part: &HeavyPart) -> Result<String, Failure> {
        let folders: BTreeSet<&str> = self.folders.values().map(String::as_str).collect();
        let used: BTreeSet<&str> =
            self.packages(part).iter().map(|name| self.folders[*name].as_str()).collect();
        let is_used = |path: &str| {
            let named = |name: &&str| Path::new(path).starts_with(name);
            // The innermost package that has the file.
            let package = Path::new(path).ancestors().skip(1).find_map(|folder| {
                let folder = folder.to_str()?;
                folders.contains(folder).then_some(folder)
            });
            let is_apart = path.ends_with(".md") || HOUSE.iter().any(&named);
            package.is_some_and(|package| used.contains(package) && !is_apart)
                || part.files.iter().chain(&COMMON).any(named)
        };
        let mut digest = Sha256::new();
        for path in self.files.iter().filter(|path| is_used(path)) {
            let bytes = fs::read(checkout.path(path)).map_err(|error| {
                let path = checkout.path(path);
                cannot("read", &path, &error)
            })?;
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

fn cannot(what: &str, path: &Path, error: &dyn std::error::Error) -> Failure {
    Failure::caused_by(Exit::Internal, format!("cannot {what} `{}`", path.display()), error)
}

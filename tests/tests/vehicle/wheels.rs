//! Python lambdas with wheels, which the tests make themselves.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::programs::InstalledPrograms;
use gleaner_lambda::Decision;
use gleaner_tests::TempFolder;
use gleaner_tests::live::signal;
use gleaner_tests::vehicle::{TestVehicle, text};

use super::files;

/// Writes the wheel `sys.argv[1]` with one file and its content, and prints its SHA-256.
const MAKE: &str = r#"
import base64, hashlib, os, sys, zipfile
path, name, content = sys.argv[1:]
info = "-".join(os.path.basename(path).split("-")[:2]) + ".dist-info"
package, version = info[: -len(".dist-info")].split("-")
files = {
    name: content,
    f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {package}\nVersion: {version}\n",
    f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\n",
}
record = ""
for file, text in files.items():
    digest = base64.urlsafe_b64encode(hashlib.sha256(text.encode()).digest()).decode()
    record += f"{file},sha256={digest.rstrip('=')},{len(text)}\n"
files[f"{info}/RECORD"] = record + f"{info}/RECORD,,\n"
with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
    for file, text in files.items():
        archive.writestr(file, text)
print(hashlib.sha256(open(path, "rb").read()).hexdigest())
"#;

/// A lambda that reports the number of the package `answer`, ten times a second, times that of a
/// data file.
const CODE: &str = "import answer\nfrom pathlib import Path\n\n\nclass Lambda:\n    \
                    def __init__(self, ctx):\n        \
                    self.unit = float((Path(__file__).parent / 'data/unit').read_text())\n\n    \
                    def on_tick(self, ctx):\n        \
                    ctx.event('answer', answer.ANSWER * self.unit)\n";

struct LambdaWithWheels {
    folder: TempFolder,
    lock: String,
}

impl LambdaWithWheels {
    fn new(version: &str) -> Self {
        let folder = TempFolder::new();
        folder.write("lambda/main.py", CODE);
        folder.write("lambda/data/unit", "1");
        let manifest = format!(
            "[lambda]\nname = \"answers\"\nversion = \"{version}\"\nkind = \"python\"\n\
             entry = \"main.py\"\nfiles = [\"data\"]\n\
             [schedule]\nperiod = \"100ms\"\n[limits]\ndeadline = \"5s\"\n"
        );
        folder.write("lambda/lambda.toml", manifest);
        folder.write("wheels/README", "");
        let mut lambda = Self { folder, lock: String::new() };
        // The host imports it, and needs it for frames and columns only.
        lambda.lock("numpy-0.1-py3-none-any.whl", "numpy.py", "__version__ = '0.1'\n");
        lambda
    }

    fn lock(&mut self, wheel: &str, file: &str, content: &str) {
        let python =
            InstalledPrograms::find().and_then(|parts| parts.python(None)).expect("Python");
        let path = self.folder.path().join("wheels").join(wheel);
        let made = Command::new(python).args(["-c", MAKE]).arg(path).args([file, content]).output();
        let sha256 = String::from_utf8(made.expect("Python starts").stdout).expect("a digest");
        let package = wheel.split('-').take(2).collect::<Vec<_>>().join("==");
        self.lock += &format!("{package} --hash=sha256:{sha256}");
        self.folder.write("lambda/requirements.txt", &self.lock);
    }

    fn path(&self) -> PathBuf {
        self.folder.path().join("lambda")
    }

    fn build(&self, args: &[&str]) -> String {
        let path = self.path();
        let path = path.to_str().expect("a plain path");
        let mut build = Command::new(gleaner_tests::program("gleaner"));
        build.env("PIP_NO_INDEX", "1").env("PIP_FIND_LINKS", self.folder.path().join("wheels"));
        text(&build.arg("build").arg(path).args(args).output().expect("gleaner starts"))
    }
}

/// The scores of all triggers so far.
fn scores(vehicle: &TestVehicle) -> Vec<f64> {
    let lines = vehicle.records(Some("answers")).into_iter().filter(|it| it.kind == "decision");
    let decisions = lines.filter_map(|it| serde_json::from_value::<Decision>(it.record).ok());
    decisions.flat_map(|it| it.triggers).filter_map(|trigger| trigger.score).collect()
}

fn find(folder: &Path, name: &str) -> Option<PathBuf> {
    files(folder).into_iter().find_map(|path| match path.file_name().is_some_and(|it| it == name) {
        true => Some(path),
        false => find(&path, name),
    })
}

pub fn runs() {
    let mut lambda = LambdaWithWheels::new("0.1.0");
    lambda.lock("answer-1.0-py3-none-any.whl", "answer.py", "ANSWER = 42.0\n");
    let mut built = lambda.build(&["--sandboxed"]);
    if built.contains("` does not hold (") {
        built = lambda.build(&[]);
    }
    assert!(
        built.contains("exit status: 0") && built.contains("note: the wheels are for"),
        "{built}"
    );
    // Wheels that were fetched before are used again.
    fs::remove_dir_all(lambda.folder.path().join("wheels")).expect("our folder");
    let built = lambda.build(&[]);
    assert!(built.contains("exit status: 0"), "{built}");
    let mut vehicle = TestVehicle::started();
    vehicle.deploys(&lambda.path());
    vehicle.until("a decision", |vehicle| scores(vehicle).contains(&42.0).then_some(()));

    let revisions = vehicle.path("state/revisions");
    let code = find(&revisions, "answer.py").expect("it is unpacked");
    fs::set_permissions(&code, fs::Permissions::from_mode(0o600)).expect("our file");
    // Of the same length. And native code for the next import, with a name of its own.
    fs::write(&code, "ANSWER = 13.0\n").expect("our file");
    fs::write(code.with_file_name("numpy.so"), "").expect("our folder");
    let process = vehicle.processes("start.py")[0];
    signal(process, "KILL");
    vehicle.until("the next process", |vehicle| {
        let next = vehicle.processes("start.py");
        (!next.is_empty() && next[0] != process).then_some(())
    });
    vehicle.until_running(&["answers"]);
    let before = scores(&vehicle).len();
    let after = vehicle.until("more decisions", |vehicle| {
        Some(scores(vehicle)).filter(|scores| scores.len() > before)
    });
    assert!(after.iter().all(|score| *score == 42.0), "{after:?}");
    assert_eq!(fs::read_to_string(&code).expect("it was made again"), "ANSWER = 42.0\n");
    assert!(!code.with_file_name("numpy.so").exists());
    assert!(vehicle.log().contains("made its Python environment: `lib/"), "{}", vehicle.log());
    // The environment goes with its revision.
    vehicle.stop();
    vehicle.start();
    vehicle.until_running(&["answers"]);
    assert_eq!(files(&revisions).len(), 1);
}

pub fn refused() {
    let vehicle = TestVehicle::started();
    let mut lambda = LambdaWithWheels::new("0.1.0");
    lambda.lock("answer-1.0-py3-none-any.whl", "answer.py", "ANSWER = 42.0\n");
    lambda.build(&[]);
    vehicle.deploys(&lambda.path());

    let mut other = LambdaWithWheels::new("0.2.0");
    other.lock("answer-2.0-cp39-none-any.whl", "answer.py", "ANSWER = 43.0\n");
    let built = other.build(&["--python-version", "3.9"]);
    assert!(built.contains("exit status: 0"), "{built}");
    // Its release follows that of the one that runs.
    let [from, to] = [&lambda, &other].map(|it| it.path().join("revision.json"));
    fs::copy(from, to).expect("it was published");
    let refused = text(&vehicle.deploy(&other.path(), &[]));
    for part in [
        "wheel `answer-2.0-cp39-none-any.whl` does not fit Python 3.",
        "its tags are cp39-none-any",
        "gleaner build --python-version 3.",
    ] {
        assert!(refused.contains(part), "{refused}");
    }
    let status = vehicle.deployment("answers").status.expect("it runs");
    assert_eq!((&*vehicle.deployment("answers").revision.version, status.restarts), ("0.1.0", 0));

    // A wheel of the former build that was changed since is fetched again.
    let wheel = find(&lambda.path().join("build"), "answer-1.0-py3-none-any.whl");
    let wheel = wheel.expect("it was built");
    fs::write(&wheel, "other").expect("our file");
    let built = lambda.build(&[]);
    assert!(built.contains("exit status: 0"), "{built}");
    assert_ne!(fs::read(&wheel).expect("it was built"), b"other");

    // Of a file that was changed since it was locked, and of one without numpy.
    let mut changed = LambdaWithWheels::new("0.3.0");
    changed.lock("answer-3.0-py3-none-any.whl", "answer.py", "ANSWER = 44.0\n");
    let lock = changed.lock.clone();
    changed.lock("answer-3.0-py3-none-any.whl", "answer.py", "ANSWER = 45.0\n");
    changed.folder.write("lambda/requirements.txt", lock);
    let built = changed.build(&[]);
    assert!(built.contains("pip did not fetch the wheels"), "{built}");
    assert!(!changed.path().join("build").exists());
    let lines: Vec<_> = lambda.lock.lines().filter(|line| !line.contains("numpy")).collect();
    lambda.folder.write("lambda/requirements.txt", lines.join("\n"));
    let built = lambda.build(&[]);
    assert!(built.contains("locks no numpy"), "{built}");
    // Of one that would be unpacked elsewhere.
    let mut leaving = LambdaWithWheels::new("0.4.0");
    leaving.lock("answer-4.0-py3-none-any.whl", "../answer.py", "ANSWER = 46.0\n");
    let built = leaving.build(&[]);
    assert!(built.contains("has the entry `../answer.py`"), "{built}");
}

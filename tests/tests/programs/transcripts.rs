//! Commands print what the pages document. `GLEANER_BLESS=1 cargo test --release -p gleaner-tests
//! --test programs transcripts` writes their current output into the pages.

use std::fs;
use std::os::unix::fs::symlink;
use std::process::Command;
use std::time::{Duration, SystemTime};

use gleaner_base::programs::InstalledPrograms;
use gleaner_tests::drive::{corrupted, truncated};
use gleaner_tests::transcript::{fits, perform, rewritten, steps};
use gleaner_tests::{TempFolder, copy_lambda, root, sample_drive};

#[track_caller]
fn assert_transcripts(page: &str, folder: &TempFolder) {
    let path = root().join(page);
    let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{page}: {error}"));
    let mut printed = Vec::new();
    for step in steps(&text) {
        let lines = perform(folder.path(), &step.command);
        printed.push((step, lines));
    }
    assert!(printed.len() > 3, "{page} shows {} commands", printed.len());
    if std::env::var_os("GLEANER_BLESS").is_some() {
        return fs::write(&path, rewritten(&text, &printed)).expect("the page can be written");
    }
    for (step, lines) in printed {
        let (line, command, lines) = (step.line, &step.command, lines.join("\n"));
        let shown = &step.shown;
        let fit = fits(shown, &lines.lines().map(str::to_owned).collect::<Vec<_>>());
        assert!(fit, "{page}:{line}: $ {command}\nshown:\n{}\nprinted:\n{lines}", shown.join("\n"));
    }
}

fn with_drive() -> TempFolder {
    let folder = TempFolder::new();
    symlink(sample_drive(), folder.path().join("highway_drive.mcap"))
        .expect("the folder is writable");
    folder
}

#[test]
fn the_page_of_the_first_lambda_in_rust_is_correct() {
    assert_transcripts("docs/first-rust.md", &with_drive());
}

#[test]
fn the_page_of_the_first_lambda_in_python_is_correct() {
    assert_transcripts("docs/first-python.md", &with_drive());
}

#[test]
fn the_page_of_error_messages_is_correct() {
    assert_transcripts("docs/errors.md", &faulty_lambdas());
}

const RUST: &str = "examples/hello/rust";
const PYTHON: &str = "examples/hello/python";

const ADDRESS: &str = "# by hand\nsensors @ https://example.com/sensors-1.0.tar.gz\n";

/// Lambdas and drives with one mistake each, by their names on the page.
fn faulty_lambdas() -> TempFolder {
    let folder = with_drive();
    let replaced = |from: &'static str, to: &'static str| {
        move |manifest: String| {
            assert!(manifest.contains(from), "the manifest has no {from}");
            manifest.replace(from, to)
        }
    };
    copy_lambda(RUST, &folder, "hello", |manifest| manifest);
    copy_lambda(PYTHON, &folder, "hello-python", |manifest| manifest);
    copy_lambda("examples/brake-dark/rust", &folder, "brake-dark", |manifest| manifest);
    for (name, from, to) in [
        ("unknown-key", "depth = 512", "dept = 512"),
        ("too-small", "depth = 512", "depth = 0"),
        ("no-kind", "kind = \"wasm\"\n", ""),
        ("no-quotes", "\"/imu/data\"\ntype", "/imu/data\ntype"),
        ("no-unit", "deadline = \"10ms\"", "deadline = 10"),
        ("no-input", "event = \"imu\"", "event = \"imi\""),
        ("no-topic", "topic = \"/imu/data\"", "topic = \"/imu/dta\""),
        ("other-type", "sensor_msgs/msg/Imu", "sensor_msgs/msg/NavSatFix"),
        ("huge", "depth = 512", "depth = 65536\nmax_size = \"1 MiB\""),
        ("little-fuel", "fuel = 10_000_000", "fuel = 1_000"),
        ("no-config", "brake_mps2 =", "brake_mps ="),
    ] {
        copy_lambda(RUST, &folder, name, replaced(from, to));
    }
    // An input with a type that does not have the field.
    copy_lambda(
        PYTHON,
        &folder,
        "no-field",
        replaced("sensor_msgs/msg/Imu", "sensor_msgs/msg/Range"),
    );
    let main =
        fs::read_to_string(root().join(PYTHON).join("main.py")).expect("the example's source");
    for (name, from, to) in [
        (
            "syntax-error",
            "def __init__(self, ctx: Context) -> None:",
            "def __init__(self, ctx: Context) -> None",
        ),
        ("misspelt", "ctx.event(\"hard-brake\", -mean)", "ctx.evnt(\"hard-brake\", -mean)"),
        (
            "greedy",
            "self.last_ns: int | None = None",
            "self.last_ns: int | None = None; self.bulk = bytearray(1 << 30)",
        ),
    ] {
        copy_lambda(PYTHON, &folder, name, |manifest| manifest);
        assert!(main.contains(from), "main.py has no {from}");
        folder.write(&format!("{name}/build/main.py"), main.replace(from, to));
    }
    let manifest =
        fs::read_to_string(root().join(RUST).join("lambda.toml")).expect("the example's manifest");
    folder.write("not-built/lambda.toml", &manifest);
    folder.write(
        "python-without-file/lambda.toml",
        manifest.replace("wasm\"", "python\"").replace("hello.python", "main.py"),
    );
    copy_lambda(PYTHON, &folder, "address", |manifest| manifest);
    folder.write("address/main.py", "");
    folder.write("address/requirements.txt", ADDRESS);
    copy_lambda(RUST, &folder, "stale", |manifest| manifest);
    let source = folder.write("stale/src/lib.rs", "");
    let newer = SystemTime::now() + Duration::from_secs(60);
    fs::File::options()
        .write(true)
        .open(source)
        .and_then(|file| file.set_modified(newer))
        .expect("a time can be set");
    fs::create_dir(folder.path().join("empty")).expect("the folder is writable");
    folder.write("empty.mcap", "");
    folder.write("notes.mcap", "this is no drive");
    drop(truncated(&folder, 0.5));
    drop(corrupted(&folder));
    // An environment as `python -m venv` makes it, without numpy.
    let python = InstalledPrograms::find().and_then(|parts| parts.python(None)).expect("a Python");
    let made = Command::new(python)
        .args(["-m", "venv", "--without-pip", "bare"])
        .current_dir(folder.path())
        .status();
    assert!(made.expect("Python starts").success());
    folder
}

#[test]
fn a_transcript_may_omit_text_that_differs() {
    let lines = |text: &str| text.lines().map(str::to_owned).collect::<Vec<_>>();
    let printed = lines("a 1 b\nc\nd\ne 2");
    for (shown, holds) in [
        ("a 1 b\nc\nd\ne 2", true),
        ("a [..] b\nc\nd\n[..]", true),
        ("...\ne [..]", true),
        ("a 1 b\n...\nd\n...", true),
        ("a [..] c\n...", false),
        ("a 1 b\nc\nd", false),
        ("...\nf", false),
    ] {
        assert_eq!(fits(&lines(shown), &printed), holds, "{shown}");
    }
}

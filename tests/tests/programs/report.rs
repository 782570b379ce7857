//! The HTML report of a replay, and the output of `gleaner diff` for two replays, with the real
//! runtime.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use gleaner_tests::{TempFolder, program, root, sample_drive};
use serde_json::Value;

const OK: i32 = 0;
const USAGE: i32 = 2;
const DIFFERS: i32 = 4;

/// Runs `gleaner` with these arguments, which must end with `code`; returns its standard output.
#[track_caller]
fn gleaner(code: i32, args: &[&str]) -> String {
    let mut gleaner = Command::new(program("gleaner"));
    // The tests' own cache, as for every replay of the tests.
    gleaner.args(args).env("XDG_CACHE_HOME", root().join("target/test-cache"));
    let Output { status, stdout, stderr } = gleaner.output().expect("the program starts");
    let [stdout, stderr] = [stdout, stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    assert_eq!(status.code(), Some(code), "{stdout}{stderr}");
    stdout
}

fn text(path: &Path) -> &str {
    path.to_str().expect("paths of tests are UTF-8")
}

fn replay(out: &TempFolder, brake: &str) -> String {
    let (lambda, drive) = (root().join("examples/hello/rust"), sample_drive());
    gleaner(OK, &["replay", text(&lambda), text(&drive), "--set", brake, "--out", text(out.path())])
}

fn page(path: &Path) -> (String, Value) {
    let page = fs::read_to_string(path).expect("the page exists");
    let (_, data) = page
        .split_once(r#"<script id="data" type="application/json">"#)
        .expect("the page has data");
    let data = serde_json::from_str(data.split_once("</script>").expect("the data end").0)
        .expect("data is JSON");
    (page, data)
}

#[test]
fn the_report_of_a_replay_is_self_contained() {
    let out = TempFolder::new();
    let stdout = replay(&out, "brake_mps2=-1.4");
    let path = out.path().join("report.html");
    assert!(stdout.ends_with(&format!("  report: {}\n", path.display())), "{stdout}");
    let (page, data) = page(&path);

    let run = &data["runs"][0];
    assert_eq!(
        (&run["lambda"], &run["labels"]),
        (&"hello".into(), &serde_json::json!(["hard-brake"]))
    );
    let expected =
        fs::read_to_string(root().join("examples/hello/expected.txt")).expect("expected.txt");
    let seconds = |line: &str| {
        line.split(' ').next().and_then(|word| word.parse::<f64>().ok()).expect("seconds")
    };
    let shown: Vec<_> =
        run["triggers"].as_array().expect("a list").iter().map(|mark| mark["t"].as_f64()).collect();
    assert_eq!(shown.len(), expected.lines().count());
    for (shown, line) in shown.iter().zip(expected.lines()) {
        assert!((shown.expect("a time") - seconds(line)).abs() < 0.001, "{shown:?} {line}");
    }

    // The plotting library names its origin in its first line.
    let others = page.replacen("/*! https://github.com/leeoniya/uPlot", "", 1);
    assert_eq!((others.matches("https://").count(), others.matches("http://").count()), (0, 0));
    assert!(page.contains("default-src 'none'"), "the browser fetches nothing");
    for element in ["<link", "<iframe", "<img", "src=", "@import", "url("] {
        assert!(!page.contains(element), "{element}");
    }

    fs::remove_file(&path).expect("the report exists");
    assert_eq!(gleaner(OK, &["report", text(out.path())]), format!("{}\n", path.display()));
    assert_eq!(self::page(&path).1, data, "generated again from the same files");
}

#[test]
fn two_thresholds_differ_and_a_run_does_not_differ_from_itself() {
    let (strict, mild) = (TempFolder::new(), TempFolder::new());
    replay(&strict, "brake_mps2=-1.4");
    replay(&mild, "brake_mps2=-1.2");
    let decisions = |out: &TempFolder| {
        fs::read_to_string(out.path().join("decisions.jsonl")).expect("decisions exist")
    };
    let times = |out: &TempFolder| {
        let at = |line: &str| {
            serde_json::from_str::<Value>(line).expect("JSON")["at_ns"].as_i64().expect("a time")
        };
        decisions(out).lines().map(at).collect::<std::collections::BTreeSet<_>>()
    };
    // Counted independently: hello triggers at most once in a wake.
    let (a, b) = (times(&strict), times(&mild));
    let (removed, added) = (a.difference(&b).count() as u64, b.difference(&a).count() as u64);
    assert!(removed + added > 0, "the thresholds give the same triggers");

    let (a, b) = (text(strict.path()), text(mild.path()));
    let diff: Value =
        serde_json::from_str(&gleaner(DIFFERS, &["diff", a, b, "--json"])).expect("one object");
    let counts = &diff["triggers"];
    assert_eq!((&counts["removed"], &counts["added"]), (&removed.into(), &added.into()));
    assert_eq!(diff["identical"], false);

    let file = mild.path().join("diff.html");
    let stdout = gleaner(DIFFERS, &["diff", a, b, "--report", text(&file)]);
    assert!(stdout.ends_with(&format!("  report: {}\n", file.display())), "{stdout}");
    let (_, data) = page(&file);
    assert_eq!(data["runs"].as_array().map(Vec::len), Some(2));
    assert_eq!(data["diff"]["triggers"], diff["triggers"]);

    let stdout = gleaner(OK, &["diff", a, a]);
    assert!(stdout.contains("identical") && !stdout.contains("removed"), "{stdout}");
}

#[test]
fn a_folder_without_results_is_refused() {
    let empty = TempFolder::new();
    for args in
        [&["report", text(empty.path())][..], &["diff", text(empty.path()), text(empty.path())]]
    {
        assert_eq!(gleaner(USAGE, args), "");
    }
}

/// Runs `gleaner` with a limit of `bytes` on the length of files; returns its exit code and its
/// standard error.
fn with_files_of(bytes: u64, args: &[&str]) -> (Option<i32>, String) {
    let mut limited = Command::new("sh");
    // Ignored, because the signal would end the process before its write fails. Blocks have 512
    // bytes.
    limited.args([
        "-c",
        r#"trap "" XFSZ; ulimit -f "$1"; shift; exec "$@""#,
        "sh",
        &(bytes / 512).to_string(),
    ]);
    limited
        .arg(program("gleaner"))
        .args(args)
        .env("XDG_CACHE_HOME", root().join("target/test-cache"));
    let output = limited.output().expect("the program starts");
    (output.status.code(), String::from_utf8_lossy(&output.stderr).into_owned())
}

#[test]
fn a_report_that_cannot_be_written_is_an_error_and_the_results_are_kept() {
    let (lambda, drive) = (root().join("examples/brake-dark/rust"), sample_drive());
    let args = |out: &Path, more: &[&'static str]| {
        let out = text(out).to_owned();
        let line = [
            "replay",
            text(&lambda),
            text(&drive),
            "--set",
            "brake_mps2=-1.4",
            "--no-record",
            "--out",
        ];
        let line = line
            .into_iter()
            .map(str::to_owned)
            .chain([out])
            .chain(more.iter().map(|arg| (*arg).to_owned()));
        line.collect::<Vec<_>>()
    };
    let run = |bytes: u64, out: &Path, more: &[&'static str]| {
        let args = args(out, more);
        with_files_of(bytes, &args.iter().map(String::as_str).collect::<Vec<_>>())
    };
    let complete = TempFolder::new();
    assert_eq!(run(1 << 40, complete.path(), &[]), (Some(OK), String::new()));
    let len = |name: &str| fs::metadata(complete.path().join(name)).expect("the file exists").len();
    let (report, signals) = (len("report.html"), len("signals.json"));
    assert!(
        report > signals + 4096
            && signals > len("decisions.jsonl") + 4096
            && signals > len("summary.json") + 4096
    );

    let same_results = |out: &Path| {
        let triggers = |out: &Path| {
            fs::read_to_string(out.join("decisions.jsonl")).expect("decisions").lines().count()
        };
        assert_eq!(triggers(out), triggers(complete.path()));
        assert!(out.join("summary.json").exists());
        let names =
            fs::read_dir(out).expect("results").map(|entry| entry.expect("a file").file_name());
        let parts: Vec<_> =
            names.filter(|name| name.to_string_lossy().ends_with(".part")).collect();
        assert!(parts.is_empty(), "{parts:?}");
    };
    for (bytes, more, names) in [
        ((report + signals) / 2, &[][..], "cannot write the report"),
        (signals - 1024, &["--no-report"][..], "signals.json`"),
    ] {
        let out = TempFolder::new();
        let (exit, stderr) = run(bytes, out.path(), more);
        assert!(
            exit == Some(1) && stderr.contains("error: ") && stderr.contains(names),
            "{exit:?} {stderr}"
        );
        assert!(!out.path().join("report.html").exists());
        same_results(out.path());
    }

    let out = TempFolder::new();
    out.write("pictures", "not a folder");
    for part in ["report.html.part", "signals.json.part", "summary.json.part"] {
        out.write(part, "of a replay that was killed");
    }
    let (exit, stderr) = run(1 << 40, out.path(), &[]);
    assert!(
        exit == Some(1) && stderr.contains("pictures`") && stderr.contains("it is not a folder"),
        "{exit:?} {stderr}"
    );
    assert!(out.path().join("report.html").exists() && out.path().join("signals.json").exists());
    same_results(out.path());
}

//! `gleaner new`: the generated lambda passes its tests, builds, and finds the brakings of the
//! sample drive, without network access.

use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_protocol::ReplaySummary;
use gleaner_tests::{TempFolder, program, root, sample_drive};

fn new(folder: &TempFolder, kind: &str) -> PathBuf {
    let lambda = folder.path().join("pot-hole");
    must_succeed(gleaner(folder.path()).args(["new", "pot-hole", "--kind", kind]));
    lambda
}

fn gleaner(at: &Path) -> Command {
    let mut gleaner = Command::new(program("gleaner"));
    gleaner.env("XDG_CACHE_HOME", root().join("target/test-cache")).current_dir(at);
    // Its lock file contains the versions of this workspace, which are available offline.
    gleaner
        .env("CARGO_NET_OFFLINE", "true")
        .env("CARGO_TARGET_DIR", root().join("target/test-new"));
    gleaner
}

/// Runs a command, which must succeed; returns its standard output.
fn must_succeed(command: &mut Command) -> String {
    let output = command.output().expect("the program starts");
    let [out, error] =
        [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned());
    assert!(output.status.success(), "{command:?}: {}\n{out}\n{error}", output.status);
    out
}

fn builds_and_finds_brakings(lambda: &Path) {
    must_succeed(gleaner(lambda).args(["build", "."]));
    let mut replay = gleaner(lambda);
    replay.args(["replay", ".", "--json", "--set", "brake_mps2=-1.4"]).arg(sample_drive());
    let summary: ReplaySummary =
        serde_json::from_str(&must_succeed(&mut replay)).expect("a summary");
    assert_eq!((summary.lambda.as_str(), summary.triggers, summary.faults), ("pot-hole", 3, 0));
}

#[test]
fn a_new_lambda_in_rust_passes_its_test_builds_and_triggers() {
    let folder = TempFolder::new();
    let lambda = new(&folder, "rust");
    let mut test = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    test.args(["test", "--offline"])
        .env("CARGO_TARGET_DIR", root().join("target/test-new"))
        .current_dir(&lambda);
    assert!(must_succeed(&mut test).contains("4 passed"));
    builds_and_finds_brakings(&lambda);
    must_succeed(gleaner(&lambda).args(["new", "--update", "."]));
    must_succeed(gleaner(&lambda).args(["build", "."]));
}

#[test]
fn a_new_lambda_in_python_passes_its_test_builds_and_triggers() {
    let folder = TempFolder::new();
    let lambda = new(&folder, "python");
    let python = std::env::var_os("GLEANER_PYTHON")
        .unwrap_or_else(|| root().join(".venv/bin/python3").into());
    let mut test = Command::new(python);
    test.args(["-m", "pytest", "-q"]).current_dir(&lambda);
    assert!(must_succeed(&mut test).contains("2 passed"));
    builds_and_finds_brakings(&lambda);
}

#[test]
fn a_sandboxed_build_produces_the_same_component() {
    let folder = TempFolder::new();
    let lambda = new(&folder, "rust");
    let component = || {
        std::fs::read(lambda.join("build/pot_hole.wasm"))
            .or_else(|_| std::fs::read(lambda.join("build/pot-hole.wasm")))
    };
    must_succeed(gleaner(&lambda).args(["build", "."]));
    let plain = component().expect("a component");
    // Into a temporary folder.
    let output = gleaner(&lambda)
        .args(["build", "--sandboxed", "."])
        .env_remove("CARGO_TARGET_DIR")
        .output()
        .unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    if is_refused_here(&output) {
        return;
    }
    assert!(output.status.success(), "{stderr}");
    assert!(component().expect("a component") == plain, "{stderr}");
}

/// Returns a folder with the manifests of a lambda in Rust, without its code.
fn small_crate() -> TempFolder {
    let folder = TempFolder::new();
    folder.write(
        "lambda.toml",
        "lambda = { name = 'x', version = '0.1.0', kind = 'wasm', entry = 'x.wasm' }\n\
         schedule.period = '1s'\n",
    );
    folder.write(
        "Cargo.toml",
        "[package]\nname = 'x'\nversion = '0.1.0'\nedition = '2024'\n\
         [lib]\ncrate-type = ['cdylib']\n[workspace]\n",
    );
    folder
}

/// Actions that a build script attempts; it prints the name of each and the outcome.
const TRIES: &str = r#"
fn outcome<T, E>(tried: Result<T, E>) -> &'static str {
    if tried.is_ok() { "went" } else { "refused" }
}
fn main() {
    let outside = std::path::Path::new("OUTSIDE");
    let tries: [(&str, &str); 8] = [
        ("read", outcome(std::fs::read_to_string(outside.join("canary")))),
        ("list", outcome(std::fs::read_dir(outside))),
        ("write", outcome(std::fs::write(outside.join("more"), "x"))),
        ("truncate", outcome(std::fs::File::create(outside.join("canary")))),
        ("source", outcome(std::fs::write("src/more.rs", "x"))),
        ("datagrams", outcome(std::net::UdpSocket::bind("127.0.0.1:0"))),
        ("connect", outcome(std::net::TcpStream::connect("127.0.0.1:PORT"))),
        ("environment", outcome(std::env::var("GLEANER_TEST_TOKEN"))),
    ];
    for (name, outcome) in tries {
        println!("cargo:warning=<{name}> {outcome}");
    }
}
"#;

#[test]
fn a_sandboxed_build_script_has_no_access_outside_of_its_build() {
    let (folder, outside) = (small_crate(), TempFolder::new());
    outside.write("canary", "canary");
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port().to_string();
    folder.write("src/lib.rs", "#[unsafe(no_mangle)]\npub extern \"C\" fn x() {}\n");
    let tries = TRIES.replace("OUTSIDE", outside.path().to_str().unwrap()).replace("PORT", &port);
    folder.write("build.rs", tries.as_bytes());
    // Settings that would start other programs in place of cargo's.
    for (name, text) in [
        (".cargo/config.toml", "[build]\nrustc-wrapper = '/bin/false'\n"),
        ("rust-toolchain.toml", "[toolchain]\nchannel = 'none-such'\n"),
    ] {
        folder.write(name, text);
    }
    let names =
        ["read", "list", "write", "truncate", "source", "datagrams", "connect", "environment"];
    let build = |args: &[&str], at: &Path| {
        let mut command = gleaner(at);
        command
            .env("GLEANER_TEST_TOKEN", "secret")
            .env_remove("CARGO_TARGET_DIR")
            .arg("build")
            .args(args);
        command.arg(folder.path()).output().unwrap()
    };
    let output = build(&["--sandboxed"], folder.path());
    if is_refused_here(&output) {
        return;
    }
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{stderr}");
    for name in names {
        assert!(stderr.contains(&format!("<{name}> refused")), "{name}: {stderr}");
    }
    assert_eq!(std::fs::read_to_string(outside.path().join("canary")).unwrap(), "canary");
    assert!(!outside.path().join("more").exists() && !folder.path().join("src/more.rs").exists());
    // Without the sandbox the same script succeeds.
    let output = build(&[], &root());
    let stderr = String::from_utf8_lossy(&output.stderr);
    for name in names {
        assert!(stderr.contains(&format!("<{name}> went")), "{name}: {stderr}");
    }
}

#[test]
fn a_failed_sandboxed_build_names_the_permissions_of_its_code() {
    let (folder, outside) = (small_crate(), TempFolder::new());
    let canary = outside.write("canary", "canary");
    // A component can include a file even without a build script.
    folder.write(
        "src/lib.rs",
        format!("pub static X: &[u8] = include_bytes!({:?});\n", canary.display().to_string()),
    );
    let output =
        gleaner(&root()).args(["build", "--sandboxed"]).arg(folder.path()).output().unwrap();
    if is_refused_here(&output) {
        return;
    }
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    for part in ["Permission denied", "in its sandbox", "`files`", "`sockets`", "--sandboxed"] {
        assert!(stderr.contains(part), "{part}: {stderr}");
    }
    assert!(!folder.path().join(".build.partial").exists());
}

/// Returns whether this machine cannot sandbox a compiler. In that case the message names the
/// missing layer, and nothing is built.
fn is_refused_here(output: &std::process::Output) -> bool {
    let stderr = String::from_utf8_lossy(&output.stderr);
    let is_refused = output.status.code() == Some(3);
    assert!(!is_refused || stderr.contains("` does not hold ("), "{stderr}");
    is_refused
}

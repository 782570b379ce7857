//! `gleaner new`: what it makes passes its test, builds, and finds the brakings of the sample
//! drive. Nothing is fetched.

use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_protocol::Summary;
use gleaner_tests::{Folder, program, root, sample_drive};

/// A new lambda.
fn new(folder: &Folder, kind: &str) -> PathBuf {
    let lambda = folder.path().join("pot-hole");
    done(gleaner(folder.path()).args(["new", "pot-hole", "--kind", kind]));
    lambda
}

fn gleaner(at: &Path) -> Command {
    let mut gleaner = Command::new(program("gleaner"));
    gleaner.env("XDG_CACHE_HOME", root().join("target/test-cache")).current_dir(at);
    // Its lock file names the versions of this workspace, which are here.
    gleaner
        .env("CARGO_NET_OFFLINE", "true")
        .env("CARGO_TARGET_DIR", root().join("target/test-new"));
    gleaner
}

/// What it printed.
fn done(command: &mut Command) -> String {
    let output = command.output().expect("the program starts");
    let [out, error] =
        [output.stdout, output.stderr].map(|said| String::from_utf8_lossy(&said).into_owned());
    assert!(output.status.success(), "{command:?}: {}\n{out}\n{error}", output.status);
    out
}

fn builds_and_finds_brakings(lambda: &Path) {
    done(gleaner(lambda).args(["build", "."]));
    let mut replay = gleaner(lambda);
    replay.args(["replay", ".", "--json", "--set", "brake_mps2=-1.4"]).arg(sample_drive());
    let summary: Summary = serde_json::from_str(&done(&mut replay)).expect("a summary");
    assert_eq!((summary.lambda.as_str(), summary.triggers, summary.faults), ("pot-hole", 3, 0));
}

#[test]
fn a_new_lambda_in_rust_passes_its_test_builds_and_finds_something() {
    let folder = Folder::new();
    let lambda = new(&folder, "rust");
    let mut test = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
    test.args(["test", "--offline"])
        .env("CARGO_TARGET_DIR", root().join("target/test-new"))
        .current_dir(&lambda);
    assert!(done(&mut test).contains("4 passed"));
    builds_and_finds_brakings(&lambda);
    done(gleaner(&lambda).args(["new", "--update", "."]));
    done(gleaner(&lambda).args(["build", "."]));
}

#[test]
fn a_new_lambda_in_python_passes_its_test_builds_and_finds_something() {
    let folder = Folder::new();
    let lambda = new(&folder, "python");
    let python = std::env::var_os("GLEANER_PYTHON")
        .unwrap_or_else(|| root().join(".venv/bin/python3").into());
    let mut test = Command::new(python);
    test.args(["-m", "pytest", "-q"]).current_dir(&lambda);
    assert!(done(&mut test).contains("2 passed"));
    builds_and_finds_brakings(&lambda);
}

#[test]
fn a_sandboxed_build_makes_the_same_component() {
    let folder = Folder::new();
    let lambda = new(&folder, "rust");
    let component = || {
        std::fs::read(lambda.join("build/pot_hole.wasm"))
            .or_else(|_| std::fs::read(lambda.join("build/pot-hole.wasm")))
    };
    done(gleaner(&lambda).args(["build", "."]));
    let plain = component().expect("a component");
    // In a folder that goes with the test.
    let output = gleaner(&lambda)
        .args(["build", "--sandboxed", "."])
        .env_remove("CARGO_TARGET_DIR")
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    if is_refused_here(&output) {
        return;
    }
    assert!(output.status.success(), "{said}");
    assert!(component().expect("a component") == plain, "{said}");
}

/// What a build script tries, each with the name under which it says what came of it.
const TRIES: &str = r#"
fn main() {
    let outside = std::path::Path::new("OUTSIDE");
    let tries: [(&str, Result<String, String>); 8] = [
        ("read", std::fs::read_to_string(outside.join("canary")).map_err(|e| e.to_string())),
        ("list", std::fs::read_dir(outside).map(|_| String::new()).map_err(|e| e.to_string())),
        ("write", std::fs::write(outside.join("more"), "x").map(|()| String::new()).map_err(|e| e.to_string())),
        ("truncate", std::fs::File::create(outside.join("canary")).map(|_| String::new()).map_err(|e| e.to_string())),
        ("source", std::fs::write("src/more.rs", "x").map(|()| String::new()).map_err(|e| e.to_string())),
        ("datagrams", std::net::UdpSocket::bind("127.0.0.1:0").map(|_| String::new()).map_err(|e| e.to_string())),
        ("connect", std::net::TcpStream::connect("127.0.0.1:PORT").map(|_| String::new()).map_err(|e| e.to_string())),
        ("environment", std::env::var("GLEANER_TEST_TOKEN").map_err(|e| e.to_string())),
    ];
    for (name, tried) in tries {
        println!("cargo:warning=<{name}> {}", if tried.is_ok() { "went" } else { "refused" });
    }
}
"#;

#[test]
fn a_build_script_reaches_nothing_but_its_own_when_it_is_sandboxed() {
    let (folder, outside) = (Folder::new(), Folder::new());
    outside.write("canary", "canary");
    let listener = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = listener.local_addr().unwrap().port().to_string();
    folder.write(
        "lambda.toml",
        "lambda = { name = 'x', version = '0.1.0', kind = 'wasm', entry = 'x.wasm' }\nschedule.period = '1s'\n",
    );
    folder.write(
        "Cargo.toml",
        "[package]\nname = 'x'\nversion = '0.1.0'\nedition = '2024'\n[lib]\ncrate-type = ['cdylib']\n[workspace]\n",
    );
    folder.write("src/lib.rs", "#[unsafe(no_mangle)]\npub extern \"C\" fn x() {}\n");
    let tries = TRIES.replace("OUTSIDE", outside.path().to_str().unwrap()).replace("PORT", &port);
    folder.write("build.rs", tries.as_bytes());
    // It names programs that would be started in place of ours.
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
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{said}");
    for name in names {
        assert!(said.contains(&format!("<{name}> refused")), "{name}: {said}");
    }
    assert_eq!(std::fs::read_to_string(outside.path().join("canary")).unwrap(), "canary");
    assert!(!outside.path().join("more").exists() && !folder.path().join("src/more.rs").exists());
    // The same script without: what it tries can be done.
    let output = build(&[], &root());
    let said = String::from_utf8_lossy(&output.stderr);
    for name in names {
        assert!(said.contains(&format!("<{name}> went")), "{name}: {said}");
    }
}

#[test]
fn a_sandboxed_build_that_fails_names_what_its_code_may_not() {
    let (folder, outside) = (Folder::new(), Folder::new());
    let canary = outside.write("canary", "canary");
    folder.write(
        "lambda.toml",
        "lambda = { name = 'x', version = '0.1.0', kind = 'wasm', entry = 'x.wasm' }\nschedule.period = '1s'\n",
    );
    folder.write(
        "Cargo.toml",
        "[package]\nname = 'x'\nversion = '0.1.0'\nedition = '2024'\n[lib]\ncrate-type = ['cdylib']\n[workspace]\n",
    );
    // No build script is needed to have a file in a component.
    folder.write(
        "src/lib.rs",
        format!("pub static X: &[u8] = include_bytes!({:?});\n", canary.display().to_string()),
    );
    let output =
        gleaner(&root()).args(["build", "--sandboxed"]).arg(folder.path()).output().unwrap();
    if is_refused_here(&output) {
        return;
    }
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{said}");
    for part in ["Permission denied", "in its sandbox", "`files`", "`sockets`", "--sandboxed"] {
        assert!(said.contains(part), "{part}: {said}");
    }
    assert!(!folder.path().join(".build.partial").exists());
}

/// Whether this machine cannot sandbox a compiler: then it is said which layer is missing, and
/// nothing is built.
fn is_refused_here(output: &std::process::Output) -> bool {
    let said = String::from_utf8_lossy(&output.stderr);
    let is_refused = output.status.code() == Some(3);
    assert!(!is_refused || said.contains("` does not hold ("), "{said}");
    is_refused
}

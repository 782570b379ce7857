//! Hostile folders: links, pipes, devices and endless files wherever a program reads files of a
//! lambda's author. Each command ends, names the file and the way out, and leaves no partial
//! results.

use std::fs::{self, File};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::programs::InstalledPrograms;
use gleaner_tests::{TempFolder, program, root, sample_drive};

const USAGE: i32 = 2;

/// Timeout of a command in seconds; each takes some milliseconds.
const TIMEOUT_S: &str = "120";

const MANIFEST: &str = "lambda = { name = 'x', version = '0.1.0', kind = 'python', \
                        entry = 'main.py', files = ['data'] }\nschedule.period = '1s'\n\
                        [[model]]\nname = 'm'\nfile = 'm.onnx'\nsha256 = \
                        '0000000000000000000000000000000000000000000000000000000000000000'\n";

#[derive(Clone, Copy, Debug)]
enum HostileFile {
    /// A link to a file outside of the lambda.
    Link,
    /// A link to a folder outside of the lambda.
    LinkToFolder,
    /// A link to an endless device.
    Device,
    Pipe,
    /// A file of a terabyte that takes no disk space.
    Sparse,
}

use HostileFile::{Device, Link, LinkToFolder, Pipe, Sparse};

/// A lambda in Python, and files outside of it.
struct TestLambda {
    all: TempFolder,
}

impl TestLambda {
    fn new() -> Self {
        let all = TempFolder::new();
        all.write("secret/a/msg/X.msg", "secret");
        all.write("lambda/lambda.toml", MANIFEST);
        all.write("lambda/main.py", "def on_tick(ctx):\n    pass\n");
        all.write("lambda/m.onnx", "");
        all.write("lambda/data/a", "1");
        Self { all }
    }

    fn built() -> Self {
        let lambda = Self::new();
        assert_eq!(lambda.gleaner(&["build"]), (0, String::new()));
        lambda
    }

    fn path(&self, name: &str) -> PathBuf {
        self.all.path().join("lambda").join(name)
    }

    /// Replaces `name` by a hostile file; returns the text that the error must contain.
    fn spoil(&self, name: &str, kind: HostileFile) -> String {
        let (path, secret) = (self.path(name), self.all.path().join("secret"));
        let _ = fs::remove_file(&path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let leads_to = |target: &Path| {
            symlink(target, &path).unwrap();
            format!("it is a link to `{}`, outside of `", target.display())
        };
        let why = match kind {
            Link => leads_to(&secret.join("a/msg/X.msg")),
            LinkToFolder => leads_to(&secret),
            Device => leads_to(Path::new("/dev/zero")),
            Pipe => {
                assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
                "it is not a regular file".to_owned()
            }
            Sparse => {
                File::create(&path).unwrap().set_len(1 << 40).unwrap();
                String::new()
            }
        };
        format!("{name}` {why}")
    }

    /// Runs a command on the lambda; returns its exit code and standard error.
    fn gleaner(&self, args: &[&str]) -> (i32, String) {
        let mut gleaner = Command::new("timeout");
        gleaner
            .arg(TIMEOUT_S)
            .arg(program("gleaner"))
            .arg(args[0])
            .args(&args[1..])
            .arg(self.path(""));
        if args[0] == "replay" {
            gleaner.arg(sample_drive());
        }
        gleaner
            .env("XDG_CACHE_HOME", root().join("target/test-cache"))
            .env_remove("GLEANER_PYTHON");
        let output = gleaner.output().expect("the program starts");
        (output.status.code().unwrap_or(128), String::from_utf8_lossy(&output.stderr).into_owned())
    }

    /// Runs a command, which must refuse the file for the reason in `wanted`.
    #[track_caller]
    fn refuses(&self, args: &[&str], wanted: &str) {
        let (code, stderr) = self.gleaner(args);
        assert_eq!(code, USAGE, "{args:?} {wanted}: {stderr}");
        let (name, why) = wanted.split_once("` ").unwrap();
        assert!(
            stderr.contains(&format!("{name}`"))
                && stderr.contains(why)
                && stderr.contains("help:"),
            "{wanted}: {stderr}"
        );
    }
}

#[test]
fn a_build_names_and_refuses_hostile_files_and_leaves_nothing() {
    for (name, kind) in [
        ("lambda.toml", &[Link, Device, Pipe, Sparse][..]),
        ("main.py", &[Link, Device, Pipe, Sparse]),
        ("part/of.py", &[Link, Sparse]),
        ("m.onnx", &[Link, Device, Pipe, Sparse]),
        ("data/a", &[Link, Sparse]),
        ("data/b", &[LinkToFolder, Pipe]),
        ("msg/a/msg/X.msg", &[Link, Sparse]),
        ("msg", &[LinkToFolder]),
    ]
    .into_iter()
    .flat_map(|(name, kinds)| kinds.iter().map(move |kind| (name, *kind)))
    {
        let lambda = TestLambda::new();
        // The state after a killed build.
        lambda.all.write("lambda/.build.partial/half.py", "");
        let wanted = lambda.spoil(name, kind);
        lambda.refuses(&["build"], &wanted);
        assert!(!lambda.path("build").exists(), "{wanted}");
        // A manifest that cannot be read gives no build folder.
        assert!(name == "lambda.toml" || !lambda.path(".build.partial").exists(), "{wanted}");
    }
}

#[test]
fn a_link_within_the_folder_is_built_as_its_target() {
    let lambda = TestLambda::new();
    symlink("main.py", lambda.path("short.py")).unwrap();
    symlink(lambda.path("main.py"), lambda.path("long.py")).unwrap();
    assert_eq!(lambda.gleaner(&["build"]), (0, String::new()));
    let main = fs::read(lambda.path("main.py")).unwrap();
    for name in ["build/short.py", "build/long.py"] {
        assert!(lambda.path(name).symlink_metadata().unwrap().is_file());
        assert_eq!(fs::read(lambda.path(name)).unwrap(), main);
    }
}

#[test]
fn many_sparse_files_do_not_fill_the_disk() {
    let lambda = TestLambda::new();
    for number in 0..300 {
        let file = File::create(lambda.path(&format!("x{number}.py"))).unwrap();
        file.set_len(gleaner_lambda::SOURCE_MAX.bytes()).unwrap();
    }
    let (code, stderr) = lambda.gleaner(&["build"]);
    assert_eq!(code, USAGE, "{stderr}");
    assert!(stderr.contains("more than 4 GiB") && stderr.contains("help:"), "{stderr}");
    assert!(!lambda.path(".build.partial").exists());
}

#[test]
fn every_command_names_and_refuses_hostile_files_of_a_build() {
    for (name, kind) in [
        ("build/lambda.toml", &[Link, Pipe, Sparse][..]),
        ("build/main.py", &[Link, Device, Pipe, Sparse]),
        ("build/more/notes", &[Link, Pipe, Sparse]),
    ]
    .into_iter()
    .flat_map(|(name, kinds)| kinds.iter().map(move |kind| (name, *kind)))
    {
        let lambda = TestLambda::built();
        let wanted = lambda.spoil(name, kind);
        let journal = lambda.all.path().join("journal");
        for args in [
            &["replay"][..],
            &["replay", "--journal", journal.to_str().unwrap()],
            &["check"],
            &["run"],
            &["verify", "no.mcap", "--lambda"],
        ] {
            lambda.refuses(args, &wanted);
        }
        assert!(!lambda.path("out").exists() && !journal.exists(), "{wanted}");
    }
}

#[test]
fn an_environment_with_a_hostile_description_is_refused() {
    let lambda = TestLambda::built();
    let python = InstalledPrograms::find()
        .and_then(|parts| parts.python(None))
        .expect("Python is installed");
    fs::create_dir_all(lambda.path(".venv/bin")).unwrap();
    symlink(python, lambda.path(".venv/bin/python3")).unwrap();
    for kind in [Pipe, Device, Link, Sparse] {
        let wanted = lambda.spoil(".venv/pyvenv.cfg", kind);
        lambda.refuses(&["replay"], &wanted);
        lambda.refuses(&["check"], &wanted);
    }
}

#[test]
fn an_update_refuses_a_hostile_manifest() {
    let lambda = TestLambda::new();
    fs::create_dir(lambda.path(".gleaner")).unwrap();
    for kind in [Pipe, Device, Link, Sparse] {
        let wanted = lambda.spoil("lambda.toml", kind);
        lambda.refuses(&["new", "--update"], &wanted);
    }
}

//! Folders that were made to do harm: links, pipes, devices and files without an end, wherever a
//! program of ours reads what a lambda's author has put there. Each command ends, names the file
//! and the way out, and leaves nothing half made.

use std::fs::{self, File};
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_parts::Parts;
use gleaner_tests::{Folder, program, root, sample_drive};

const USAGE: i32 = 2;

/// Seconds after which a command counts as one that waits for ever; each takes some milliseconds.
const HANGS: &str = "120";

const MANIFEST: &str = "lambda = { name = 'x', version = '0.1.0', kind = 'python', entry = 'main.py' }\nschedule.period = '1s'\n\
                        [[model]]\nname = 'm'\nfile = 'm.onnx'\nsha256 = '0000000000000000000000000000000000000000000000000000000000000000'\n";

/// What a bad file is.
#[derive(Clone, Copy, Debug)]
enum Bad {
    /// A link to the file of somebody else.
    Link,
    /// A link to the folder of somebody else.
    LinkToFolder,
    /// A link to a device without an end.
    Device,
    Pipe,
    /// A terabyte that takes no disk.
    Sparse,
}

/// A lambda in Python, and what is none of its business.
struct Lambda {
    all: Folder,
}

impl Lambda {
    fn new() -> Self {
        let all = Folder::new();
        all.write("secret/a/msg/X.msg", "secret");
        all.write("lambda/lambda.toml", MANIFEST);
        all.write("lambda/main.py", "def on_tick(ctx):\n    pass\n");
        all.write("lambda/m.onnx", "");
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

    /// Puts a bad file in the place of `name`; what the message about it has to name.
    fn spoil(&self, name: &str, bad: Bad) -> String {
        let (path, secret) = (self.path(name), self.all.path().join("secret"));
        let _ = fs::remove_file(&path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let leads_to = |target: &Path| {
            symlink(target, &path).unwrap();
            format!("it is a link to `{}`, outside of `", target.display())
        };
        let why = match bad {
            Bad::Link => leads_to(&secret.join("a/msg/X.msg")),
            Bad::LinkToFolder => leads_to(&secret),
            Bad::Device => leads_to(Path::new("/dev/zero")),
            Bad::Pipe => {
                assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
                "it is no file".to_owned()
            }
            Bad::Sparse => {
                File::create(&path).unwrap().set_len(1 << 40).unwrap();
                String::new()
            }
        };
        format!("{name}` {why}")
    }

    /// Runs a command on the lambda: its exit code, and what it said of an error.
    fn gleaner(&self, args: &[&str]) -> (i32, String) {
        let mut gleaner = Command::new("timeout");
        gleaner.arg(HANGS).arg(program("gleaner")).arg(args[0]).args(&args[1..]).arg(self.path(""));
        if args[0] == "replay" {
            gleaner.arg(sample_drive());
        }
        gleaner
            .env("XDG_CACHE_HOME", root().join("target/test-cache"))
            .env_remove("GLEANER_PYTHON");
        let output = gleaner.output().expect("it starts");
        (output.status.code().unwrap_or(128), String::from_utf8_lossy(&output.stderr).into_owned())
    }

    /// Runs a command, which must refuse what is in `wanted`, a file and the reason.
    #[track_caller]
    fn refuses(&self, args: &[&str], wanted: &str) {
        let (code, said) = self.gleaner(args);
        assert_eq!(code, USAGE, "{args:?} {wanted}: {said}");
        let (name, why) = wanted.split_once("` ").unwrap();
        assert!(
            said.contains(&format!("{name}`")) && said.contains(why) && said.contains("help:"),
            "{wanted}: {said}"
        );
    }
}

#[test]
fn a_build_refuses_by_name_what_is_no_file_of_its_folder_and_leaves_nothing() {
    for (name, bad) in [
        ("lambda.toml", Bad::Link),
        ("lambda.toml", Bad::Device),
        ("lambda.toml", Bad::Pipe),
        ("lambda.toml", Bad::Sparse),
        ("main.py", Bad::Link),
        ("main.py", Bad::Device),
        ("main.py", Bad::Pipe),
        ("main.py", Bad::Sparse),
        ("part/of.py", Bad::Link),
        ("part/of.py", Bad::Sparse),
        ("m.onnx", Bad::Link),
        ("m.onnx", Bad::Device),
        ("m.onnx", Bad::Pipe),
        ("m.onnx", Bad::Sparse),
        ("msg/a/msg/X.msg", Bad::Link),
        ("msg/a/msg/X.msg", Bad::Sparse),
        ("msg", Bad::LinkToFolder),
    ] {
        let lambda = Lambda::new();
        // As a build that was killed leaves it.
        lambda.all.write("lambda/.build.partial/half.py", "");
        let wanted = lambda.spoil(name, bad);
        lambda.refuses(&["build"], &wanted);
        assert!(!lambda.path("build").exists(), "{wanted}");
        // A manifest that cannot be read names no build.
        assert!(name == "lambda.toml" || !lambda.path(".build.partial").exists(), "{wanted}");
    }
}

#[test]
fn a_link_within_the_folder_is_built_as_the_file_that_it_leads_to() {
    let lambda = Lambda::new();
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
fn many_files_without_much_in_them_do_not_fill_the_disk() {
    let lambda = Lambda::new();
    for number in 0..300 {
        let file = File::create(lambda.path(&format!("x{number}.py"))).unwrap();
        file.set_len(gleaner_lambda::SOURCE_MAX.bytes()).unwrap();
    }
    let (code, said) = lambda.gleaner(&["build"]);
    assert_eq!(code, USAGE, "{said}");
    assert!(said.contains("more than 4 GiB") && said.contains("help:"), "{said}");
    assert!(!lambda.path(".build.partial").exists());
}

#[test]
fn every_command_refuses_by_name_what_is_no_file_of_a_build() {
    for (name, bad) in [
        ("build/lambda.toml", Bad::Link),
        ("build/lambda.toml", Bad::Pipe),
        ("build/lambda.toml", Bad::Sparse),
        ("build/main.py", Bad::Link),
        ("build/main.py", Bad::Device),
        ("build/main.py", Bad::Pipe),
        ("build/main.py", Bad::Sparse),
        ("build/more/notes", Bad::Link),
        ("build/more/notes", Bad::Pipe),
        ("build/more/notes", Bad::Sparse),
    ] {
        let lambda = Lambda::built();
        let wanted = lambda.spoil(name, bad);
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
fn an_environment_whose_description_is_no_file_is_refused_and_no_other_taken() {
    let lambda = Lambda::built();
    let python = Parts::find().and_then(|parts| parts.python(None)).expect("there is a Python");
    fs::create_dir_all(lambda.path(".venv/bin")).unwrap();
    symlink(python, lambda.path(".venv/bin/python3")).unwrap();
    for bad in [Bad::Pipe, Bad::Device, Bad::Link, Bad::Sparse] {
        let wanted = lambda.spoil(".venv/pyvenv.cfg", bad);
        lambda.refuses(&["replay"], &wanted);
        lambda.refuses(&["check"], &wanted);
    }
}

#[test]
fn an_update_refuses_a_manifest_that_is_no_file() {
    let lambda = Lambda::new();
    fs::create_dir(lambda.path(".gleaner")).unwrap();
    for bad in [Bad::Pipe, Bad::Device, Bad::Link, Bad::Sparse] {
        let wanted = lambda.spoil("lambda.toml", bad);
        lambda.refuses(&["new", "--update"], &wanted);
    }
}

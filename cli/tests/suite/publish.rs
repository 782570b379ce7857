//! Tests of `gleaner keys` and `gleaner publish`, as a user starts them.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use gleaner_trust::{Floors, Labels, Revision, Verifier};
use serde_json::Value;
use tempfile::TempDir;

use crate::programs;

const MANIFEST: &str = "lambda = { name = 'brake', version = '0.1.0', kind = 'python', entry = 'main.py' }\nschedule.period = '1s'\n";

/// A folder with the lambda `brake`, built, and the key `key.pem`.
struct Workplace(TempDir);

impl Workplace {
    fn new() -> Self {
        let work = Self(tempfile::tempdir().unwrap());
        fs::create_dir(work.path("brake")).unwrap();
        fs::write(work.path("brake/lambda.toml"), MANIFEST).unwrap();
        work.build("x = 0\n");
        work.done(&["keys", "new", "key.pem"]);
        work
    }

    fn path(&self, path: &str) -> PathBuf {
        self.0.path().join(path)
    }

    fn build(&self, source: &str) {
        fs::write(self.path("brake/main.py"), source).unwrap();
        self.done(&["build", "brake"]);
    }

    fn command(&self, arguments: &[&str]) -> Command {
        programs::gleaner(self.0.path(), arguments)
    }

    /// Runs a command that must succeed, and returns its output.
    #[track_caller]
    fn done(&self, arguments: &[&str]) -> String {
        programs::done(&mut self.command(arguments))
    }

    /// Runs a command that must fail with `code`, and returns its message.
    #[track_caller]
    fn fails(&self, code: i32, arguments: &[&str]) -> String {
        let output = programs::output(&mut self.command(arguments));
        assert!(output.stdout.is_empty(), "{output:?}");
        programs::failed(output, code)
    }

    /// Returns the revision as a vehicle reads it that trusts the key.
    fn verified(&self) -> Revision {
        let root = programs::trusting(&self.done(&["keys", "show", "key.pem", "--json"]));
        let (floors, labels) = (Floors::default(), Labels::new());
        let vehicle =
            Verifier { root: &root, floors: &floors, labels: &labels, now: 0, known: &[] };
        let envelope = fs::read(self.path("brake/revision.json")).unwrap();
        vehicle.revision(&envelope).unwrap().payload().clone()
    }
}

const PUBLISH: [&str; 4] = ["publish", "brake", "--key", "key.pem"];

#[test]
fn a_built_lambda_is_signed_with_a_new_key() {
    let work = Workplace::new();
    let mode = fs::metadata(work.path("key.pem")).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    let text = work.done(&PUBLISH);
    assert!(text.starts_with("published brake/revision.json (brake 0.1.0, release 1, 2 files, "));
    let revision = work.verified();
    assert_eq!((revision.name.as_str(), revision.release), ("brake", 1));
    assert!(work.done(&PUBLISH).starts_with("unchanged "));
    work.build("x = 1\n");
    let json = work.done(&[&PUBLISH[..], &["--json"]].concat());
    let json: Value = serde_json::from_str(&json).unwrap();
    assert_eq!((&json["release"], &json["unchanged"]), (&2.into(), &false.into()));
    assert_ne!(work.verified().files, revision.files);
    let shown = work.done(&["keys", "show", "key.pem"]);
    assert!(shown.contains(json["key"].as_str().unwrap()), "{shown}");
}

#[test]
fn a_kill_while_a_key_is_written_leaves_no_file() {
    let work = Workplace::new();
    let before = fs::read_dir(work.0.path()).unwrap().count();
    // The first byte that is written to a file kills the process.
    let limited =
        format!("ulimit -f 0; exec '{}' keys new other.pem", env!("CARGO_BIN_EXE_gleaner"));
    let mut shell = Command::new("sh");
    shell.current_dir(work.0.path()).args(["-c", &limited]).stdin(Stdio::null());
    let killed = programs::output(&mut shell);
    assert!(!killed.status.success());
    assert_eq!(fs::read_dir(work.0.path()).unwrap().count(), before);
    work.done(&["keys", "new", "other.pem"]);
}

#[test]
fn a_foreign_revision_and_a_key_in_the_build_are_refused() {
    let work = Workplace::new();
    work.done(&["keys", "new", "other.pem"]);
    work.done(&["publish", "brake", "--key", "other.pem", "--release", "41"]);
    let text = work.fails(2, &PUBLISH);
    assert!(text.contains("is not signed by this key") && text.contains("give `--release N`"));
    work.done(&[&PUBLISH[..], &["--release", "42"]].concat());
    assert_eq!(work.verified().release, 42);
    fs::copy(work.path("key.pem"), work.path("brake/build/key.pem")).unwrap();
    let text = work.fails(3, &["publish", "brake", "--key", "brake/build/key.pem"]);
    assert!(text.contains("brake/build/key.pem` is a secret key"), "{text}");
}

#[test]
fn refusals_name_the_cause_and_the_way_out() {
    let work = Workplace::new();
    work.fails(2, &["keys", "new", "key.pem"]);
    work.fails(2, &["keys", "show", "brake/main.py"]);
    work.fails(2, &["publish", "brake", "--key", "nowhere.pem"]);
    let text = work.fails(2, &["publish", "nowhere", "--key", "key.pem"]);
    assert!(text.starts_with("error: there is no folder `nowhere`"), "{text}");
    work.done(&PUBLISH);
    work.build("x = 1\n");
    let text = work.fails(2, &[&PUBLISH[..], &["--release", "1"]].concat());
    assert!(text.contains("release 1 cannot replace release 1") && text.contains("omit --release"));
    fs::set_permissions(work.path("key.pem"), fs::Permissions::from_mode(0o644)).unwrap();
    let text = work.fails(3, &PUBLISH);
    assert!(text.contains("mode 644") && text.contains("chmod 600 key.pem"), "{text}");
    fs::set_permissions(work.path("key.pem"), fs::Permissions::from_mode(0o600)).unwrap();
    fs::write(work.path("brake/main.py"), "x = 2\n").unwrap();
    let text = work.fails(2, &PUBLISH);
    assert!(text.contains("older than its source") && text.contains("gleaner build brake"));
}

#[test]
fn a_killed_publish_leaves_the_former_revision_or_the_new_one() {
    let work = Workplace::new();
    work.done(&PUBLISH);
    let (mut former, mut killed) = (work.verified(), 0);
    let part = work.path("brake/revision.json.part");
    for round in 0..30_u32 {
        work.build(&format!("x = {round}1\n"));
        let mut child = programs::start(work.command(&PUBLISH).stdout(Stdio::null()));
        // Half of the processes are killed early, the others once they have begun to write.
        let mut polls = 0;
        while child.try_wait().unwrap().is_none() {
            polls += 1;
            if part.exists() || round % 2 == 0 && polls > 40 * round {
                child.kill().unwrap();
            }
        }
        killed += u32::from(child.wait().unwrap().code().is_none());
        let now = work.verified();
        assert!(now == former || now.release == former.release + 1, "{now:?}");
        former = now;
    }
    assert!(killed > 0, "no process was killed");
    work.build("x = 'end'\n");
    work.done(&PUBLISH);
    assert_eq!(work.verified().release, former.release + 1);
    assert!(!part.exists());
}

//! `gleaner dev`: what is saved is built, replayed and compared, until somebody ends it.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use gleaner_tests::{Folder, program, root, sample_drive};

/// A build and a replay take a second or two; a busy machine needs longer.
const DEADLINE: Duration = Duration::from_secs(120);

/// `gleaner dev`, and the lines that it writes, wherever.
struct Dev {
    child: Child,
    lines: Receiver<String>,
}

impl Drop for Dev {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl Dev {
    fn start(lambda: &Folder) -> Self {
        let mut gleaner = Command::new(program("gleaner"));
        gleaner.arg("dev").arg(lambda.path()).arg(sample_drive()).arg("--no-record");
        gleaner.env("XDG_CACHE_HOME", root().join("target/test-cache"));
        // One pipe for both streams, so that lines come in the order in which they are written.
        let (reader, writer) = std::io::pipe().expect("a pipe");
        let child = gleaner
            .stdout(writer.try_clone().expect("a pipe"))
            .stderr(writer)
            .spawn()
            .expect("gleaner starts");
        let (sender, lines) = channel();
        std::thread::spawn(move || {
            BufReader::new(reader)
                .lines()
                .map_while(Result::ok)
                .try_for_each(|line| sender.send(line))
        });
        Self { child, lines }
    }

    /// What it writes until it waits for the next change.
    fn round(&self) -> String {
        let mut round = String::new();
        loop {
            let line = self
                .lines
                .recv_timeout(DEADLINE)
                .unwrap_or_else(|_| panic!("it does not come to an end: {round}"));
            if line.starts_with("waiting for changes in ") {
                return round;
            }
            round.push_str(&line);
            round.push('\n');
        }
    }
}

#[test]
fn each_change_is_built_replayed_and_compared_with_the_replay_before() {
    let (lambda, source) = (Folder::new(), root().join("examples/hello/python"));
    let read =
        |name: &str| std::fs::read_to_string(source.join(name)).expect("the example is there");
    let (manifest, main) = (read("lambda.toml"), read("main.py"));
    lambda.write("lambda.toml", &manifest);
    lambda.write("main.py", &main);

    let dev = Dev::start(&lambda);
    let first = dev.round();
    assert!(
        first.contains("built ") && first.contains("hello 0.1.0 (python): 0 triggers"),
        "{first}"
    );
    assert!(!first.contains("+ now"), "there is nothing to compare with: {first}");

    lambda.write("lambda.toml", manifest.replace("default = -3.0", "default = -1.4"));
    let gentler = dev.round();
    assert!(gentler.contains("── changed: lambda.toml"), "{gentler}");
    assert!(
        gentler.contains("brake_mps2: -3 → -1.4") || gentler.contains("brake_mps2: -3.0 → -1.4"),
        "{gentler}"
    );
    assert!(gentler.contains("triggers: 0 the same, 0 gone, 3 new, 0 changed"), "{gentler}");

    lambda.write("main.py", format!("{main}\n)"));
    let broken = dev.round();
    assert!(
        broken.contains("error: cannot start lambda `hello`") && broken.contains("SyntaxError"),
        "{broken}"
    );

    // Compared with the last that worked.
    lambda.write("main.py", format!("{main}\n# mended\n"));
    let mended = dev.round();
    assert!(mended.contains("3 triggers the same"), "{mended}");
}

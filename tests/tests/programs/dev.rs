//! `gleaner dev`: each saved change is built, replayed and compared, until the command is stopped.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command};
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use gleaner_tests::{TempFolder, program, root, sample_drive};

/// A build and a replay take a second or two; a busy machine needs longer.
const DEADLINE: Duration = Duration::from_secs(120);

/// `gleaner dev`, with the lines of both of its output streams.
struct DevCommand {
    child: Child,
    lines: Receiver<String>,
}

impl Drop for DevCommand {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

impl DevCommand {
    fn start(lambda: &TempFolder) -> Self {
        let mut gleaner = Command::new(program("gleaner"));
        gleaner.arg("dev").arg(lambda.path()).arg(sample_drive()).arg("--no-record");
        gleaner.env("XDG_CACHE_HOME", root().join("target/test-cache"));
        // One pipe for both streams, so that lines arrive in the order in which they are written.
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

    /// The output until it waits for the next change.
    fn round(&self) -> String {
        let mut round = String::new();
        loop {
            let line = self
                .lines
                .recv_timeout(DEADLINE)
                .unwrap_or_else(|_| panic!("no end of the round: {round}"));
            if line.starts_with("waiting for changes in ") {
                return round;
            }
            round.push_str(&line);
            round.push('\n');
        }
    }
}

#[test]
fn each_change_is_built_replayed_and_compared_with_the_previous_replay() {
    let (lambda, source) = (TempFolder::new(), root().join("examples/hello/python"));
    let read = |name: &str| std::fs::read_to_string(source.join(name)).expect("the example exists");
    let (manifest, main) = (read("lambda.toml"), read("main.py"));
    lambda.write("lambda.toml", &manifest);
    lambda.write("main.py", &main);

    let dev = DevCommand::start(&lambda);
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
    assert!(gentler.contains("triggers: 0 identical, 0 removed, 3 added, 0 changed"), "{gentler}");

    lambda.write("main.py", format!("{main}\n)"));
    let broken = dev.round();
    assert!(
        broken.contains("error: cannot start lambda `hello`") && broken.contains("SyntaxError"),
        "{broken}"
    );

    // Compared with the last successful replay.
    lambda.write("main.py", format!("{main}\n# mended\n"));
    let mended = dev.round();
    assert!(mended.contains("3 triggers identical"), "{mended}");
}

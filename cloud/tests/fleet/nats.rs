//! A NATS server for tests.

use std::fs;
use std::io::{BufRead, BufReader, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use tempfile::TempDir;

/// A server on a port of its own, which ends with this value.
pub(crate) struct NatsServer {
    child: Child,
    folder: TempDir,
    program: PathBuf,
    pub(crate) url: String,
}

impl NatsServer {
    /// Starts a server; without Debian's package, it prints that and returns `None`.
    pub(crate) fn start() -> Option<Self> {
        let program = Path::new("/usr/sbin/nats-server");
        if !program.is_file() {
            println!("skipped: NATS is not installed (Debian: nats-server)");
            return None;
        }
        let folder = tempfile::tempdir().unwrap();
        let child = command(program, &folder, "-1").spawn().unwrap();
        let mut server = Self { child, folder, program: program.to_owned(), url: String::new() };
        server.url = server.listening();
        Some(server)
    }

    /// Publishes these messages to the clouds that use the server.
    pub(crate) fn publish(&self, subject: &str, messages: &[&str]) {
        let mut stream = TcpStream::connect(self.url.trim_start_matches("nats://")).unwrap();
        let mut text = "CONNECT {\"verbose\":false}\r\n".to_owned();
        for message in messages {
            text += &format!("PUB {subject} {}\r\n{message}\r\n", message.len());
        }
        stream.write_all((text + "PING\r\n").as_bytes()).unwrap();
        // After the answer, the server has them.
        let mut lines = BufReader::new(stream).lines();
        assert!(lines.any(|line| line.unwrap() == "PONG"));
    }

    /// Kills the server, and starts another one at the same address.
    pub(crate) fn kill_and_start(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
        let port = self.url.rsplit(':').next().unwrap().to_owned();
        self.child = command(&self.program, &self.folder, &port).spawn().unwrap();
        self.listening();
    }

    /// Waits until the server listens; returns its address.
    fn listening(&self) -> String {
        let file = self.folder.path().join(format!("nats-server_{}.ports", self.child.id()));
        let begin = Instant::now();
        loop {
            let ports = fs::read_to_string(&file).unwrap_or_default();
            if let Ok(ports) = serde_json::from_str::<Value>(&ports) {
                return ports["nats"][0].as_str().unwrap().to_owned();
            }
            assert!(begin.elapsed() < Duration::from_secs(30), "nats-server does not start");
            std::thread::sleep(Duration::from_millis(20));
        }
    }
}

fn command(program: &Path, folder: &TempDir, port: &str) -> Command {
    let mut command = Command::new(program);
    command.args(["-a", "127.0.0.1", "-p", port, "--ports_file_dir"]).arg(folder.path());
    command.stdout(Stdio::null()).stderr(Stdio::null());
    command
}

impl Drop for NatsServer {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

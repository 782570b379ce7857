//! A PostgreSQL server for tests, and tests that run once more on it.

use std::fs;
use std::io::Read;
use std::os::unix::fs::{PermissionsExt, chown};
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use sqlx_core::connection::Connection;
use sqlx_core::raw_sql::raw_sql;
use sqlx_core::sql_str::AssertSqlSafe;
use sqlx_postgres::PgConnection;
use tempfile::TempDir;

/// Variable with the URL of the server, for tests that run on it.
const STORE: &str = "GLEANER_TEST_STORE";

/// User of the server if root runs the tests: PostgreSQL refuses to run as root.
const NOBODY: u32 = 65534;

/// A server that listens on a socket in its folder, and ends with this value.
struct PostgresServer {
    child: Child,
    folder: TempDir,
}

/// Returns the URL of a database for the tests in a folder, if they run on PostgreSQL: a schema of
/// its own, which is created.
pub async fn store_of(folder: &Path) -> Option<String> {
    let server = std::env::var(STORE).ok()?;
    let name = folder.file_name().unwrap().to_str().unwrap();
    let schema = format!("t{}", gleaner_base::hex(name.as_bytes()));
    let mut connection = PgConnection::connect(&server).await.unwrap();
    let sql = AssertSqlSafe(format!("CREATE SCHEMA IF NOT EXISTS {schema}"));
    raw_sql(sql).execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    Some(format!("{server}?options=-csearch_path%3D{schema}"))
}

/// Runs the tests of this program that have one of these names again, on PostgreSQL, but not
/// `except`, with these environment variables. Without PostgreSQL, it prints that and returns.
pub fn run_again(names: &[&str], except: &str, variables: &[(&str, &str)]) {
    let Some(programs) = programs() else {
        println!("skipped: PostgreSQL is not installed (Debian: postgresql)");
        return;
    };
    let server = PostgresServer::start(&programs);
    let socket = server.folder.path().join("run").display().to_string().replace('/', "%2F");
    let url = format!("postgres://nobody@{socket}/postgres");
    let mut tests = Command::new(std::env::current_exe().unwrap());
    // Many tests at a time would need more connections than the server has.
    tests.args(names).args(["--skip", except, "--test-threads", "4"]);
    let output = tests.env(STORE, url).envs(variables.iter().copied()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && !text.contains(" 0 passed"), "{text}{errors}");
    for name in names {
        let ran = |line: &str| line.starts_with("test ") && line.contains(name);
        assert!(text.lines().any(ran), "no test has the name {name}: {text}");
    }
}

/// Returns the folder of the newest programs of Debian's package.
fn programs() -> Option<PathBuf> {
    let versions = fs::read_dir("/usr/lib/postgresql").ok()?;
    let folders = versions.flatten().map(|entry| entry.path().join("bin"));
    folders.filter(|folder| folder.join("initdb").is_file()).max()
}

fn is_root() -> bool {
    fs::metadata("/proc/self").is_ok_and(|it| std::os::unix::fs::MetadataExt::uid(&it) == 0)
}

/// Returns a command that runs as the user of the server.
fn command(program: &Path) -> Command {
    let mut command = Command::new(program);
    if is_root() {
        command.uid(NOBODY).gid(NOBODY);
    }
    command.env_remove("PGPASSWORD").env("LC_ALL", "C").current_dir("/").stdin(Stdio::null());
    command
}

impl PostgresServer {
    fn start(programs: &Path) -> Self {
        // The folder of temporary files of this user may be closed to others.
        let folder = match is_root() {
            true => tempfile::tempdir_in("/tmp").unwrap(),
            false => tempfile::tempdir().unwrap(),
        };
        let [data, run] = ["data", "run"].map(|name| folder.path().join(name));
        fs::create_dir(&run).unwrap();
        fs::create_dir(&data).unwrap();
        if is_root() {
            fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
            chown(&data, Some(NOBODY), Some(NOBODY)).unwrap();
            chown(&run, Some(NOBODY), Some(NOBODY)).unwrap();
        }
        let made = command(&programs.join("initdb"))
            .args(["--username=nobody", "--auth=trust", "--encoding=UTF8", "--no-sync", "-D"])
            .arg(&data)
            .output()
            .unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let mut server = command(&programs.join("postgres"));
        server.arg("-D").arg(&data).arg("-k").arg(&run);
        // Only on the socket: other users of this machine cannot reach it.
        server.args(["-c", "listen_addresses=", "-c", "max_connections=200"]);
        let mut child = server.stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
        let mut log = child.stderr.take().unwrap();
        let mut text = Vec::new();
        while !String::from_utf8_lossy(&text).contains("ready to accept connections") {
            let mut part = [0; 4096];
            let read = log.read(&mut part).unwrap();
            assert!(read > 0, "it has ended: {}", String::from_utf8_lossy(&text));
            text.extend_from_slice(&part[..read]);
        }
        // It would stop at a full pipe.
        std::thread::spawn(move || std::io::copy(&mut log, &mut std::io::sink()));
        Self { child, folder }
    }
}

impl Drop for PostgresServer {
    fn drop(&mut self) {
        // SIGINT stops it at once, with its own processes.
        let id = rustix::process::Pid::from_child(&self.child);
        let _ = rustix::process::kill_process(id, rustix::process::Signal::INT);
        let _ = self.child.wait();
    }
}

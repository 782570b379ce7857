//! All programs of the scaled cloud, with a temporary folder.

use std::fs::{self, Permissions};
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::os::unix::fs::{MetadataExt, PermissionsExt, chown};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use signal_hook::consts::{SIGINT, SIGTERM};

use super::services::{Service, find, free_addresses};
use crate::checkout::Checkout;
use crate::private_folder::PrivateFolder;
use crate::steps::{copy_files, output};

/// User of PostgreSQL if root runs this: it refuses to run as root.
const NOBODY: u32 = 65534;
const REPLICAS: usize = 3;
/// Credentials of the object store, which is on this machine and checks none.
const KEY: &str = "fleet";

pub(super) struct ScaledCloud {
    pub(super) people: SocketAddr,
    pub(super) vehicles: SocketAddr,
    pub(super) code: String,
    is_stopping: Arc<AtomicBool>,
    /// In the order in which they are killed.
    services: Vec<Service>,
    _store: Service,
    _folder: PrivateFolder,
}

impl ScaledCloud {
    pub(super) fn start(checkout: &Checkout) -> Result<Self, Failure> {
        let failed = |error: io::Error| {
            Failure::caused_by(Exit::Internal, "cannot prepare the folder of the fleet", &error)
        };
        let is_stopping = Arc::<AtomicBool>::default();
        for signal in [SIGINT, SIGTERM] {
            signal_hook::flag::register(signal, Arc::clone(&is_stopping)).map_err(failed)?;
        }
        let folder = PrivateFolder::create("fleet")?;
        let path = folder.path().to_owned();
        fs::set_permissions(&path, Permissions::from_mode(0o755)).map_err(failed)?;
        println!("logs are in {}", path.display());
        let [database, bus, store, people, vehicles] = free_addresses::<5>()?;
        let listeners = free_addresses::<{ 2 * REPLICAS }>()?;
        let program = |name: &str| find(checkout, name).unwrap_or_else(|| name.into());
        let log = |name: &str| path.join(format!("{name}.log"));

        let postgres = postgres(checkout, &path, database)?;
        let postgres = Service::start("PostgreSQL", postgres, database, &log("postgres"))?;
        let mut nats = Command::new(program("nats-server"));
        nats.args(["-a", "127.0.0.1", "-p", &bus.port().to_string()]);
        let nats = Service::start("NATS", nats, bus, &log("nats"))?;
        let mut moto = Command::new(program("moto_server"));
        moto.args(["-H", "127.0.0.1", "-p", &store.port().to_string()]);
        let moto = Service::start("the object store", moto, store, &log("moto"))?;
        make_bucket(store).map_err(failed)?;

        let mut replicas = Vec::new();
        for (index, name) in ["replica 1", "replica 2", "replica 3"].into_iter().enumerate() {
            let data = path.join(format!("data-{index}"));
            if index > 0 {
                // All replicas have the same authorities.
                copy_files(&path.join("data-0/ca"), &data.join("ca")).map_err(failed)?;
            }
            let [people_of, vehicles_of] = [listeners[2 * index], listeners[2 * index + 1]];
            let mut replica = Command::new(checkout.program("gleaner-cloud"));
            replica.arg("serve").arg("--data").arg(&data);
            replica.args(["--store", &format!("postgres://nobody@{database}/postgres")]);
            replica.args(["--bus", &format!("nats://{bus}"), "--objects", "s3://gleaner"]);
            replica.args(["--http", &people_of.to_string()]);
            replica.args(["--vehicles", &vehicles_of.to_string()]);
            replica.args(["--name", &vehicles.to_string()]);
            replica.env("AWS_ENDPOINT_URL", format!("http://{store}"));
            replica.env("AWS_ACCESS_KEY_ID", KEY).env("AWS_SECRET_ACCESS_KEY", KEY);
            replicas.push(Service::start(name, replica, people_of, &log(name))?);
        }
        let code = code(&log("replica 3"))?;
        fs::write(path.join("haproxy.cfg"), balancer(people, vehicles, &listeners))
            .map_err(failed)?;
        let mut haproxy = Command::new(program("haproxy"));
        haproxy.arg("-db").arg("-f").arg(path.join("haproxy.cfg"));
        let haproxy = Service::start("haproxy", haproxy, people, &log("haproxy"))?;
        let mut services = vec![postgres, nats, haproxy];
        for (index, replica) in replicas.into_iter().enumerate() {
            services.insert(2 * index, replica);
        }
        Ok(Self { people, vehicles, code, is_stopping, services, _store: moto, _folder: folder })
    }

    /// Kills the next program, and starts it again; returns its name.
    pub(super) fn kill_and_start(&mut self, number: u64) -> Result<&'static str, Failure> {
        let index = number as usize % self.services.len();
        let service = &mut self.services[index];
        service.kill_and_start().map(|()| service.name)
    }

    /// Waits for ctrl-C, but no longer than `time`; returns whether it came.
    pub(super) fn wait(&self, time: Duration) -> bool {
        let begun = Instant::now();
        while !self.is_stopping.load(Ordering::Relaxed) {
            if begun.elapsed() > time {
                return false;
            }
            sleep(Duration::from_millis(100));
        }
        true
    }
}

/// Makes a database; returns the command that serves it.
fn postgres(checkout: &Checkout, folder: &Path, address: SocketAddr) -> Result<Command, Failure> {
    let failed = |error: io::Error| {
        Failure::caused_by(Exit::Internal, "cannot prepare the folder of PostgreSQL", &error)
    };
    let data = folder.join("postgres");
    fs::create_dir(&data).map_err(failed)?;
    let is_root = fs::metadata("/proc/self").is_ok_and(|it| it.uid() == 0);
    if is_root {
        chown(&data, Some(NOBODY), Some(NOBODY)).map_err(failed)?;
    }
    let command = |name: &str| {
        let mut command = Command::new(find(checkout, name).unwrap_or_else(|| name.into()));
        if is_root {
            command.uid(NOBODY).gid(NOBODY);
        }
        command.env("LC_ALL", "C").current_dir("/");
        command
    };
    let mut make = command("initdb");
    make.args(["--username=nobody", "--auth=trust", "--encoding=UTF8", "-D"]).arg(&data);
    output(&mut make, "see the messages above")?;
    let mut serve = command("postgres");
    serve.arg("-D").arg(&data).args(["-c", "listen_addresses=127.0.0.1"]);
    serve.args(["-c", "unix_socket_directories=", "-p", &address.port().to_string()]);
    Ok(serve)
}

fn make_bucket(store: SocketAddr) -> io::Result<()> {
    let mut stream = TcpStream::connect(store)?;
    stream.write_all(
        b"PUT /gleaner HTTP/1.1\r\nHost: store\r\nContent-Length: 0\r\nConnection: close\r\n\r\n",
    )?;
    let mut answer = String::new();
    stream.read_to_string(&mut answer)?;
    match answer.contains(" 200 ") {
        true => Ok(()),
        false => Err(io::Error::other(format!("the object store answers {answer}"))),
    }
}

/// Returns the code that a replica has printed: that of the newest one counts.
fn code(log: &Path) -> Result<String, Failure> {
    // It listens before it prints.
    for _ in 0..100 {
        let text = fs::read_to_string(log).unwrap_or_default();
        let line = text.lines().find(|line| line.starts_with("first:"));
        if let Some(code) = line.and_then(|line| line.rsplit(' ').next()) {
            return Ok(code.to_owned());
        }
        sleep(Duration::from_millis(100));
    }
    Err(Failure::new(Exit::Internal, "a replica has printed no code"))
}

/// Returns the configuration of the balancer, which passes TLS on as it is.
fn balancer(people: SocketAddr, vehicles: SocketAddr, listeners: &[SocketAddr]) -> String {
    let mut text = "global\n  maxconn 8000\ndefaults\n  mode tcp\n  balance leastconn\n  \
                    option redispatch\n  retries 3\n  timeout connect 2s\n  timeout client 1h\n  \
                    timeout server 1h\n  timeout check 2s\n  \
                    default-server check inter 500ms fall 2 rise 1 on-marked-down \
                    shutdown-sessions\n"
        .to_owned();
    for (index, (name, address)) in [("people", people), ("vehicles", vehicles)].iter().enumerate()
    {
        text += &format!("listen {name}\n  bind {address}\n");
        for (number, replica) in listeners.iter().skip(index).step_by(2).enumerate() {
            text += &format!("  server replica{number} {replica}\n");
        }
    }
    text
}

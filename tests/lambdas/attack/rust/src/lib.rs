//! Attacks its environment, once, in its third wake. An event reports the outcome: `refused` with
//! the error, or `escaped`.
//!
//! For a bench it attacks repeatedly instead: in every other interval of `every_ms` milliseconds of
//! the wall clock. Two good wakes precede each attack that is a fault, which prevents back-off.

use std::time::Duration;

use gleaner_sdk::{Config, Error, Field, Lambda, Result, Tick, event, input, log, now_ns};

struct Attack {
    attack: String,
    every_ms: i64,
    touch_mib: i64,
    wakes: u64,
    fields: Vec<Field>,
    bytes: Vec<Vec<u8>>,
}

impl Lambda for Attack {
    fn init(config: &Config) -> Result<Self> {
        let attack = config.text("attack")?.to_owned();
        let (every_ms, touch_mib) = (config.integer("every_ms")?, config.integer("touch_mib")?);
        Ok(Attack { attack, every_ms, touch_mib, wakes: 0, fields: Vec::new(), bytes: Vec::new() })
    }

    fn on_tick(&mut self, _tick: Tick) -> Result<()> {
        self.wakes += 1;
        if !self.is_due() || self.attack == "none" {
            return Ok(());
        }
        match self.attack() {
            Ok(()) => event("escaped", 1.0).send(),
            Err(error) => event("refused", 1.0).with("why", error.to_string().as_str()).send(),
        }
    }
}

impl Attack {
    fn is_due(&self) -> bool {
        match self.every_ms {
            0 => self.wakes == 3,
            every_ms => self.wakes >= 3 && now_ns() / (every_ms * 1_000_000) % 2 == 1,
        }
    }

    fn attack(&mut self) -> Result<()> {
        match self.attack.as_str() {
            "endless" => loop {
                std::hint::black_box(self.wakes);
            },
            "host_calls" => loop {
                std::hint::black_box(now_ns());
            },
            "recurse" => drop(deeper(self.wakes)),
            "memory" => loop {
                self.bytes.push(std::hint::black_box(Vec::with_capacity(1 << 20)));
            },
            // Writes all of its memory over and over: load for caches and the memory bus.
            "touch" => {
                self.bytes = (0..self.touch_mib).map(|_| vec![0; 1 << 20]).collect();
                loop {
                    self.bytes.iter_mut().for_each(|piece| piece.fill(std::hint::black_box(1)));
                }
            }
            "log_flood" => (0..5000).for_each(|_| log::info(&"x".repeat(100))),
            "event_flood" => (0..5000).try_for_each(|_| event("flood", 1.0).send())?,
            "handles" => loop {
                self.fields.push(input("camera")?.field("format")?);
            },
            "fork" | "program" => drop(std::process::Command::new("/bin/true").status()?),
            "read_passwd" => drop(std::fs::read("/etc/passwd")?),
            "socket" => drop(std::net::UdpSocket::bind("127.0.0.1:0")?),
            "connect" => drop(std::net::TcpStream::connect("127.0.0.1:9")?),
            "write_outside" => std::fs::write("/tmp/gleaner-escaped", "here I was")?,
            "sleep" => std::thread::sleep(Duration::from_secs(3600)),
            "exit" => std::process::exit(3),
            "abort" => std::process::abort(),
            other => return Err(Error::new(format!("unknown attack `{other}`"))),
        }
        Ok(())
    }
}

fn deeper(n: u64) -> [u64; 64] {
    let mut stack = [n; 64];
    if n < u64::MAX {
        stack = deeper(std::hint::black_box(n + 1));
    }
    std::hint::black_box(stack)
}

gleaner_sdk::lambda!(Attack);

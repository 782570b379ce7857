//! Breaks the rules for lambdas as configured. The host must not be harmed.

use gleaner_sdk::{Config, Error, Lambda, Result, Sample, event, input, log};

pub struct Misbehave {
    behaviour: String,
    held: Vec<Sample>,
    wakes: u64,
}

impl Lambda for Misbehave {
    fn init(config: &Config) -> Result<Self> {
        let behaviour = config.text("behaviour")?.to_owned();
        match behaviour.as_str() {
            "error_in_init" => return Err(Error::new("no, not today")),
            "event_in_init" => event("too early", 1.0).send()?,
            "panic_in_init" => panic!("no, not today"),
            "bad_input" => drop(input("imo")?),
            "bad_field" => drop(input("imu")?.field("linear_acceleration.w")?),
            "struct_field" => drop(input("imu")?.field("linear_acceleration")?),
            _ => {}
        }
        Ok(Self { behaviour, held: Vec::new(), wakes: 0 })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        self.wakes += 1;
        let behaviour = match self.behaviour.as_str() {
            "now_and_then" => now_and_then(input("imu")?.counts().received),
            other => other,
        };
        match behaviour {
            "error" => return Err(Error::new("I do not want to")),
            "panic" => panic!("wake {} is one too many", self.wakes),
            "endless" => loop {
                std::hint::black_box(self.wakes);
            },
            "host_calls" => loop {
                std::hint::black_box(sample.stamps());
            },
            "memory" => loop {
                self.held.reserve(1 << 20);
                std::mem::forget(std::mem::take(&mut self.held));
            },
            "recurse" => drop(deeper(self.wakes)),
            "exit" => std::process::exit(3),
            "sleep" => std::thread::sleep(std::time::Duration::from_secs(3600)),
            "read_file" => drop(std::fs::read("/etc/passwd")?),
            "connect" => drop(std::net::TcpStream::connect("127.0.0.1:1")?),
            "not_a_frame" => drop(sample.as_frame()?),
            "huge_label" => event(&"x".repeat(1000), 1.0).send()?,
            "too_many_triggers" => (0..17).try_for_each(|_| event("x", 1.0).send())?,
            "event_then_error" => {
                event("seen", 1.0).send()?;
                return Err(Error::new("after the event"));
            }
            "print_in_pieces" => eprintln!("wake {} of {}", self.wakes, self.behaviour),
            "event_then_panic" => {
                event("seen", 1.0).send()?;
                panic!("after the event");
            }
            "nan_score" => event("x", f64::NAN).send()?,
            // The bits of this NaN depend on the processor.
            "nan_bits" => {
                let [a, b] = std::hint::black_box([0.0_f64, 0.0]);
                event("nan", 0.0)
                    .with("bits", format!("{:016x}", (a / b).to_bits()).as_str())
                    .send()?;
            }
            "hold" => self.held.push(sample),
            "measure" => {
                let x = sample.number(&input("imu")?.field("linear_acceleration.x")?)?;
                let measured = event("measured", (x * self.wakes as f64).sin()).with("x", x);
                // In a minute these exceed the limit of events.
                log::info(&format!("{:?} of {x}", measured.send()));
            }
            "log_flood" => (0..1000).for_each(|i| log::info(&format!("line {i}"))),
            "print" => println!("hello from {}", self.wakes),
            "ok" => {}
            other => return Err(Error::new(format!("unknown behaviour `{other}`"))),
        }
        Ok(())
    }
}

/// The behaviour after `received` samples: mostly work, and each kind of fault now and then.
fn now_and_then(received: u64) -> &'static str {
    match received % 64 {
        7 => "panic",
        17 => "error",
        27 => "endless",
        37 => "memory",
        47 => "recurse",
        52 => "sleep",
        57 => "event_then_panic",
        60 => "log_flood",
        _ => "measure",
    }
}

#[allow(unconditional_recursion)]
fn deeper(n: u64) -> [u64; 64] {
    let mut below = deeper(n + 1);
    below[(n % 64) as usize] += std::hint::black_box(n);
    below
}

gleaner_sdk::lambda!(Misbehave);

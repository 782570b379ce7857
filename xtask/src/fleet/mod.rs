//! `cargo xtask fleet`: the cloud in its scaled form on this machine: three replicas over
//! PostgreSQL, NATS and an object store, behind a TCP balancer.
//!
//! `services` starts and kills one program of it, and `scaled` has all of them.

mod scaled;
mod services;

use std::ffi::OsString;
use std::io::{BufRead, BufReader};
use std::process::{Command, Stdio};
use std::time::Duration;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::setup;
use crate::steps::{self, Steps};
use crate::venv;
use scaled::ScaledCloud;
use services::{find, missing};

const USAGE: &str = "`cargo xtask fleet` takes --install, --kills N, --vehicles N and --every S";

struct FleetOptions {
    is_installing: bool,
    /// Number of programs to kill; without any, the cloud runs until ctrl-C.
    kills: u64,
    /// Number of simulated vehicles meanwhile.
    vehicles: u64,
    /// Time between two kills, in s.
    every: u64,
}

impl FleetOptions {
    fn parse(arguments: &[OsString]) -> Option<Self> {
        let mut options = Self { is_installing: false, kills: 0, vehicles: 1000, every: 10 };
        let mut arguments = arguments.iter().map(|it| it.to_str().unwrap_or_default());
        while let Some(argument) = arguments.next() {
            let mut number = || arguments.next()?.parse::<u64>().ok().filter(|it| *it > 0);
            match argument {
                "--install" => options.is_installing = true,
                "--kills" => options.kills = number()?,
                "--vehicles" => options.vehicles = number()?,
                "--every" => options.every = number()?,
                _ => return None,
            }
        }
        Some(options)
    }
}

pub(crate) fn run_scaled(checkout: &Checkout, arguments: &[OsString]) -> Result<Exit, Failure> {
    let options = FleetOptions::parse(arguments).ok_or_else(|| Failure::new(Exit::Usage, USAGE))?;
    let mut steps = Steps::of(3);
    steps.begin("PostgreSQL, NATS, haproxy and an object store");
    let missing = || missing(checkout);
    steps::require_packages(checkout, "fleet", options.is_installing, missing)?;
    if find(checkout, "moto_server").is_none() {
        if !options.is_installing {
            let message = "`moto_server`, an object store, is missing";
            let help = "it has many packages: cargo xtask fleet --install";
            return Err(Failure::new(Exit::Unreachable, message).with_help(help));
        }
        venv::apart(checkout, &checkout.target().join("fleet/venv"), &["moto[server]"])?;
    }
    steps.begin("programs (the first time this takes minutes)");
    setup::programs(checkout)?;
    if options.kills > 0 {
        setup::binaries(checkout, &["gleaner-fleet-bench"])?;
    }
    steps.begin("three replicas");
    let mut cloud = ScaledCloud::start(checkout)?;
    println!("people:   http://{}", cloud.people);
    println!("vehicles: {}", cloud.vehicles);
    println!("page:     http://{}/login", cloud.people);
    if options.kills > 0 {
        return kill(checkout, &mut cloud, &options);
    }
    println!("first:    gleaner login http://{} --code {}", cloud.people, cloud.code);
    println!("ctrl-C ends it, and removes everything");
    cloud.wait(Duration::MAX);
    Ok(Exit::Ok)
}

/// Kills one program after the other under simulated vehicles, which check that nothing is lost.
fn kill(
    checkout: &Checkout,
    cloud: &mut ScaledCloud,
    options: &FleetOptions,
) -> Result<Exit, Failure> {
    let failed =
        |error| Failure::caused_by(Exit::Internal, "cannot run gleaner-fleet-bench", &error);
    let mut bench: Command = checkout.command(checkout.program("gleaner-fleet-bench"));
    bench.args(["--people", &cloud.people.to_string(), "--cloud", &cloud.vehicles.to_string()]);
    bench.args(["--code", &cloud.code, "--vehicles", &options.vehicles.to_string()]);
    let mut bench = bench.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().map_err(failed)?;
    let output = bench.stdout.take();
    let output =
        output.ok_or_else(|| Failure::new(Exit::Internal, "gleaner-fleet-bench has no output"))?;
    let lines = BufReader::new(output);
    for line in lines.lines() {
        let line = line.map_err(failed)?;
        println!("{line}");
        if line.starts_with("all vehicles are connected") {
            for number in 0..options.kills {
                if cloud.wait(Duration::from_secs(options.every)) {
                    break;
                }
                println!("kill {}: {}", number + 1, cloud.kill_and_start(number)?);
            }
            // The last kill has its time, too.
            cloud.wait(Duration::from_secs(options.every));
            drop(bench.stdin.take());
        }
    }
    let ended = bench.wait().map_err(failed)?;
    Ok(if ended.success() { Exit::Ok } else { Exit::Internal })
}

//! Measures the cloud under a simulated fleet, against its promises. `cargo xtask bench fleet`
//! builds both programs first.
//!
//! - `identity` enrols vehicles, and `vehicle` is one: it speaks the protocol of real vehicles over
//!   TLS, and runs nothing. `simulation` is the state that all of them share.
//! - `cloud_process` starts and measures the real `gleaner-cloud`, `administrator` is its user, and
//!   `fleet` has both with the vehicles.
//! - `release` is what people deploy, and `rollouts` deploys it in waves, one after the other.
//! - `load` measures a fleet that connects, is idle and is active; `chaos` kills the cloud.

mod administrator;
mod chaos;
mod cloud_process;
mod figure;
mod fleet;
mod identity;
mod load;
mod release;
mod rollouts;
mod simulation;
mod vehicle;

use std::net::SocketAddr;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use chaos::RunningCloud;
use clap::Parser;
use gleaner_bench::{BenchResults, Figure};
use load::LoadTimes;

/// Measures the cloud under a simulated fleet.
#[derive(Parser)]
struct Args {
    /// 1,000 vehicles for a short time: tests the bench itself; figures of time do not count.
    #[arg(long)]
    quick: bool,
    /// Folder for results.json, tables, figures and report.html
    #[arg(long, value_name = "DIR", default_value = "target/bench/fleet")]
    out: PathBuf,
    /// Number of vehicles under load
    #[arg(long, value_name = "N")]
    vehicles: Option<usize>,
    /// Time under load, in s
    #[arg(long, value_name = "S")]
    seconds: Option<u64>,
    /// Number of times that the cloud is killed, under 1,000 vehicles
    #[arg(long, value_name = "N")]
    kills: Option<usize>,
    /// Address for people of a running cloud, of which others kill parts until standard input ends
    #[arg(long, value_name = "ADDRESS", requires_all = ["cloud", "code"])]
    people: Option<SocketAddr>,
    /// Its address for vehicles
    #[arg(long, value_name = "ADDRESS", requires = "people")]
    cloud: Option<SocketAddr>,
    /// A one-time code of its administrator
    #[arg(long, value_name = "CODE", requires = "people")]
    code: Option<String>,
}

fn main() -> ExitCode {
    let args = Args::parse();
    // Each vehicle takes one, and another one while it fetches files.
    gleaner_base::raise_open_files();
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build();
    let measured = match runtime {
        Ok(runtime) => runtime.block_on(measure(&args)),
        Err(error) => Err(format!("cannot start threads: {error}")),
    };
    let mut results = BenchResults::new("fleet", args.quick);
    match measured {
        Ok(figures) => {
            results.figures = figures;
            results.is_complete = true;
            results.machine.add_load("load after");
            let stored = results.store(&args.out).and_then(|()| gleaner_bench::render(&args.out));
            if let Err(failure) = stored {
                eprintln!("{failure}");
                return failure.exit.into();
            }
            // In a short run, only errors count.
            let mut counted = results.figures.iter().filter(|it| !args.quick || it.is_of_errors());
            ExitCode::from(u8::from(!counted.all(Figure::is_met)))
        }
        Err(reason) => {
            eprintln!("error: the fleet cannot be measured\n  cause: {reason}");
            ExitCode::FAILURE
        }
    }
}

async fn measure(args: &Args) -> Result<Vec<Figure>, String> {
    if let (Some(people), Some(cloud), Some(code)) = (args.people, args.cloud, &args.code) {
        let running = RunningCloud { people, cloud, code: code.clone() };
        return chaos::figures_of(&running, args.vehicles.unwrap_or(1000)).await;
    }
    let by_hand = |quick: u64, full: u64| if args.quick { quick } else { full };
    let vehicles = args.vehicles.unwrap_or(if args.quick { 1000 } else { 10_000 });
    let times = LoadTimes {
        idle: Duration::from_secs(by_hand(4, 30)),
        active: Duration::from_secs(args.seconds.unwrap_or(by_hand(10, 600))),
        has_silent: !args.quick,
    };
    let kills = args.kills.unwrap_or(if args.quick { 2 } else { 60 });
    let mut figures = Vec::new();
    if vehicles > 0 {
        figures.extend(load::figures(vehicles, &times).await?);
    }
    if kills > 0 {
        let count = if args.quick { 200 } else { 1000 };
        figures.extend(chaos::figures(count, kills, Duration::from_secs(by_hand(5, 10))).await?);
    }
    Ok(figures)
}

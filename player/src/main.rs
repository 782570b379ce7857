//! `gleaner-player`: plays drives as live topics of ROS 2. Started by `gleaner play`; see
//! `gleaner play --help`.
//!
//! One thread reads a `source` (a drive, or synthetic sensors) ahead into a bounded `queue`. Lanes,
//! which are threads, take messages from it, wait until each is due by the `pace`, and write it
//! through `cyclone`, the only module that uses Cyclone DDS. No message is copied between the queue
//! and the kernel.

mod args;
mod buffer;
mod cdr;
mod config;
mod counts;
mod cyclone;
mod lane;
mod names;
mod offer;
mod pace;
mod play;
mod queue;
mod source;
mod stamp;
mod stderr;
mod summary;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    match play::run(&args::Args::parse()) {
        Ok(exit) => exit.into(),
        Err(failure) => {
            stderr::line(&failure.to_string());
            failure.exit.into()
        }
    }
}

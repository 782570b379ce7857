//! `gleaner-player`: plays drives as live topics of ROS 2. `gleaner play` starts it; see `gleaner
//! play --help`.
//!
//! A `source` (a drive, or made-up sensors) is read ahead by one thread into a bounded `queue`;
//! lanes, which are threads, take messages from it, wait until each is due by the `pace`, and write
//! it through `cyclone`, the one room that knows Cyclone DDS. No message is copied after it was put
//! into the queue, until the kernel sends it.

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
mod say;
mod source;
mod stamp;
mod summary;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    match play::run(&args::Args::parse()) {
        Ok(exit) => exit.into(),
        Err(failure) => {
            say::line(&failure.to_string());
            failure.exit.into()
        }
    }
}

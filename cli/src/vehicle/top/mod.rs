//! `gleaner top`: the cost of each lambda of a vehicle, about each second.
//!
//! - `metrics`: rates and sums of a status, compared with earlier ones. It does no I/O.
//! - `columns`: the table of the lambdas. `page`: the page of a terminal, with it.
//! - `screen`: the terminal, keys and signals.

mod columns;
mod metrics;
mod page;
mod screen;

use std::collections::VecDeque;
use std::io::{IsTerminal, stdout};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_protocol::vehicle_api::VehicleStatus;
use ratatui::crossterm::terminal;
use serde_json::json;

use super::client::VehicleClient;
use crate::args::TopArgs;
use crate::output::{end_with_reader, print_json, show};
use metrics::VehicleMetrics;

/// Time from a poll to the next. The processes report their counts as often.
const POLL_INTERVAL: Duration = Duration::from_secs(1);

/// Number of statuses that are kept. A report that has not changed since the last poll is compared
/// with that of an earlier one; if none has changed, the rate is unknown.
const POLLS_KEPT: usize = 4;

pub(crate) fn top(args: &TopArgs) -> Result<Exit, Failure> {
    let client = VehicleClient::of(&args.source)?;
    if !args.once && !args.source.vehicle.json && !stdout().is_terminal() {
        return Err(Failure::new(Exit::Usage, "`gleaner top` needs a terminal")
            .with_help("`--once` prints a table, and `--json` an object for each poll"));
    }
    if !args.once {
        end_with_reader();
    }
    let mut polls = Polls::default();
    polls.add(client.status()?);
    match (args.once, args.source.vehicle.json) {
        (true, json) => {
            let metrics = once(&client, &mut polls)?;
            show(json, &metrics, |metrics| columns::text(metrics, width()))
        }
        (false, true) => follow(&client, &mut polls),
        (false, false) => screen::run(client, polls),
    }
}

/// The newest statuses.
#[derive(Default)]
struct Polls(VecDeque<VehicleStatus>);

impl Polls {
    fn add(&mut self, status: VehicleStatus) {
        self.0.push_front(status);
        self.0.truncate(POLLS_KEPT);
    }

    fn newest(&self) -> Option<&VehicleStatus> {
        self.0.front()
    }

    /// Returns the figures of the newest status.
    fn metrics(&self) -> VehicleMetrics {
        let mut polls = self.0.iter();
        let newest = polls.next().expect("the first poll is added before this");
        VehicleMetrics::of(newest, polls)
    }
}

/// Returns figures with rates: after the second poll, or up to two later if a lambda that runs has
/// not reported in between.
fn once(client: &VehicleClient, polls: &mut Polls) -> Result<VehicleMetrics, Failure> {
    loop {
        thread::sleep(POLL_INTERVAL);
        polls.add(client.status()?);
        let metrics = polls.metrics();
        if polls.0.len() == POLLS_KEPT || metrics.are_complete() {
            return Ok(metrics);
        }
    }
}

/// Returns the number of characters of a line: all that a terminal has, and any number elsewhere.
fn width() -> usize {
    let columns = terminal::size().ok().filter(|_| stdout().is_terminal());
    columns.map_or(usize::MAX, |(columns, _)| usize::from(columns))
}

/// Prints an object for each poll, until its reader closes the pipe.
fn follow(client: &VehicleClient, polls: &mut Polls) -> Result<Exit, Failure> {
    let mut answered = Instant::now();
    let mut line = json!(polls.metrics());
    while print_json(&line)? {
        thread::sleep(POLL_INTERVAL);
        line = match client.status() {
            Ok(status) => {
                answered = Instant::now();
                polls.add(status);
                json!(polls.metrics())
            }
            Err(failure) => {
                let for_s = answered.elapsed().as_secs_f64();
                json!({ "unreachable": failure.message, "for_s": for_s })
            }
        };
    }
    Ok(Exit::Ok)
}

#[cfg(test)]
mod tests;

//! The terminal of `gleaner top`: draws the page, and takes keys and signals. Polls have a thread
//! of their own, as an orchestrator that is stopped does not answer.

use std::io;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, sync_channel};
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure};
use gleaner_protocol::vehicle_api::VehicleStatus;
use ratatui::DefaultTerminal;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyEvent, KeyEventKind, KeyModifiers};

use super::page::Page;
use super::{POLL_INTERVAL, Polls};
use crate::run::stop_flag;
use crate::vehicle::VehicleClient;

/// Longest wait for a key, until signals and polls are looked at.
const TICK: Duration = Duration::from_millis(100);

/// Shows the page until a key or a signal ends it.
pub(super) fn run(client: VehicleClient, polls: Polls) -> Result<Exit, Failure> {
    let failed = |action: &str, error: &dyn std::error::Error| {
        Failure::caused_by(Exit::Internal, action, error)
            .with_help("`--once` prints a table, and `--json` an object for each poll")
    };
    let ends = stop_flag()?;
    let polled = poll(client).map_err(|error| failed("cannot start a thread", &error))?;
    // It also restores the terminal in a panic.
    let mut terminal =
        ratatui::try_init().map_err(|error| failed("cannot use the terminal", &error))?;
    let shown = show(&mut terminal, Page::new(polls), &polled, &ends);
    // Of a terminal that is gone there is nothing to restore.
    let restored = ratatui::try_restore().or_else(|error| match ends.load(Ordering::Relaxed) {
        true => Ok(()),
        false => Err(error),
    });
    shown.and(restored).map_err(|error| failed("cannot use the terminal", &error))?;
    Ok(Exit::Ok)
}

/// Polls in a thread, which ends with the program or its receiver.
fn poll(client: VehicleClient) -> io::Result<Receiver<Result<VehicleStatus, String>>> {
    let (sender, polled) = sync_channel(1);
    let poll = move || {
        loop {
            thread::sleep(POLL_INTERVAL);
            let failure = |failure: Failure| {
                let cause = failure.causes.first().map(|it| format!(": {it}")).unwrap_or_default();
                failure.message + &cause
            };
            if sender.send(client.status().map_err(failure)).is_err() {
                return;
            }
        }
    };
    thread::Builder::new().name("polls".to_owned()).spawn(poll)?;
    Ok(polled)
}

fn show(
    terminal: &mut DefaultTerminal,
    mut page: Page,
    polled: &Receiver<Result<VehicleStatus, String>>,
    ends: &AtomicBool,
) -> io::Result<()> {
    let mut answered = Instant::now();
    while !ends.load(Ordering::Relaxed) {
        for polled in polled.try_iter() {
            if polled.is_ok() {
                answered = Instant::now();
            }
            page.add(polled);
        }
        terminal.draw(|frame| page.draw(frame, answered.elapsed()))?;
        if event::poll(TICK)?
            && let Event::Key(key) = event::read()?
            && ends_by(key, &mut page)
        {
            return Ok(());
        }
    }
    Ok(())
}

/// Handles a key; returns whether it ends the page.
fn ends_by(key: KeyEvent, page: &mut Page) -> bool {
    if key.kind == KeyEventKind::Release {
        return false;
    }
    match key.code {
        KeyCode::Char('c') => return key.modifiers.contains(KeyModifiers::CONTROL),
        KeyCode::Char('q') | KeyCode::Esc => return true,
        KeyCode::Down | KeyCode::Char('j') => page.select(1),
        KeyCode::Up | KeyCode::Char('k') => page.select(-1),
        KeyCode::Char('s') => page.sort(),
        _ => {}
    }
    false
}

//! Reproduces every decision of a journal, up to the first difference.
//!
//! Over a drive, the schedule decides on the wakes, as in the replay that wrote the journal: each
//! wake must be the next in the journal. Over a clip, which begins in the middle, the journal
//! decides: before each wake, as many samples of each input are delivered as it notes. Both compare
//! the inputs and the decision of each wake bit for bit.

mod clip;
mod drive;
mod lockstep;
mod reference;
mod triggers;

pub(super) use reference::ReferenceJournal;

use std::sync::Arc;
use std::time::Instant;

use gleaner_base::{Exit, Failure};
use gleaner_journal::{Difference, JournalEntry};
use gleaner_lambda::manifest::Manifest;
use gleaner_messages::transport::Transport;
use gleaner_protocol::Verified;

use self::reference::different;
use crate::api::Session;
use crate::api::data::{Topic, Wake};
use crate::invoker::Invoker;
use crate::journal::EntryBuilder;
use crate::replay::options::ReplayOptions;
use crate::session_setup::{Load, RunMode, SessionSetup, not_started};

pub(super) fn run(
    options: &ReplayOptions,
    manifest: &Manifest,
    reference: &mut ReferenceJournal,
    load: Load<'_>,
) -> Result<Verified, Failure> {
    let started = Instant::now();
    let outcome = match reference.clip.is_some() {
        true => clip::verify(options, manifest, reference, load),
        false => drive::verify(options, manifest, reference, load),
    };
    let (header, truncated) = (reference.header(), reference.reader().truncated());
    let noted = |what: &str, journal: &str, now: &str| {
        (journal != now).then(|| format!("{what}: {journal} in the journal, {now} now"))
    };
    let engine = reference.engine_now.as_ref();
    let notes = [
        engine.and_then(|engine| noted("runs on", &header.engine, engine)),
        noted("version of gleaner", &header.gleaner, env!("CARGO_PKG_VERSION")),
        noted("machine", &header.machine, std::env::consts::ARCH),
    ];
    let outcome = outcome.map_err(|mut failure| {
        // The likely reason of a difference comes before it.
        if failure.exit == Exit::Differs {
            failure.causes.splice(0..0, notes.iter().flatten().cloned());
        }
        failure
    })?;
    Ok(Verified {
        lambda: header.lambda.clone(),
        wakes: outcome.wakes,
        triggers: outcome.triggers,
        uncovered: outcome.uncovered,
        uncovered_triggers: outcome.uncovered_triggers,
        truncated,
        wall_s: started.elapsed().as_secs_f64(),
        notes: notes
            .into_iter()
            .flatten()
            .chain(reference.limits.iter().cloned())
            .chain(outcome.notes)
            .collect(),
    })
}

/// Counts of a comparison without a difference.
struct VerifyOutcome {
    wakes: u64,
    triggers: u64,
    uncovered: u64,
    uncovered_triggers: u64,
    notes: Vec<String>,
}

/// A lambda that runs again, for comparison.
struct Rerun {
    lambda: String,
    session: Session,
    entry_builder: EntryBuilder,
    invoker: Invoker,
}

impl Rerun {
    /// Starts the lambda and runs its `init`; also returns the drive that fills its inputs.
    fn start<T: Transport>(
        mut drive: T,
        options: &ReplayOptions,
        manifest: &Manifest,
        reference: &mut ReferenceJournal,
        load: Load<'_>,
    ) -> Result<(Self, T, Vec<Arc<Topic>>), Failure> {
        let SessionSetup { inputs, session, mut guest } =
            SessionSetup::load(&mut drive, &options.lambda, manifest, RunMode::Replay, load)?;
        let lambda = manifest.lambda.name.to_string();
        reference.engine_now = Some(guest.engine().to_string());
        let initialised = guest.init();
        // The log of `init` belongs to no wake.
        let (init_log, _) = session.take_log();
        initialised.map_err(|fault| not_started(&lambda, fault, &init_log))?;
        let invoker = Invoker::new(session.clone(), guest);
        Ok((
            Self { lambda, session, entry_builder: EntryBuilder::new(&inputs), invoker },
            drive,
            inputs,
        ))
    }

    fn wake(&mut self, wake: Wake) -> &JournalEntry {
        self.entry_builder.begin(&wake);
        let decision = self.invoker.invoke(wake);
        let (_, digest) = self.session.take_log();
        self.entry_builder.end(&decision, digest)
    }

    /// Passes over a wake that cannot be repeated: the lambda starts again, as it did then. Returns
    /// the entry with the inputs of now and the decision of the journal.
    fn skip(&mut self, wake: Wake, entry: &JournalEntry) -> JournalEntry {
        self.entry_builder.begin(&wake);
        let seen = self.entry_builder.seen().to_vec();
        self.invoker.discard();
        let mut now = JournalEntry { seen, ..entry.clone() };
        // How far it looked back, until its time was over, depends on the machine, too.
        for (now, journal) in now.seen.iter_mut().zip(&entry.seen) {
            now.reach = journal.reach;
        }
        now
    }
}

fn counts_differ(what: impl Into<String>, journal: u64, now: u64) -> Option<Difference> {
    (journal != now).then(|| Difference {
        what: what.into(),
        journal: journal.to_string(),
        now: now.to_string(),
    })
}

fn seconds(at_ns: i64, start_ns: i64) -> f64 {
    at_ns.saturating_sub(start_ns) as f64 / 1e9
}

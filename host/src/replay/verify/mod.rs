//! Makes every decision of a journal again and ends at the first that differs.
//!
//! From a drive, the schedule leads, as in the replay that wrote the journal: whatever wakes the
//! lambda must stand in the journal next. From a clip, which begins in the middle, the journal
//! leads: before a wake, as many samples of each input are delivered as it says. Both compare, bit
//! for bit, what the lambda was shown and what it decided.

mod claim;
mod clip;
mod drive;
mod paced;
mod triggers;

pub(super) use claim::Claim;

use std::sync::Arc;
use std::time::Instant;

use gleaner_base::Failure;
use gleaner_journal::{Difference, Entry};
use gleaner_lambda::manifest::Manifest;
use gleaner_protocol::Verified;
use gleaner_transport::Transport;

use self::claim::different;
use super::Options;
use crate::api::Session;
use crate::api::data::{Topic, Wake};
use crate::journal::Scribe;
use crate::judge::Judge;
use crate::stage::{Bounds, Load, Stage, not_started};

pub(super) fn run(
    options: &Options,
    manifest: &Manifest,
    claim: &mut Claim,
    load: Load<'_>,
) -> Result<Verified, Failure> {
    let started = Instant::now();
    let proved = match claim.clip.is_some() {
        true => clip::prove(options, manifest, claim, load)?,
        false => drive::prove(options, manifest, claim, load)?,
    };
    let (header, truncated) = (claim.header(), claim.reader().truncated());
    let noted = |what: &str, journal: &str, now: &str| {
        (journal != now).then(|| format!("{what}: {journal} in the journal, {now} now"))
    };
    let notes = [
        noted("runs on", &header.engine, &proved.engine),
        noted("version of gleaner", &header.gleaner, env!("CARGO_PKG_VERSION")),
        noted("machine", &header.machine, std::env::consts::ARCH),
    ];
    Ok(Verified {
        lambda: header.lambda.clone(),
        wakes: proved.wakes,
        triggers: proved.triggers,
        uncovered: proved.uncovered,
        uncovered_triggers: proved.uncovered_triggers,
        truncated,
        wall_s: started.elapsed().as_secs_f64(),
        notes: notes.into_iter().flatten().chain(claim.limits.iter().cloned()).collect(),
    })
}

/// How far a journal was proved.
struct Proved {
    engine: String,
    wakes: u64,
    triggers: u64,
    uncovered: u64,
    uncovered_triggers: u64,
}

/// A lambda that runs again.
struct Remake {
    lambda: String,
    session: Session,
    scribe: Scribe,
    judge: Judge,
    engine: String,
}

impl Remake {
    /// The lambda after its `init`, with the drive that fills its inputs.
    fn start<T: Transport>(
        mut drive: T,
        options: &Options,
        manifest: &Manifest,
        load: Load<'_>,
    ) -> Result<(Self, T, Vec<Arc<Topic>>), Failure> {
        let Stage { inputs, session, mut guest } =
            Stage::set(&mut drive, &options.asked, manifest, Bounds::Replay, None, load)?;
        let lambda = manifest.lambda.name.to_string();
        let engine = guest.engine();
        let initialised = guest.init();
        // What `init` says is no part of a wake.
        let (said, _) = session.take_log();
        initialised.map_err(|fault| not_started(&lambda, fault, &said))?;
        let judge = Judge::new(session.clone(), guest);
        Ok((Self { lambda, session, scribe: Scribe::new(&inputs), judge, engine }, drive, inputs))
    }

    /// Runs a wake.
    fn wake(&mut self, wake: Wake) -> &Entry {
        self.scribe.begin(&wake);
        let decision = self.judge.judge(wake);
        let (_, said) = self.session.take_log();
        self.scribe.end(&decision, said)
    }
}

/// A difference in numbers, where there is one.
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

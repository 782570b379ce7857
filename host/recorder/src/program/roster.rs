//! The lambdas: registers the announced ones, and takes the messages of all.

use std::collections::BTreeMap;

use gleaner_base::Failure;
use gleaner_lambda::manifest::{RecordSpec, Store};
use gleaner_messages::transport::Clock;
use gleaner_protocol::RecordingCounts;
use gleaner_protocol::process_stats::IntervalDurations;
use tracing::warn;

use super::commands::Commands;
use super::connections::Registration;
use super::lambdas::ConnectedLambda;
use super::topics::Topics;
use crate::{RecordError, Recorder};

/// Maximum number of lambdas at a time. Each has a thread.
const LAMBDAS: usize = 256;

/// The lambdas that are connected, or will be.
pub struct Roster {
    lambdas: Vec<ConnectedLambda>,
    /// For each lambda that ever came: the requested store and bytes of the preroll.
    shares: BTreeMap<String, (Store, u64)>,
    preroll_bytes: Option<u64>,
    /// Times from decisions to open windows.
    spreads: IntervalDurations,
    /// Lambdas and wakes that were refused.
    counted: RecordingCounts,
}

impl Roster {
    pub fn new(preroll_bytes: Option<u64>) -> Roster {
        Roster {
            lambdas: Vec::new(),
            shares: BTreeMap::new(),
            preroll_bytes,
            spreads: IntervalDurations::new(),
            counted: RecordingCounts::default(),
        }
    }

    /// Number of lambdas that are connected, or will be.
    pub fn len(&self) -> usize {
        self.lambdas.len()
    }

    /// Accepts no further messages of lambdas than those that were sent.
    pub fn accept_no_more(&self) {
        self.lambdas.iter().for_each(ConnectedLambda::accept_no_more);
    }

    pub fn counted(&self) -> &RecordingCounts {
        &self.counted
    }

    pub fn spreads(&mut self) -> &mut IntervalDurations {
        &mut self.spreads
    }

    pub fn count_refused(&mut self) {
        self.counted.lambdas_refused += 1;
    }

    /// Registers a lambda before it connects, so that there is a preroll when it does.
    pub fn register(
        &mut self,
        registration: Registration,
        now_ns: i64,
        topics: &mut Topics,
        recorder: &mut Recorder,
    ) -> Result<(), Failure> {
        let Registration { manifest, remaps, grants, inbox, mut replies } = registration;
        let Some(rules) = manifest.record.clone() else { return Ok(()) };
        let name = manifest.lambda.name.to_string();
        let mut recorded = Vec::new();
        let refused = match self.lambdas.len() == LAMBDAS {
            true => Some(format!("it records for at most {LAMBDAS} lambdas at a time")),
            false => None,
        };
        let refused = refused.or_else(|| {
            for wanted in &rules.topics {
                let remapped = remaps.iter().find(|(from, _)| from == wanted.as_str());
                let topic = remapped.map_or(wanted.as_str(), |(_, to)| to.as_str());
                let Some((_, grant)) = grants.iter().find(|(granted, _)| granted == topic) else {
                    return Some(format!("the parent process did not grant topic `{topic}`"));
                };
                match recorder.add_missing_topic(topic) {
                    Ok(id) => {
                        topics.add(*grant, topic, id, now_ns);
                        if !recorded.contains(&id) {
                            recorded.push(id);
                        }
                    }
                    Err(error) => return Some(error.to_string()),
                }
            }
            let grown = self.grow_preroll(&name, &rules, recorder);
            grown.err().map(|error| Failure::from(error).to_string())
        });
        if let Some(why) = refused {
            warn!(lambda = %name, %why, "cannot record for a lambda");
            replies.refused(&why);
            self.count_refused();
            return Ok(());
        }
        recorder.grow_length(rules.max_length);
        self.lambdas.push(ConnectedLambda::new(name, rules, recorded, inbox, replies));
        Ok(())
    }

    /// Grows the preroll to the sum of all requests.
    fn grow_preroll(
        &mut self,
        name: &str,
        rules: &RecordSpec,
        recorder: &mut Recorder,
    ) -> Result<(), RecordError> {
        let share = (rules.store, rules.preroll_size.bytes());
        let before = self.shares.insert(name.to_owned(), share);
        let store = if self.shares.values().any(|(store, _)| *store == Store::Disk) {
            Store::Disk
        } else {
            Store::Ram
        };
        let bytes = self.shares.values().map(|(_, bytes)| *bytes).fold(0, u64::saturating_add);
        let grown = match self.preroll_bytes {
            // The given size is memory.
            Some(given) if store == Store::Ram => {
                if given < bytes {
                    warn!(
                        requested = bytes,
                        given, "lambdas request more preroll than --preroll-memory allows"
                    );
                }
                Ok(())
            }
            _ => recorder.grow_preroll(store, bytes),
        };
        if grown.is_err() {
            // The other lambdas keep what they have.
            match before {
                Some(before) => self.shares.insert(name.to_owned(), before),
                None => self.shares.remove(name),
            };
        }
        grown
    }

    /// Handles messages of lambdas; returns whether there were any.
    pub fn poll(
        &mut self,
        clock: Clock,
        recorder: &mut Recorder,
        mut commands: Option<&mut Commands>,
    ) -> Result<bool, Failure> {
        let mut is_busy = false;
        let mut index = 0;
        while index < self.lambdas.len() {
            let monotonic = || clock.monotonic(clock.now());
            let lambda = &mut self.lambdas[index];
            let polled = lambda.poll(recorder, clock.now(), monotonic, &mut self.spreads)?;
            is_busy |= polled.is_busy;
            self.counted.lambdas_refused += u64::from(polled.is_refused);
            self.counted.add(&polled.counted);
            if let (Some(commands), Some(id)) = (&mut commands, polled.is_new) {
                commands.add(lambda.name(), id);
            }
            if polled.is_gone {
                self.lambdas.swap_remove(index);
            } else {
                index += 1;
            }
        }
        Ok(is_busy)
    }
}

//! A lambda is announced: its topics are wanted from then on, and it has its share of the preroll.

use std::sync::Arc;

use gleaner_base::Failure;
use gleaner_lambda::manifest::Store;
use tracing::warn;

use super::course::{Course, Recorded, STAGING};
use super::hear::Announced;
use super::lambdas::Lambda;
use super::staging::Lane;
use super::watch::{Largest, Want, Wanted};
use crate::{RecordError, TopicId};

/// Lambdas that are heard at a time. Each has a thread.
const LAMBDAS: usize = 256;
/// Bytes of the largest sample of a topic of which no manifest says more, as far as room for it
/// goes.
const USUAL_BYTES: usize = 8 << 20;

impl Course {
    /// A lambda will come: its topics are wanted from now on, so that there is a preroll when it
    /// does.
    pub(super) fn announce(&mut self, announced: Announced) -> Result<(), Failure> {
        let Announced { manifest, remaps, spoken, mut answers } = announced;
        let Some(rules) = manifest.record.clone() else { return Ok(()) };
        let name = manifest.lambda.name.to_string();
        if self.lambdas.len() == LAMBDAS {
            warn!(lambda = %name, most = LAMBDAS, "too many lambdas at a time: not recorded for");
            answers.refused(&format!("it hears at most {LAMBDAS} lambdas at a time"));
            self.counted.lambdas_refused += 1;
            return Ok(());
        }
        let mut topics = Vec::new();
        let mut largest = 0;
        for wanted in &rules.topics {
            let remapped =
                remaps.iter().find(|(from, _)| from == wanted.as_str()).map(|(_, to)| to.as_str());
            let input = manifest.inputs.iter().find(|input| input.topic == *wanted);
            let max_bytes = input.map(|input| input.max_size.as_usize());
            largest = largest.max(max_bytes.unwrap_or(USUAL_BYTES));
            let type_name = input.map(|input| input.type_name.to_string());
            match self.want(remapped.unwrap_or(wanted.as_str()), type_name, Largest::of(max_bytes))
            {
                Ok(topic) if !topics.contains(&topic) => topics.push(topic),
                Ok(_) => {}
                Err(error) => {
                    let why = error.to_string();
                    warn!(lambda = %name, topic = %wanted, %why, "a lambda cannot be recorded for");
                    answers.refused(&why);
                    self.counted.lambdas_refused += 1;
                    return Ok(());
                }
            }
        }
        let seconds = rules.preroll.as_secs_f64().max(1.0);
        let per_s = (rules.preroll_size.bytes() as f64 / seconds) as usize;
        self.asked.insert(name.clone(), (rules.store, rules.preroll_size.bytes(), per_s));
        let per_s: usize =
            self.asked.values().map(|(_, _, per_s)| *per_s).fold(0, usize::saturating_add);
        let wanted = largest.saturating_add(per_s).clamp(*STAGING.start(), *STAGING.end());
        self.room = self.room.max(wanted);
        if let Err(error) = self.grow_preroll() {
            // The others go on with what they have.
            self.asked.remove(&name);
            let why = Failure::from(error).to_string();
            warn!(lambda = %name, %why, "a lambda cannot be recorded for");
            answers.refused(&why);
            self.counted.lambdas_refused += 1;
            return Ok(());
        }
        self.recorder.grow_length(rules.max_length);
        self.lambdas.push(Lambda::new(name, rules, topics, spoken, answers));
        Ok(())
    }

    /// As much preroll as all lambdas ask for.
    fn grow_preroll(&mut self) -> Result<(), RecordError> {
        let store = if self.asked.values().any(|asked| asked.0 == Store::Disk) {
            Store::Disk
        } else {
            Store::Ram
        };
        let bytes = self.asked.values().map(|asked| asked.1).fold(0, u64::saturating_add);
        match self.options.preroll_bytes {
            // What is given is memory.
            Some(given) if store == Store::Ram => {
                if given < bytes {
                    warn!(
                        asked = bytes,
                        given, "lambdas ask for more preroll than the recorder was given"
                    );
                }
                Ok(())
            }
            _ => self.recorder.grow_preroll(store, bytes),
        }
    }

    fn want(
        &mut self,
        name: &str,
        type_name: Option<String>,
        largest: Largest,
    ) -> Result<TopicId, RecordError> {
        let topic = self.recorder.add_missing_topic(name)?;
        let recorded = self.topics.entry(topic).or_insert_with(|| {
            let lane = Lane { topic, staging: Arc::clone(&self.staging), arrivals: Arc::default() };
            Recorded { name: name.to_owned(), type_name: None, lane: Arc::new(lane) }
        });
        // The watch takes them as they come.
        let what = Wanted::Recorded { topic, largest };
        let _ = self.wants.send(Want {
            what,
            name: name.to_owned(),
            type_name,
            sink: recorded.lane.clone(),
        });
        Ok(topic)
    }
}

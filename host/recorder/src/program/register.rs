//! Registers a lambda: requests its topics, and sizes the preroll and staging for it.

use std::sync::Arc;

use gleaner_base::Failure;
use gleaner_lambda::manifest::Store;
use tracing::warn;

use super::connections::Registration;
use super::event_loop::{RecorderLoop, STAGING, TopicEntry};
use super::lambdas::ConnectedLambda;
use super::staging::TopicSink;
use super::topic_watch::{LargestSample, RequestKind, TopicRequest};
use crate::{RecordError, TopicId};

/// Maximum number of lambdas at a time. Each has a thread.
const LAMBDAS: usize = 256;
/// Bytes of the largest sample of a topic whose size no manifest states, for the size of the
/// staging area.
const USUAL_BYTES: usize = 8 << 20;

impl RecorderLoop {
    /// Registers a lambda before it connects, so that there is a preroll when it does.
    pub(super) fn register(&mut self, registration: Registration) -> Result<(), Failure> {
        let Registration { manifest, remaps, inbox, mut replies } = registration;
        let Some(rules) = manifest.record.clone() else { return Ok(()) };
        let name = manifest.lambda.name.to_string();
        if self.lambdas.len() == LAMBDAS {
            warn!(lambda = %name, most = LAMBDAS, "too many lambdas: one is not recorded for");
            replies.refused(&format!("it records for at most {LAMBDAS} lambdas at a time"));
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
            match self.request_topic(
                remapped.unwrap_or(wanted.as_str()),
                type_name,
                LargestSample::of(max_bytes),
            ) {
                Ok(topic) if !topics.contains(&topic) => topics.push(topic),
                Ok(_) => {}
                Err(error) => {
                    let why = error.to_string();
                    warn!(lambda = %name, topic = %wanted, %why, "cannot record for a lambda");
                    replies.refused(&why);
                    self.counted.lambdas_refused += 1;
                    return Ok(());
                }
            }
        }
        let seconds = rules.preroll.as_secs_f64().max(1.0);
        let per_s = (rules.preroll_size.bytes() as f64 / seconds) as usize;
        self.shares.insert(name.clone(), (rules.store, rules.preroll_size.bytes(), per_s));
        let per_s: usize =
            self.shares.values().map(|(_, _, per_s)| *per_s).fold(0, usize::saturating_add);
        let wanted = largest.saturating_add(per_s).clamp(*STAGING.start(), *STAGING.end());
        self.room = self.room.max(wanted);
        if let Err(error) = self.grow_preroll() {
            // The other lambdas keep what they have.
            self.shares.remove(&name);
            let why = Failure::from(error).to_string();
            warn!(lambda = %name, %why, "cannot record for a lambda");
            replies.refused(&why);
            self.counted.lambdas_refused += 1;
            return Ok(());
        }
        self.recorder.grow_length(rules.max_length);
        self.lambdas.push(ConnectedLambda::new(name, rules, topics, inbox, replies));
        Ok(())
    }

    /// Grows the preroll to the sum of all requests.
    fn grow_preroll(&mut self) -> Result<(), RecordError> {
        let store = if self.shares.values().any(|shares| shares.0 == Store::Disk) {
            Store::Disk
        } else {
            Store::Ram
        };
        let bytes = self.shares.values().map(|shares| shares.1).fold(0, u64::saturating_add);
        match self.options.preroll_bytes {
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
            _ => self.recorder.grow_preroll(store, bytes),
        }
    }

    fn request_topic(
        &mut self,
        name: &str,
        type_name: Option<String>,
        largest: LargestSample,
    ) -> Result<TopicId, RecordError> {
        let topic = self.recorder.add_missing_topic(name)?;
        let recorded = self.topics.entry(topic).or_insert_with(|| {
            let sink =
                TopicSink { topic, staging: Arc::clone(&self.staging), arrivals: Arc::default() };
            TopicEntry { name: name.to_owned(), type_name: None, sink: Arc::new(sink) }
        });
        // The watch thread takes requests as they come.
        let what = RequestKind::Recorded { topic, largest };
        let _ = self.requests.send(TopicRequest {
            what,
            name: name.to_owned(),
            type_name,
            sink: recorded.sink.clone(),
        });
        Ok(topic)
    }
}

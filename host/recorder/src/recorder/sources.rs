//! The topics and lambdas of a recorder.

use std::sync::Arc;

use gleaner_journal::{Encoder, JournalEntry, JournalHeader};
use gleaner_lambda::ClipLambda;
use gleaner_lambda::manifest::RecordSpec;
use gleaner_messages::transport::{LatchRule, latched_depth};

use super::settings::TopicId;
use crate::file::TopicSchema;
use crate::thumbnail::is_image;
use crate::window::Group;
use crate::{LAMBDAS_MAX, RecordError};

/// Most topics of one recorder. A vehicle has some hundreds. For each, the stamps of some thousand
/// lost samples are kept: 100 KiB.
pub const TOPICS_MAX: usize = 1024;

/// Most bytes of the names of all topics of one recorder, and of their types: they are in a line of
/// the list of clips, up to seven times and with six bytes for one, and a line has at most 16 MiB.
const NAMES_MAX: usize = 256 << 10;

#[derive(Clone, Debug)]
pub struct LambdaSpec {
    /// Its description, the header of its journal.
    pub header: JournalHeader,
    /// Its `[record]`.
    pub rules: RecordSpec,
    /// SHA-256 over the digests of its files, in hexadecimal digits.
    pub digest: String,
    /// The topics of its clips, in the order of `[record]`.
    pub topics: Vec<TopicId>,
}

#[derive(Debug)]
struct SourceTopic {
    schema: Arc<TopicSchema>,
    is_missing: bool,
    /// The time when it was found, if later than requested.
    found_at: Option<i64>,
    has_samples: bool,
    /// The depth of its writers, if it is latched.
    latched: Option<usize>,
    lambdas: Vec<usize>,
}

fn latched(schema: &TopicSchema) -> Option<usize> {
    schema.offered_qos.as_deref().and_then(latched_depth)
}

/// One lambda, without its windows.
struct SourceLambda {
    /// Clips share it.
    header: Arc<JournalHeader>,
    /// As in [`LambdaSpec`].
    digest: String,
    topics: Vec<usize>,
    encoder: Encoder,
    wakes: u64,
}

pub struct RecordedSources {
    pub clock: String,
    /// True if its samples have writers.
    is_live: bool,
    topics: Vec<SourceTopic>,
    lambdas: Vec<SourceLambda>,
    /// Sentences about all clips.
    pub notes: Vec<String>,
}

impl RecordedSources {
    pub fn new(clock: String, is_live: bool) -> RecordedSources {
        let (topics, lambdas, notes) = (Vec::new(), Vec::new(), Vec::new());
        RecordedSources { clock, is_live, topics, lambdas, notes }
    }

    /// Adds a topic; an existing one of the same name is unchanged. Returns its number.
    pub fn add_topic(
        &mut self,
        schema: TopicSchema,
        is_missing: bool,
    ) -> Result<usize, RecordError> {
        if let Some(found) = self.topics.iter().position(|topic| topic.schema.name == schema.name) {
            return Ok(found);
        }
        if self.topics.len() == TOPICS_MAX {
            return Err(RecordError::TooManyTopics { most: TOPICS_MAX });
        }
        schema.check()?;
        let names = |schema: &TopicSchema| schema.name.len() + schema.type_name.len();
        let known: usize = self.topics.iter().map(|topic| names(&topic.schema)).sum();
        if known + names(&schema) > NAMES_MAX {
            return Err(RecordError::LongNames { most: NAMES_MAX });
        }
        let latched = latched(&schema);
        let (schema, lambdas) = (Arc::new(schema), Vec::new());
        self.topics.push(SourceTopic {
            schema,
            is_missing,
            found_at: None,
            has_samples: false,
            latched,
            lambdas,
        });
        Ok(self.topics.len() - 1)
    }

    /// Adds the description of a topic that was missing until `since_ns`.
    pub fn found_topic(
        &mut self,
        topic: usize,
        schema: TopicSchema,
        since_ns: i64,
    ) -> Result<(), RecordError> {
        schema.check()?;
        let topic = &mut self.topics[topic];
        if topic.is_missing {
            // Messages and windows use the name with which it was requested.
            topic.schema = Arc::new(TopicSchema { name: topic.schema.name.clone(), ..schema });
            topic.latched = latched(&topic.schema);
            (topic.is_missing, topic.found_at) = (false, Some(since_ns));
        }
        Ok(())
    }

    pub fn add_lambda(&mut self, lambda: usize, spec: LambdaSpec) {
        let LambdaSpec { header, digest, topics, .. } = spec;
        let topics: Vec<usize> = topics.iter().map(|topic| topic.0).collect();
        for topic in &topics {
            let lambdas = &mut self.topics[*topic].lambdas;
            if !lambdas.contains(&lambda) {
                lambdas.push(lambda);
            }
        }
        let encoder = Encoder::new(header.inputs.len());
        let header = Arc::new(header);
        self.lambdas.push(SourceLambda { header, digest, topics, encoder, wakes: 0 });
    }

    pub fn check_room(&self) -> Result<(), RecordError> {
        match self.lambdas.len() < LAMBDAS_MAX {
            true => Ok(()),
            false => Err(RecordError::TooManyLambdas { most: LAMBDAS_MAX }),
        }
    }

    /// Encodes a wake without reference to another one.
    pub fn encode(&mut self, lambda: usize, entry: &JournalEntry, out: &mut Vec<u8>) {
        let encoder = &mut self.lambdas[lambda].encoder;
        out.clear();
        encoder.reset();
        encoder.encode(entry, out);
    }

    /// Counts wakes of a lambda; returns the number of the first.
    pub fn count_wakes(&mut self, lambda: usize, count: u64) -> u64 {
        let wakes = &mut self.lambdas[lambda].wakes;
        let first = *wakes;
        *wakes += count;
        first
    }

    pub fn is_missing(&self, topic: usize) -> bool {
        self.topics[topic].is_missing
    }

    pub fn found_at(&self, topic: usize) -> Option<i64> {
        self.topics[topic].found_at
    }

    pub fn saw(&mut self, topic: usize) {
        self.topics[topic].has_samples = true;
    }

    pub fn has_seen(&self, topic: usize) -> bool {
        self.topics[topic].has_samples
    }

    /// Returns how many samples of a latched topic stay valid; `None` for other topics.
    pub fn latch_rule(&self, topic: usize) -> Option<LatchRule> {
        self.topics[topic].latched.map(|depth| self.is_live.then_some(depth))
    }

    pub fn schema(&self, topic: usize) -> &Arc<TopicSchema> {
        &self.topics[topic].schema
    }

    pub fn first_with_images(&self, topics: Vec<usize>) -> Option<usize> {
        let has_images = |topic: &usize| {
            let topic = &self.topics[*topic];
            !topic.is_missing && is_image(&topic.schema.type_name)
        };
        topics.into_iter().find(has_images)
    }

    pub fn header(&self, lambda: usize) -> &Arc<JournalHeader> {
        &self.lambdas[lambda].header
    }

    pub fn set_engine(&mut self, lambda: usize, engine: String) {
        Arc::make_mut(&mut self.lambdas[lambda].header).engine = engine;
    }

    pub fn name(&self, lambda: usize) -> &str {
        &self.lambdas[lambda].header.lambda
    }

    pub fn topics(&self, lambda: usize) -> &[usize] {
        &self.lambdas[lambda].topics
    }

    /// Returns whether a window of a lambda that records this topic contains `at`.
    pub fn covers(&self, group: &Group, topic: usize, at: i64) -> bool {
        self.topics[topic].lambdas.iter().any(|lambda| group.covers(*lambda, at))
    }

    /// The topics of the lambdas of a clip, each once, in their order.
    pub fn topics_of(&self, group: &Group) -> Vec<usize> {
        let mut topics = Vec::new();
        for topic in group.lambdas.iter().flat_map(|lambda| &self.lambdas[*lambda].topics) {
            if !topics.contains(topic) {
                topics.push(*topic);
            }
        }
        topics
    }

    pub fn lambdas_of(&self, group: &Group) -> Vec<ClipLambda> {
        let lambda = |lambda: &usize| {
            let SourceLambda { header, digest, .. } = &self.lambdas[*lambda];
            ClipLambda {
                name: header.lambda.clone(),
                version: header.version.clone(),
                kind: header.kind,
                digest: digest.clone(),
                windows: group.windows(*lambda),
            }
        };
        group.lambdas.iter().map(lambda).collect()
    }
}

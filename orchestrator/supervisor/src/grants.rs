//! Topics that the processes of a run may read and publish.

use std::collections::HashSet;

use gleaner_lambda::Manifest;
use gleaner_protocol::ingress::{
    AddReader, COMMANDS_ID, PublishGrant, Qos, TopicGrant, commands_grant, recorded_grant,
};

use crate::spec::LambdaSpec;
use crate::spec::RunSpec;

/// Largest of the sizes that the ingress expects of topics for which none is stated.
const USUAL_BYTES: u64 = 32 << 20;

/// Returns the lambda's process as a reader: it reads its inputs. `number` differs from that of its
/// earlier processes, of which the ingress may still know the last.
pub(crate) fn lambda(
    lambda: &LambdaSpec,
    spec: &RunSpec,
    is_recorded: bool,
    number: u32,
) -> AddReader {
    let event = lambda.manifest.event_input().map(|input| &input.name);
    let inputs = lambda.manifest.inputs.iter().zip(0..);
    let topics = inputs.map(|(input, index)| {
        let topic = lambda.on_network(input.topic.as_str());
        TopicGrant::for_input(index, input, &topic, event == Some(&input.name), is_recorded)
    });
    AddReader {
        name: format!("{} {number}", lambda.name()),
        topics: topics.collect(),
        publishes: PublishGrant::of_lambda(spec.rtt.as_deref(), spec.decisions.as_deref()),
    }
}

/// Returns the name of the recorder among the readers of the ingress, after this number of earlier
/// recorders: the ingress may still know the last one.
pub(crate) fn recorder_name(start: u32) -> String {
    if start == 0 { "recorder".to_owned() } else { format!("recorder {start}") }
}

/// Returns the recorder as a reader: it reads commands, and later what lambdas record.
pub(crate) fn recorder(spec: &RunSpec, start: u32) -> AddReader {
    AddReader {
        name: recorder_name(start),
        topics: spec.commands.iter().map(|topic| commands_grant(topic)).collect(),
        publishes: Vec::new(),
    }
}

/// Returns the reader as it joins an ingress that was started again, in a run with a recorder or
/// without one.
pub(crate) fn again(reader: AddReader, is_recorded: bool) -> AddReader {
    let topics = reader.topics.into_iter().map(|topic| topic.again(is_recorded)).collect();
    AddReader { topics, ..reader }
}

/// The recorded topics of all lambdas of a run, each once.
pub(crate) struct RecordedTopics {
    /// Topics that lambdas request with different QoS: each QoS has stamps of its own.
    pub(crate) mixed: Vec<String>,
    grants: Vec<TopicGrant>,
    /// Ids of the topics that were granted to the recorder.
    granted: HashSet<u32>,
    /// True if the recorder reads the samples that the ingress still has, too.
    is_again: bool,
}

impl RecordedTopics {
    /// Returns the topics of these lambdas. `is_again` is true for a recorder that follows another:
    /// it also reads the samples that the ingress still has.
    pub(crate) fn of<'a>(lambdas: impl Iterator<Item = &'a LambdaSpec>, is_again: bool) -> Self {
        let mut topics: Vec<RecordedSamples> = Vec::new();
        for samples in lambdas.flat_map(recorded) {
            match topics.iter_mut().find(|known| known.topic == samples.topic) {
                Some(known) => known.add(samples),
                None => topics.push(samples),
            }
        }
        let mixed = topics.iter().filter(|samples| samples.is_mixed);
        let mixed = mixed.map(|samples| samples.topic.clone()).collect();
        let grants = topics.into_iter().zip(COMMANDS_ID + 1..);
        let grants = grants.map(|(samples, id)| samples.grant(id));
        Self { mixed, grants: grants.collect(), granted: HashSet::new(), is_again }
    }

    /// Adds the topics of a lambda that came later.
    ///
    /// # Errors
    ///
    /// A topic whose samples are larger than granted: the recorder must be started again.
    pub(crate) fn add(&mut self, lambda: &LambdaSpec) -> Result<(), String> {
        for samples in recorded(lambda) {
            let known = self.grants.iter().find(|grant| grant.topic == samples.topic);
            let Some(known) = known else {
                let id = COMMANDS_ID + 1 + u32::try_from(self.grants.len()).unwrap_or(u32::MAX);
                self.grants.push(samples.grant(id));
                continue;
            };
            let granted = known.max_bytes.unwrap_or(USUAL_BYTES);
            if samples.max_bytes().unwrap_or(USUAL_BYTES) > granted {
                return Err(samples.topic);
            }
        }
        Ok(())
    }

    pub(crate) fn ids(&self, lambda: &LambdaSpec) -> Vec<(String, u32)> {
        let grants = self.grants_of(lambda);
        grants.into_iter().map(|grant| (grant.topic.clone(), grant.id)).collect()
    }

    /// Returns the grants of a lambda's recorded topics that the recorder does not have yet.
    pub(crate) fn take_new(&mut self, lambda: &LambdaSpec) -> Vec<TopicGrant> {
        let grants: Vec<TopicGrant> = self.grants_of(lambda).into_iter().cloned().collect();
        let grants = grants.into_iter().filter(|grant| self.granted.insert(grant.id));
        grants.map(|grant| if self.is_again { grant.again(true) } else { grant }).collect()
    }

    /// Returns the grants of a lambda's recorded topics that the recorder attaches again after a
    /// restart of the ingress, as far as `again` has none of them yet, and adds these to it.
    pub(crate) fn take_again(
        &self,
        lambda: &LambdaSpec,
        again: &mut HashSet<u32>,
    ) -> Vec<TopicGrant> {
        let grants = self.grants_of(lambda).into_iter();
        let has = |grant: &&TopicGrant| self.granted.contains(&grant.id);
        let grants = grants.filter(has).filter(|grant| again.insert(grant.id));
        grants.cloned().map(|grant| grant.again(true)).collect()
    }

    fn grants_of(&self, lambda: &LambdaSpec) -> Vec<&TopicGrant> {
        let of_lambda: Vec<String> = recorded(lambda).map(|samples| samples.topic).collect();
        self.grants.iter().filter(|grant| of_lambda.contains(&grant.topic)).collect()
    }
}

/// The samples of a recorded topic, as far as manifests state it.
struct RecordedSamples {
    topic: String,
    /// The type that the first manifest states.
    type_name: Option<String>,
    /// The QoS of the first input.
    qos: Option<Qos>,
    /// True if a further input has another QoS.
    is_mixed: bool,
    /// The largest size that a manifest states, in bytes.
    largest: u64,
    /// True if a manifest states no size.
    is_usual: bool,
}

impl RecordedSamples {
    fn add(&mut self, other: RecordedSamples) {
        self.type_name = self.type_name.take().or(other.type_name);
        self.is_mixed |= self.qos.zip(other.qos).is_some_and(|(one, other)| one != other);
        self.qos = self.qos.or(other.qos);
        self.largest = self.largest.max(other.largest);
        self.is_usual |= other.is_usual;
    }

    fn grant(self, id: u32) -> TopicGrant {
        let (max_bytes, qos) = (self.max_bytes(), self.qos.unwrap_or(Qos::Auto));
        recorded_grant(id, &self.topic, self.type_name, max_bytes, qos)
    }

    /// Returns the size to request; `None` for the usual size of the type.
    fn max_bytes(&self) -> Option<u64> {
        (!self.is_usual || self.largest > USUAL_BYTES).then_some(self.largest)
    }
}

/// Returns the recorded topics of a lambda, by their names on the network.
fn recorded(lambda: &LambdaSpec) -> impl Iterator<Item = RecordedSamples> {
    let Manifest { inputs, record, .. } = &lambda.manifest;
    record.iter().flat_map(|record| &record.topics).map(move |topic| {
        let input = inputs.iter().find(|input| input.topic == *topic);
        let topic = lambda.on_network(topic.as_str());
        RecordedSamples {
            topic: topic.clone(),
            type_name: input.map(|input| input.type_name.to_string()),
            qos: input.map(|input| TopicGrant::for_input(0, input, &topic, false, false).qos),
            is_mixed: false,
            largest: input.map_or(0, |input| input.max_size.bytes()),
            is_usual: input.is_none(),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::spec::tests::recording;

    #[test]
    fn a_topic_that_two_lambdas_record_is_granted_once_for_the_larger_samples() {
        let lambdas = [
            recording("a", Some(("/imu", "64 KiB")), &["/imu", "/gps"]),
            recording("b", Some(("/imu", "1 MiB")), &["/gps", "/imu"]),
            recording("c", None, &["/odom"]),
        ];
        let mut topics = RecordedTopics::of(lambdas.iter(), false);
        let ids = [("/imu".to_owned(), 1), ("/gps".to_owned(), 2)];
        assert_eq!(topics.ids(&lambdas[0]), ids);
        assert_eq!(topics.ids(&lambdas[1]), ids);
        let granted = |grants: Vec<TopicGrant>| {
            grants.into_iter().map(|grant| (grant.topic, grant.max_bytes)).collect::<Vec<_>>()
        };
        assert_eq!(
            granted(topics.take_new(&lambdas[1])),
            [("/imu".to_owned(), Some(1 << 20)), ("/gps".to_owned(), None)]
        );
        assert_eq!(granted(topics.take_new(&lambdas[0])), []);
        assert_eq!(granted(topics.take_new(&lambdas[2])), [("/odom".to_owned(), None)]);
    }

    #[test]
    fn one_manifest_without_a_size_makes_the_usual_size_count() {
        let lambdas = [
            recording("a", Some(("/image", "1 MiB")), &["/image"]),
            recording("b", None, &["/image"]),
            recording("c", Some(("/large", "64 MiB")), &["/large"]),
            recording("d", None, &["/large"]),
        ];
        let topics = RecordedTopics::of(lambdas.iter(), false);
        let sizes: Vec<_> = topics.grants.iter().map(|grant| grant.max_bytes).collect();
        assert_eq!(sizes, [None, Some(64 << 20)]);
    }
}

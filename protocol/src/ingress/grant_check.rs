//! Checks the bounds of grants. The ingress reserves memory by these numbers.

use std::collections::HashSet;
use std::ops::RangeInclusive;

use gleaner_base::visible;

use super::{AddReader, AddTopics, PUBLISH_MAX, PinGrant, PublishGrant, Qos, TopicGrant};
use crate::link::GrantError;

/// Largest number of topics that a message grants.
const TOPICS_MAX: usize = 1024;
/// Longest name of a reader, a topic or a type, in bytes. DDS has 255 at most, a drive may have
/// more.
const NAME_MAX: usize = 1024;
/// Samples that a subscription or a publisher may queue: the longest history of a manifest.
const QUEUE: RangeInclusive<u64> = 1..=65_536;
/// Bytes of all messages that a publisher keeps.
const PUBLISHED_BYTES: RangeInclusive<u64> = 1..=64 << 20;
/// Samples that a reader can find: twice the longest history of a manifest.
const DEPTH: RangeInclusive<u64> = 1..=131_072;
/// Bytes of the largest sample.
const MAX_BYTES: RangeInclusive<u64> = 1..=1 << 30;
/// Windows that a reader may hold of a topic.
const WINDOWS: RangeInclusive<u64> = 0..=16;
/// Single samples that a reader may hold of a topic: the longest `hold` of a manifest, and some.
const SINGLES: RangeInclusive<u64> = 0..=2048;

impl AddReader {
    /// Checks all values.
    ///
    /// # Errors
    ///
    /// [`GrantError`] names the first field that is out of bounds.
    pub fn check(&self) -> Result<(), GrantError> {
        let fields = GrantFields { what: format!("reader `{}`", shown(&self.name)) };
        fields.name("name", &self.name)?;
        fields.number("publishes", self.publishes.len() as u64, 0..=TOPICS_MAX as u64)?;
        self.publishes.iter().try_for_each(PublishGrant::check)?;
        check_topics(&fields, &self.topics)
    }
}

impl AddTopics {
    /// Checks all values.
    ///
    /// # Errors
    ///
    /// Those of [`AddReader::check`].
    pub fn check(&self) -> Result<(), GrantError> {
        let fields = GrantFields { what: format!("topics to reader `{}`", shown(&self.reader)) };
        fields.name("reader", &self.reader)?;
        check_topics(&fields, &self.topics)
    }
}

fn check_topics(fields: &GrantFields, topics: &[TopicGrant]) -> Result<(), GrantError> {
    fields.number("topics", topics.len() as u64, 0..=TOPICS_MAX as u64)?;
    let mut ids = HashSet::new();
    if let Some(again) = topics.iter().find(|grant| !ids.insert(grant.id)) {
        return Err(fields.error("topics", format!("has id {} twice", again.id)));
    }
    topics.iter().try_for_each(TopicGrant::check)
}

impl PublishGrant {
    /// Checks all values.
    ///
    /// # Errors
    ///
    /// Those of [`AddReader::check`].
    pub fn check(&self) -> Result<(), GrantError> {
        let fields = GrantFields { what: format!("topic `{}`", shown(&self.topic)) };
        fields.name("topic", &self.topic)?;
        fields.name("type_name", &self.type_name)?;
        fields.number("depth", self.depth as u64, QUEUE)?;
        fields.number("max_bytes", self.max_bytes as u64, 1..=PUBLISH_MAX as u64)?;
        let all = self.depth as u64 * self.max_bytes as u64;
        fields.number("depth * max_bytes", all, PUBLISHED_BYTES)
    }
}

impl TopicGrant {
    /// Checks all values.
    ///
    /// # Errors
    ///
    /// Those of [`AddReader::check`].
    pub fn check(&self) -> Result<(), GrantError> {
        let fields = GrantFields { what: format!("topic `{}`", shown(&self.topic)) };
        fields.name("topic", &self.topic)?;
        if let Some(type_name) = &self.type_name {
            fields.name("type_name", type_name)?;
        }
        if let Qos::Fixed { depth, .. } = self.qos {
            fields.number("qos.depth", depth as u64, QUEUE)?;
        }
        fields.number("queue", self.queue as u64, QUEUE)?;
        if let Some(max_bytes) = self.max_bytes {
            fields.number("max_bytes", max_bytes, MAX_BYTES)?;
        }
        fields.number("depth", self.depth.into(), DEPTH)?;
        let PinGrant { windows, window, singles } = self.holds;
        fields.number("holds.windows", windows.into(), WINDOWS)?;
        fields.number("holds.singles", singles.into(), SINGLES)?;
        let smallest = u64::from(windows > 0);
        fields.number("holds.window", window.into(), smallest..=u64::from(u16::MAX))?;
        if windows == 0 && singles == 0 {
            return Err(fields.error("holds", "has no sample".to_owned()));
        }
        Ok(())
    }
}

struct GrantFields {
    /// Its subject, for errors.
    what: String,
}

impl GrantFields {
    fn name(&self, field: &'static str, value: &str) -> Result<(), GrantError> {
        if value.is_empty() || value.len() > NAME_MAX {
            let reason = format!("has {} bytes, instead of 1 to {NAME_MAX}", value.len());
            return Err(self.error(field, reason));
        }
        Ok(())
    }

    fn number(
        &self,
        field: &'static str,
        value: u64,
        bounds: RangeInclusive<u64>,
    ) -> Result<(), GrantError> {
        if !bounds.contains(&value) {
            let (least, most) = bounds.into_inner();
            return Err(self.error(field, format!("is {value}, instead of {least} to {most}")));
        }
        Ok(())
    }

    fn error(&self, field: &'static str, reason: String) -> GrantError {
        GrantError { what: self.what.clone(), field, reason }
    }
}

/// Returns a name for an error: its first characters.
fn shown(name: &str) -> String {
    visible(&name.chars().take(100).collect::<String>())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn grant(id: u32) -> TopicGrant {
        TopicGrant {
            id,
            topic: "/imu".to_owned(),
            queue: 1,
            depth: 1,
            holds: PinGrant { windows: 1, window: 1, singles: 0 },
            ..TopicGrant::default()
        }
    }

    fn reader(topics: Vec<TopicGrant>) -> AddReader {
        AddReader { name: "brake".to_owned(), topics, publishes: Vec::new() }
    }

    #[test]
    fn an_error_names_the_topic_and_the_field() {
        let refused = |change: fn(&mut TopicGrant)| {
            let mut grant = grant(1);
            change(&mut grant);
            reader(vec![grant]).check().unwrap_err().to_string()
        };
        let topic = |text: &str| format!("the grant of topic `/imu` is invalid: {text}");
        assert_eq!(refused(|grant| grant.queue = 0), topic("`queue` is 0, instead of 1 to 65536"));
        assert_eq!(
            refused(|grant| grant.depth = u32::MAX),
            topic("`depth` is 4294967295, instead of 1 to 131072")
        );
        assert_eq!(
            refused(|grant| grant.max_bytes = Some(0)),
            topic("`max_bytes` is 0, instead of 1 to 1073741824")
        );
        assert_eq!(
            refused(|grant| grant.type_name = Some(String::new())),
            topic("`type_name` has 0 bytes, instead of 1 to 1024")
        );
        assert_eq!(
            refused(|grant| grant.holds.window = 0),
            topic("`holds.window` is 0, instead of 1 to 65535")
        );
        assert_eq!(refused(|grant| grant.holds.windows = 0), topic("`holds` has no sample"));
        let long = "x".repeat(2000);
        let refused = AddReader { name: long, ..reader(Vec::new()) }.check().unwrap_err();
        assert!(refused.to_string().ends_with("`name` has 2000 bytes, instead of 1 to 1024"));
        assert!(refused.to_string().len() < 250, "a long name is shown in part");
    }

    #[test]
    fn the_memory_of_a_publisher_is_limited() {
        let refused = |depth, max_bytes| {
            let (topic, type_name) = ("/out".to_owned(), "std_msgs/msg/String".to_owned());
            let grant = PublishGrant { topic, type_name, depth, max_bytes };
            grant.check().unwrap_err().to_string()
        };
        let topic = |text: &str| format!("the grant of topic `/out` is invalid: {text}");
        let too_long = "`max_bytes` is 262145, instead of 1 to 262144";
        assert_eq!(refused(1, PUBLISH_MAX + 1), topic(too_long));
        let too_much = "`depth * max_bytes` is 67371008, instead of 1 to 67108864";
        assert_eq!(refused(257, PUBLISH_MAX), topic(too_much));
    }

    #[test]
    fn an_id_is_granted_once_and_topics_are_limited() {
        assert_eq!(reader((0..1024).map(grant).collect()).check(), Ok(()));
        let refused = |topics: Vec<TopicGrant>| reader(topics).check().unwrap_err().to_string();
        assert_eq!(
            refused(vec![grant(7), grant(8), grant(7)]),
            "the grant of reader `brake` is invalid: `topics` has id 7 twice"
        );
        assert_eq!(
            refused((0..1025).map(grant).collect()),
            "the grant of reader `brake` is invalid: `topics` is 1025, instead of 0 to 1024"
        );
    }
}

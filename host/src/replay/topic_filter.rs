//! Selects the topics of a drive that clips hold: those of `[record]`, or those of `--topics`
//! instead.

use std::collections::HashSet;

use gleaner_base::{Exit, Failure, excerpt};
use gleaner_drives::Replay;
use gleaner_lambda::manifest::RecordSpec;
use gleaner_messages::transport::{DiscoveredTopic, Qos, TopicSpec};
use gleaner_recorder::{MESSAGE_MAX, TOPICS_MAX};

use super::options::ReplayOptions;
use crate::input::Remap;

/// Maximum number of topics that a message names.
const NAMED: usize = 20;

/// Topics that clips are to hold.
#[derive(Default)]
pub(super) struct ChosenTopics {
    /// Their names, as in the drive, each once.
    pub(super) names: Vec<String>,
    /// A sentence on those that were to be recorded too, but cannot be read.
    pub(super) left_out: Option<String>,
}

/// Chooses the topics that clips are to hold.
pub(super) fn topics(
    rules: &RecordSpec,
    options: &ReplayOptions,
    drive: &Replay,
    known: &[DiscoveredTopic],
) -> Result<ChosenTopics, Failure> {
    let (mut chosen, mut names, mut left_out) = (HashSet::new(), Vec::new(), Vec::new());
    // Two topics of the manifest may be one of the drive, and two patterns may match one.
    let mut add = |name: &str| {
        if chosen.insert(name.to_owned()) {
            names.push(name.to_owned());
        }
    };
    if options.topics.is_empty() {
        rules
            .topics
            .iter()
            .for_each(|topic| add(Remap::apply(&options.lambda.remaps, topic.as_str())));
        return Ok(ChosenTopics { names, left_out: None });
    }
    for pattern in &options.topics {
        let found: Vec<_> = known.iter().filter(|topic| matches(pattern, &topic.topic)).collect();
        if found.is_empty() {
            let failure = Failure::new(
                Exit::Usage,
                format!("the drive has no topic `{pattern}` of --topics"),
            );
            return Err(failure
                .with_help(format!("the drive has {}; a * stands for any letters", list(known))));
        }
        let (readable, others): (Vec<_>, Vec<_>) =
            found.into_iter().partition(|topic| drive.can_subscribe(&spec_of(topic)).is_ok());
        if readable.is_empty() {
            let message = format!("no topic that --topics `{pattern}` matches can be recorded");
            return Err(nothing_readable(message, &others, drive, known));
        }
        for topic in others.iter().take(NAMED) {
            let error = drive.can_subscribe(&spec_of(topic)).err();
            let error = error.map(|error| error.to_string()).unwrap_or_default();
            tracing::warn!(topic = %topic.topic, %error, "clips are made without this topic");
        }
        if others.len() > NAMED {
            tracing::warn!(
                topics = others.len() - NAMED,
                "clips are made without further topics that cannot be read"
            );
        }
        readable.iter().for_each(|topic| add(&topic.topic));
        left_out.extend(others);
    }
    left_out.retain(|topic| !names.contains(&topic.topic));
    if names.len() > TOPICS_MAX {
        let message =
            format!("--topics chooses {} topics; clips hold at most {TOPICS_MAX}", names.len());
        return Err(Failure::new(Exit::Usage, message)
            .with_help("choose fewer: --topics PATTERN, as in '/camera/*'"));
    }
    let sentence = || format!("no messages of {}, which cannot be read", list(left_out.clone()));
    let left_out = (!left_out.is_empty()).then(sentence);
    Ok(ChosenTopics { names, left_out })
}

/// The subscription that records a topic of the drive.
pub(super) fn spec_of(found: &DiscoveredTopic) -> TopicSpec {
    let (topic, type_name) = (found.topic.clone(), found.type_name.clone());
    TopicSpec { topic, type_name, queue: 1, max_bytes: MESSAGE_MAX, qos: Qos::Auto }
}

fn nothing_readable(
    message: String,
    others: &[&DiscoveredTopic],
    drive: &Replay,
    known: &[DiscoveredTopic],
) -> Failure {
    let errors = others.iter().filter_map(|topic| drive.can_subscribe(&spec_of(topic)).err());
    let mut failure = Failure::new(Exit::Usage, message);
    failure.causes = errors.take(1).map(|error| error.to_string()).collect();
    let readable = known.iter().filter(|topic| drive.can_subscribe(&spec_of(topic)).is_ok());
    failure.with_help(format!("the drive has {}, which can be recorded", list(readable)))
}

/// Lists the names of some topics, for a message.
pub(super) fn list<'a>(topics: impl IntoIterator<Item = &'a DiscoveredTopic>) -> String {
    let mut topics = topics.into_iter();
    let names: Vec<_> =
        topics.by_ref().take(NAMED).map(|topic| format!("`{}`", excerpt(&topic.topic))).collect();
    match (names.is_empty(), topics.count()) {
        (true, _) => "no topic".to_owned(),
        (false, 0) => names.join(", "),
        (false, more) => format!("{}, and {more} more", names.join(", ")),
    }
}

/// Returns whether `name` matches `pattern`, in which a `*` stands for any number of letters.
fn matches(pattern: &str, name: &str) -> bool {
    let mut parts = pattern.split('*');
    let Some(mut rest) = name.strip_prefix(parts.next().unwrap_or_default()) else { return false };
    let Some(last) = parts.next_back() else { return rest.is_empty() };
    for part in parts {
        // The first match is the best: it leaves the most for the parts that follow.
        let Some(at) = rest.find(part) else { return false };
        rest = &rest[at + part.len()..];
    }
    rest.ends_with(last)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_star_stands_for_any_letters_and_nothing_else_does() {
        for (pattern, name, expected) in [
            ("/imu/data", "/imu/data", true),
            ("/imu/data", "/imu/data2", false),
            ("*", "/imu/data", true),
            ("/camera/*", "/camera/front/image", true),
            ("/camera/*", "/camera", false),
            ("*/image", "/camera/front/image", true),
            ("/*/front/*", "/camera/front/image", true),
            ("/*/rear/*", "/camera/front/image", false),
            ("/a*a", "/a", false),
            ("/a*a", "/aa", true),
            ("/a*b*b", "/ab", false),
            ("", "/a", false),
            ("/.*", "/a", false),
        ] {
            assert_eq!(matches(pattern, name), expected, "{pattern} {name}");
        }
    }
}

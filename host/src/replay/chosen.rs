//! Which topics of a drive its clips hold: those of `[record]`, or those that the command line chooses instead.

use gleaner_protocol::manifest::Record;
use gleaner_protocol::{Exit, Failure};
use gleaner_transport::DiscoveredTopic;

use super::Options;
use crate::input::Remap;

/// A topic that clips are to hold.
pub(super) struct Chosen {
    /// Its name in the drive.
    pub(super) name: String,
    /// Whether it is one of all that a pattern matches: then one that cannot be recorded is left out.
    pub(super) is_one_of_many: bool,
}

/// The topics, each once.
pub(super) fn topics(rules: &Record, options: &Options, known: &[DiscoveredTopic]) -> Result<Vec<Chosen>, Failure> {
    let mut chosen: Vec<Chosen> = Vec::new();
    let mut add = |name: &str, is_one_of_many| {
        // Two topics of the manifest may be one of the drive.
        if !chosen.iter().any(|known| known.name == name) {
            chosen.push(Chosen { name: name.to_owned(), is_one_of_many });
        }
    };
    if options.topics.is_empty() {
        rules.topics.iter().for_each(|topic| add(Remap::apply(&options.asked.remaps, topic.as_str()), false));
    }
    for pattern in &options.topics {
        let mut found = known.iter().filter(|topic| matches(pattern, &topic.topic)).peekable();
        if found.peek().is_none() {
            let failure = Failure::new(Exit::Usage, format!("the drive has no topic `{pattern}` of --topics"));
            let names: Vec<_> = known.iter().map(|topic| topic.topic.as_str()).collect();
            return Err(
                failure.with_help(format!("the drive has `{}`; a * stands for any letters", names.join("`, `")))
            );
        }
        found.for_each(|topic| add(&topic.topic, pattern.contains('*')));
    }
    Ok(chosen)
}

/// Whether `name` is what `pattern` says, in which a `*` stands for any letters, or none.
fn matches(pattern: &str, name: &str) -> bool {
    let mut parts = pattern.split('*');
    let Some(mut rest) = name.strip_prefix(parts.next().unwrap_or_default()) else { return false };
    let Some(last) = parts.next_back() else { return rest.is_empty() };
    for part in parts {
        // The first place is as good as any: it leaves the most for what follows.
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

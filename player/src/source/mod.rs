//! Sources of messages: a drive, or synthetic sensors.

mod drive;
mod images;
mod synthetic;

use std::collections::{BTreeMap, BTreeSet};

use gleaner_base::{Exit, Failure};

use crate::args::Args;
use crate::offer::Offer;
use crate::queue::QueuedMessage;

#[derive(Clone, Debug)]
pub(crate) struct PlayedTopic {
    /// Its ROS 2 name, which is valid, like its type.
    pub(crate) topic: String,
    pub(crate) type_name: String,
    pub(crate) offer: Offer,
    /// Set if its messages begin with a stamp.
    pub(crate) is_stamped: bool,
}

/// A source, read ahead by one thread.
pub(crate) trait MessageSource: Send {
    /// The topics; messages refer to them by index.
    fn topics(&self) -> &[PlayedTopic];

    /// The next message, in the order of their times; `None` at the end.
    fn next(&mut self) -> Result<Option<QueuedMessage>, Failure>;

    fn read_ahead(&self) -> usize;

    /// Number of messages of a topic that could not be converted.
    fn undecodable(&self, topic: usize) -> u64;
}

pub(crate) fn open(args: &Args) -> Result<Box<dyn MessageSource>, Failure> {
    if args.drives.is_empty() {
        return Ok(Box::new(synthetic::Synthetic::open(args)?));
    }
    Ok(Box::new(drive::Drive::open(args)?))
}

/// New names of topics, by `--remap`.
struct Remaps<'a>(BTreeMap<&'a str, &'a str>);

impl<'a> Remaps<'a> {
    fn of(args: &'a Args) -> Remaps<'a> {
        Remaps(args.remap.iter().map(|(from, to)| (from.as_str(), to.as_str())).collect())
    }

    fn take(&mut self, topic: &str) -> Option<&'a str> {
        self.0.remove(topic)
    }

    /// Refuses unused names, and two topics with the same name.
    fn check(&self, topics: &[PlayedTopic]) -> Result<(), Failure> {
        if let Some(name) = self.0.keys().next() {
            let message = format!("--remap names `{name}`, which is not played");
            return Err(Failure::new(Exit::Usage, message)
                .with_help("FROM is the name of a topic without --remap"));
        }
        let mut names = BTreeSet::new();
        if let Some(duplicate) = topics.iter().find(|topic| !names.insert(&topic.topic)) {
            let message = format!("two topics would be played as `{}`", duplicate.topic);
            return Err(Failure::new(Exit::Usage, message)
                .with_help("give one of them another name with --remap"));
        }
        Ok(())
    }
}

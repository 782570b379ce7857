//! Where messages come from: a drive, or sensors that are made up.

mod drive;
mod images;
mod synthetic;

use std::collections::{BTreeMap, BTreeSet};

use gleaner_base::{Exit, Failure};

use crate::args::Args;
use crate::offer::Offer;
use crate::queue::Message;

/// A topic that a source has messages for.
#[derive(Clone, Debug)]
pub(crate) struct Topic {
    /// As ROS 2 calls it, like its type.
    pub(crate) topic: String,
    pub(crate) type_name: String,
    pub(crate) offer: Offer,
    /// Whether its messages begin with a stamp.
    pub(crate) is_stamped: bool,
}

/// A source, read by one thread, ahead of time.
pub(crate) trait Source: Send {
    /// The topics; a message names one by its index.
    fn topics(&self) -> &[Topic];

    /// The next message, in the order of their times; `None` at the end.
    fn next(&mut self) -> Result<Option<Message>, Failure>;

    /// Bytes of messages to read ahead.
    fn read_ahead(&self) -> usize;

    /// Messages of a topic that could not be turned into what is to be sent.
    fn undecodable(&self, topic: usize) -> u64;
}

/// The source that the arguments ask for.
pub(crate) fn open(args: &Args) -> Result<Box<dyn Source>, Failure> {
    if args.drives.is_empty() {
        return Ok(Box::new(synthetic::Synthetic::open(args)?));
    }
    Ok(Box::new(drive::Drive::open(args)?))
}

/// Other names for topics, by `--remap`.
struct Renamed<'a>(BTreeMap<&'a str, &'a str>);

impl<'a> Renamed<'a> {
    fn by(args: &'a Args) -> Renamed<'a> {
        Renamed(args.remap.iter().map(|(from, to)| (from.as_str(), to.as_str())).collect())
    }

    /// The other name of `topic`, if it is given one.
    fn take(&mut self, topic: &str) -> Option<&'a str> {
        self.0.remove(topic)
    }

    /// Refuses names that nobody took, and two topics of one name.
    fn check(&self, topics: &[Topic]) -> Result<(), Failure> {
        if let Some(name) = self.0.keys().next() {
            let what = format!("--remap names `{name}`, which is not played");
            return Err(Failure::new(Exit::Usage, what)
                .with_help("FROM is the name of a topic without --remap"));
        }
        let mut names = BTreeSet::new();
        if let Some(twice) = topics.iter().find(|topic| !names.insert(&topic.topic)) {
            let what = format!("two topics would be played as `{}`", twice.topic);
            return Err(Failure::new(Exit::Usage, what)
                .with_help("give one of them another name with --remap"));
        }
        Ok(())
    }
}

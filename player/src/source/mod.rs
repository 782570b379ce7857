//! Where messages come from: a drive, or sensors that are made up.

mod drive;
mod images;
mod synthetic;

use gleaner_protocol::Failure;

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
        return Ok(Box::new(synthetic::Synthetic::new(args.synthetic, args.imu, args.duration)));
    }
    Ok(Box::new(drive::Drive::open(args)?))
}

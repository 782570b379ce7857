//! The thumbnail of a clip, from its making to its end.

use gleaner_transport::SampleMeta;

use super::stock::Desk;
use crate::RecordError;
use crate::preroll::{Preroll, Source, Walked};
use crate::thumbnail::thumbnail;
use crate::window::Group;

/// Images that are tried until one can be read. Each costs some milliseconds.
const TRIES: u32 = 8;

/// The picture of a clip.
#[derive(Debug, Default)]
pub(super) struct Picture {
    jpeg: Option<Vec<u8>>,
    /// The topic that it is made from, once the clip has one with images.
    topic: Option<usize>,
    tried: u32,
}

impl Picture {
    /// Makes the picture when the clip first has a topic with images: from the newest image that is held, belongs into the
    /// clip, which ends at `limit` at the latest, and is not later than the trigger. A clip that `continues` another takes
    /// its own first image.
    pub(super) fn look(
        &mut self,
        desk: &Desk,
        preroll: &mut Preroll,
        group: &Group,
        limit: i64,
        continues: bool,
    ) -> Result<(), RecordError> {
        if self.topic.is_some() {
            return Ok(());
        }
        self.topic = desk.topics_of(group).into_iter().find(|topic| desk.lanes[*topic].is_image());
        let Some(topic) = self.topic.filter(|_| !continues) else { return Ok(()) };
        let until = group.first.1.min(limit);
        let mut newest = None;
        let mut next = preroll.next(None);
        while let Some(place) = next.map(Walked::place) {
            let held = preroll.held(place);
            let is_newer = newest.is_none_or(|(at, _)| at <= held.at_ns);
            let is_ours = held.source == Source::topic(topic) && desk.covers(group, topic, held.at_ns);
            if is_ours && held.at_ns <= until && is_newer {
                newest = Some((held.at_ns, place));
            }
            next = preroll.next(next);
        }
        if let Some((_, place)) = newest {
            let meta = preroll.held(place).meta();
            self.try_one(desk, topic, &meta, preroll.bytes(place)?);
        }
        Ok(())
    }

    /// A message is written to the clip: makes the picture from it, if it has none.
    pub(super) fn offer(&mut self, desk: &Desk, topic: usize, meta: &SampleMeta, cdr: &[u8]) {
        if self.topic == Some(topic) {
            self.try_one(desk, topic, meta, cdr);
        }
    }

    fn try_one(&mut self, desk: &Desk, topic: usize, meta: &SampleMeta, cdr: &[u8]) {
        if self.jpeg.is_none() && self.tried < TRIES {
            self.tried += 1;
            self.jpeg = thumbnail(&desk.lanes[topic].topic.type_name, cdr, meta.endian);
        }
    }

    /// The picture, if there is one.
    pub(super) fn into_jpeg(self) -> Option<Vec<u8>> {
        self.jpeg
    }
}

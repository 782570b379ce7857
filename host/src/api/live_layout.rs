//! The layout of the samples of a live topic, which is unknown until a writer announces it.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicU64, Ordering};

use gleaner_messages::transport::SampleMeta;

use super::data::Topic;

/// The layout of the definitions of a live topic. Nothing for other topics.
#[derive(Default)]
pub(crate) struct LiveLayout {
    /// RIHS01 of the definitions.
    own: OnceLock<String>,
    /// Position from which on writers may have announced another one; [`u64::MAX`] for none.
    unconfirmed_from: AtomicU64,
}

impl LiveLayout {
    /// Sets the hash of the definitions, once, and whether writers have announced it.
    pub(crate) fn set(&self, (type_hash, is_announced): (String, bool)) {
        drop(self.own.set(type_hash));
        self.unconfirmed_from.store(if is_announced { u64::MAX } else { 0 }, Ordering::Relaxed);
    }

    /// Returns the number of the layout of a sample among those of the definitions. Samples that
    /// are not confirmed are hidden.
    pub(super) fn number_of(&self, meta: &SampleMeta) -> u16 {
        if self.own.get().is_some() { 0 } else { meta.layout }
    }

    /// Compares what writers announce with the definitions. From then on, samples are shown.
    pub(crate) fn confirm(&self, announced: &str) -> Result<(), String> {
        let own = self.own.get().map_or("", String::as_str);
        if own != announced {
            return Err(format!(
                "its writers announce the layout {announced}, and the definition here has {own}"
            ));
        }
        self.unconfirmed_from.store(u64::MAX, Ordering::Relaxed);
        Ok(())
    }
}

impl Topic {
    /// Takes what writers announce after a restart of the ingress, whose samples follow.
    pub(crate) fn check_layout(&self, announced: Option<&str>) -> Result<(), String> {
        let layout = &self.live_layout;
        if layout.own.get().is_none() {
            return Ok(());
        }
        if self.unconfirmed(self.reader().head()).is_some() {
            let why = "the ingress has ended before it named the layout of the newest samples";
            return Err(why.to_owned());
        }
        if let Some(announced) = announced {
            return layout.confirm(announced);
        }
        layout.unconfirmed_from.fetch_min(self.reader().head(), Ordering::Relaxed);
        Ok(())
    }

    /// Returns the position of the first sample that the lambda sees and that has an announced
    /// layout, if that may be another one than that of the definitions.
    pub(crate) fn first_unconfirmed(&self) -> Option<u64> {
        self.unconfirmed(self.until())
    }

    fn unconfirmed(&self, until: u64) -> Option<u64> {
        self.live_layout.own.get()?;
        let reader = self.reader();
        let oldest = reader.head().saturating_sub(reader.depth() as u64);
        let from = self.live_layout.unconfirmed_from.load(Ordering::Relaxed);
        let until = until.min(reader.head());
        let is_announced = |position: &u64| {
            reader.meta(*position).is_some_and(|meta| meta.sample.layout == SampleMeta::ANNOUNCED)
        };
        let first = (from.max(oldest)..until).find(is_announced);
        if first.is_none() && from < until {
            // They were looked at.
            self.live_layout.unconfirmed_from.store(until, Ordering::Relaxed);
        }
        first
    }

    /// Hides samples whose layout may be another one than that of the definitions. Later samples
    /// are shown at the wakes.
    pub(crate) fn hide_unconfirmed(&self) {
        let is_confirmed = self.live_layout.unconfirmed_from.load(Ordering::Relaxed) == u64::MAX;
        if self.live_layout.own.get().is_some() && !is_confirmed {
            let head = self.reader().head();
            self.hide_from(self.first_unconfirmed().unwrap_or(head).min(head));
        }
    }
}

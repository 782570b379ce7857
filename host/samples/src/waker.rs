//! The bell of this process.

use std::time::Duration;

use crate::regions::{ControlRegion, KernelFutex};
use gleaner_buffers::shared::Notifier;

/// The bell of this process, which the ingress rings for samples. Any thread may ring it through a
/// clone; one thread waits.
pub struct Waker {
    page: ControlRegion,
    bell: Notifier,
}

impl Waker {
    pub(crate) fn of(page: &ControlRegion) -> Waker {
        Waker { page: page.clone(), bell: Notifier::of(page.clone()) }
    }

    /// Returns the value of the bell. Read it before looking at the topics.
    pub fn value(&self) -> u32 {
        self.bell.value()
    }

    /// Sleeps until the bell differs from `seen`, for `timeout` at most; at times it returns
    /// earlier.
    ///
    /// Only one thread may wait: a second one may sleep until its timeout. As nothing rings when
    /// the ingress ends, wait with a timeout, and then call [`Feed::poll`](crate::Feed::poll).
    pub fn wait(&mut self, seen: u32, timeout: Duration) {
        self.bell.wait(seen, timeout, &KernelFutex);
    }

    /// Rings the bell, as the ingress does: ends the wait of this process.
    pub fn ring(&self) {
        self.bell.ring(&KernelFutex);
    }
}

impl Clone for Waker {
    fn clone(&self) -> Self {
        Waker::of(&self.page)
    }
}

impl std::fmt::Debug for Waker {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("FeedBell").field("value", &self.value()).finish_non_exhaustive()
    }
}

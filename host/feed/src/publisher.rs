//! Publishes through the ingress.

use gleaner_protocol::ingress::IngressRequests;
use gleaner_transport::{PublishError, Publisher};

/// A topic that this process may publish. The ingress drops what exceeds its grant.
pub(crate) struct FeedPublisher {
    pub(crate) requests: IngressRequests,
    /// Index of the topic among those that the starter lets this process publish.
    pub(crate) index: u32,
}

impl Publisher for FeedPublisher {
    fn publish(&self, cdr: &[u8]) -> Result<(), PublishError> {
        let sent = self.requests.publish(self.index, cdr);
        sent.map_err(|error| PublishError(Box::new(error)))
    }
}

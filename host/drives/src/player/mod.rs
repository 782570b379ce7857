//! Plays a drive as a live source.
//!
//! - `playback`: the thread that delivers messages at their times.
//! - `route`: the subscribers of one topic.

mod playback;
mod route;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;

use gleaner_base::visible;
use gleaner_messages::Definitions;
use gleaner_messages::transport::{
    Clock, DiscoveredTopic, Guid, Health, LiveSource, PublishError, Publisher, Sink, Subscription,
    TopicSpec, Transport, TransportError, same_type,
};
use tracing::error;

use crate::catalog::Catalog;
use crate::drive::Replay;
use crate::error::ReplayError;
use crate::options::DriveOptions;
use playback::{Playback, PlaybackState};
use route::{LoopedPublisher, TopicRoute};

/// Size up to which a message that is packed by itself is unpacked, whatever was subscribed before
/// the start, in bytes.
const UNPACKED_BYTES: usize = 64 << 20;

/// A drive as a live source: its messages are delivered in real time from
/// [`begin`](LiveSource::begin) on.
///
/// A message is stamped with the time of its delivery; its publish time moves by the same
/// difference. Sequence numbers, writers and everything else are those of the drive. Messages are
/// never dropped: where delivery takes longer than the drive, later ones are late.
///
/// The drive takes the place of a network, so its topics can be published as well: a message goes
/// to the subscribers of its topic, and nowhere else. A topic that is not in the drive can be
/// subscribed once it was opened for publishing.
pub struct DrivePlayer {
    catalog: Arc<Catalog>,
    topics: Vec<DiscoveredTopic>,
    /// The drive, until it plays.
    drive: Option<Replay>,
    routes: Mutex<BTreeMap<String, Arc<TopicRoute>>>,
    subscriptions: Vec<Option<Arc<TopicRoute>>>,
    clock: Clock,
    rate: f64,
    state: Arc<PlaybackState>,
    thread: Option<JoinHandle<()>>,
    publishers: Mutex<u64>,
}

impl DrivePlayer {
    /// Opens a drive as [`Replay::open_as`] does, to be played `rate` times as fast as it was
    /// recorded, with stamps of `clock`.
    ///
    /// # Errors
    ///
    /// As [`Replay::open_as`].
    pub fn open(
        paths: &[PathBuf],
        options: &DriveOptions,
        clock: Clock,
        rate: f64,
    ) -> Result<Self, ReplayError> {
        let drive = Replay::open_as(paths, options)?;
        let catalog = drive.catalog();
        Ok(Self {
            topics: catalog.topics(),
            catalog,
            drive: Some(drive),
            routes: Mutex::default(),
            subscriptions: Vec::new(),
            clock,
            rate,
            state: Arc::default(),
            thread: None,
            publishers: Mutex::default(),
        })
    }

    /// Returns the type of `spec`'s topic in the drive, or as it was opened for publishing.
    fn type_of(&self, spec: &TopicSpec) -> Result<String, TransportError> {
        let error = match self.catalog.select(spec) {
            Ok(_) => return Ok(spec.type_name.clone()),
            Err(error) => error,
        };
        let routes = self.routes();
        let found = match (&error, routes.get(&spec.topic)) {
            (TransportError::NoSuchTopic { .. }, Some(published)) => published.type_name(),
            _ => return Err(error),
        };
        if same_type(found, &spec.type_name) {
            return Ok(found.to_owned());
        }
        Err(wrong_type(&spec.topic, &spec.type_name, found))
    }

    fn routes(&self) -> MutexGuard<'_, BTreeMap<String, Arc<TopicRoute>>> {
        self.routes.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the route of a topic; a new one has type `type_name`.
    fn route(&self, topic: &str, type_name: &str) -> Arc<TopicRoute> {
        let mut routes = self.routes();
        let route = routes
            .entry(topic.to_owned())
            .or_insert_with(|| Arc::new(TopicRoute::new(type_name.to_owned(), self.clock)));
        Arc::clone(route)
    }
}

impl Transport for DrivePlayer {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        self.topics.clone()
    }

    /// As for every transport. While the drive plays, only topics can be added that were subscribed
    /// before: others fail with [`TransportError::AlreadyStarted`].
    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        let type_name = self.type_of(spec)?;
        if self.drive.is_none() && !self.routes().contains_key(&spec.topic) {
            return Err(TransportError::AlreadyStarted { topic: spec.topic.clone() });
        }
        let route = self.route(&spec.topic, &type_name);
        if !same_type(route.type_name(), &type_name) {
            return Err(wrong_type(&spec.topic, &type_name, route.type_name()));
        }
        let subscription = Subscription(self.subscriptions.len());
        route.add(subscription, spec.max_bytes, sink);
        self.subscriptions.push(Some(route));
        Ok(subscription)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        let routes = self.routes();
        self.catalog.definitions(topic, routes.get(topic).map(|route| route.type_name()))
    }
}

impl LiveSource for DrivePlayer {
    fn health(&self) -> Health {
        Health { network: None, dead: self.state.damage() }
    }

    fn unsubscribe(&mut self, subscription: Subscription) {
        let known = self.subscriptions.get_mut(subscription.0).and_then(Option::take);
        if let Some(route) = known {
            route.remove(subscription);
        }
    }

    /// Published messages go to the subscribers of their topic.
    ///
    /// # Errors
    ///
    /// [`PublishError`] if the topic has another type.
    fn publisher(
        &self,
        topic: &str,
        type_name: &str,
        _depth: usize,
    ) -> Result<Box<dyn Publisher>, PublishError> {
        let found = self.topics.iter().find(|known| known.topic == topic).map_or_else(
            || self.route(topic, type_name).type_name().to_owned(),
            |known| known.type_name.clone(),
        );
        if !same_type(&found, type_name) {
            return Err(PublishError(wrong_type(topic, type_name, &found).into()));
        }
        let mut publishers = self.publishers.lock().unwrap_or_else(PoisonError::into_inner);
        *publishers += 1;
        let mut writer = *b"gleaner drive   ";
        writer[8..].copy_from_slice(&publishers.to_le_bytes());
        Ok(Box::new(LoopedPublisher::new(self.route(topic, type_name), Guid(writer))))
    }

    fn knows_all_topics(&self) -> bool {
        true
    }

    /// Starts to play the topics that are subscribed.
    fn begin(&mut self) {
        let Some(mut drive) = self.drive.take() else { return };
        for (topic, route) in self.routes().iter() {
            let spec = TopicSpec {
                topic: topic.clone(),
                type_name: route.type_name().to_owned(),
                queue: 0,
                max_bytes: route.max_bytes().max(UNPACKED_BYTES),
                qos: gleaner_messages::transport::Qos::Auto,
            };
            match drive.subscribe(&spec, route.clone()) {
                // It is only published.
                Ok(_) | Err(TransportError::NoSuchTopic { .. }) => {}
                Err(why) => {
                    let topic = visible(topic);
                    error!(%topic, error = &why as &dyn std::error::Error, "cannot play a topic");
                }
            }
        }
        let playback = Playback::new(drive, self.rate, Arc::clone(&self.state));
        match std::thread::Builder::new().name("drive".to_owned()).spawn(|| playback.run()) {
            Ok(thread) => self.thread = Some(thread),
            Err(why) => self.state.end(Some(format!("cannot start a thread: {why}"))),
        }
    }

    fn has_ended(&self) -> bool {
        self.state.has_ended()
    }
}

fn wrong_type(topic: &str, wanted: &str, found: &str) -> TransportError {
    let [topic, wanted, found] = [topic, wanted, found].map(str::to_owned);
    TransportError::WrongType { topic, wanted, found }
}

impl Drop for DrivePlayer {
    fn drop(&mut self) {
        self.state.stop();
        if let Some(thread) = self.thread.take() {
            // The cause of a panic was printed.
            let _ = thread.join();
        }
    }
}

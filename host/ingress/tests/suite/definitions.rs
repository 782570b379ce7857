//! Definitions that other nodes have.

use std::collections::HashSet;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use gleaner_messages::Definitions;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{
    DefinitionsSearch, DiscoveredTopic, Health, LiveSource, PublishError, Publisher, Sink,
    Subscription, TopicSpec, Transport, TransportError,
};
use gleaner_protocol::ingress::TopicGrant;

use crate::support::{RunningIngress, TIMEOUT, TYPE, grant};

/// Time of a query, which no node answers.
const QUERY: Duration = Duration::from_millis(20);

/// The layout of all topics of the source.
const LAYOUT: &str = "RIHS01_376752aeb9e256c4e2313368a5a32645d62041d37777621433ea5e52e280b5ea";

/// A source without definitions, which sends one query at a time.
struct SlowNodes {
    loopback: Loopback,
    queries: Mutex<Queries>,
    /// The types of all queries.
    sent: Arc<Mutex<Vec<String>>>,
}

#[derive(Default)]
struct Queries {
    open: Option<(String, Instant)>,
    done: HashSet<String>,
}

impl Transport for SlowNodes {
    fn topics(&self) -> Vec<DiscoveredTopic> {
        self.loopback.topics()
    }

    fn subscribe(
        &mut self,
        spec: &TopicSpec,
        sink: Arc<dyn Sink>,
    ) -> Result<Subscription, TransportError> {
        self.loopback.subscribe(spec, sink)
    }

    fn definitions(&self, topic: &str) -> Result<Arc<Definitions>, TransportError> {
        self.loopback.definitions(topic)
    }

    fn search_definitions(&self, type_name: &str) -> DefinitionsSearch {
        let mut queries = self.queries.lock().unwrap();
        if let Some((done, _)) = queries.open.take_if(|(_, since)| since.elapsed() >= QUERY) {
            queries.done.insert(done);
        }
        if queries.done.contains(type_name) {
            return DefinitionsSearch::Ended;
        }
        if queries.open.is_some() {
            return DefinitionsSearch::Waiting;
        }
        queries.open = Some((type_name.to_owned(), Instant::now()));
        self.sent.lock().unwrap().push(type_name.to_owned());
        DefinitionsSearch::Started
    }
}

impl LiveSource for SlowNodes {
    fn health(&self) -> Health {
        self.loopback.health()
    }

    fn unsubscribe(&mut self, subscription: Subscription) {
        self.loopback.unsubscribe(subscription);
    }

    fn layout(&self, _: Subscription) -> Option<String> {
        Some(LAYOUT.to_owned())
    }

    fn publisher(
        &self,
        topic: &str,
        type_name: &str,
        depth: usize,
    ) -> Result<Box<dyn Publisher>, PublishError> {
        self.loopback.publisher(topic, type_name, depth)
    }
}

#[test]
fn a_reader_with_many_unknown_types_does_not_keep_others_from_a_query() {
    const TYPES: u32 = 40;
    let loopback = Loopback::new();
    let granted = |id: u32| {
        let type_name = format!("car_msgs/msg/T{id}");
        loopback.add_topic(&format!("/t{id}"), &type_name, "");
        TopicGrant { type_name: Some(type_name), ..grant(id, &format!("/t{id}")) }
    };
    let (grants, last) = ((0..TYPES).map(granted).collect(), granted(TYPES));
    let sent = Arc::<Mutex<Vec<String>>>::default();
    let source = SlowNodes { loopback, queries: Mutex::default(), sent: sent.clone() };
    let mut ingress = RunningIngress::over(source);
    let mut hostile = ingress.reader("hostile", grants);
    for id in 0..TYPES {
        hostile.topic(id, TIMEOUT).unwrap();
        hostile.request_definitions(id).unwrap();
    }
    let mut honest = ingress.reading("honest", last);
    assert_eq!(honest.feed.definitions(TYPES, TIMEOUT).unwrap(), None);
    let sent = sent.lock().unwrap();
    let turn = sent.iter().position(|type_name| *type_name == format!("car_msgs/msg/T{TYPES}"));
    assert!(turn.is_some_and(|turn| turn < 20), "{sent:?}");
}

#[test]
fn the_layout_of_a_topic_is_named_only_to_readers_with_a_grant_of_it() {
    let loopback = Loopback::new();
    loopback.add_topic("/number", TYPE, "");
    let (queries, sent) = (Mutex::default(), Arc::default());
    let mut ingress = RunningIngress::over(SlowNodes { loopback, queries, sent });
    let mut honest = ingress.reading("honest", grant(7, "/number"));
    let mut stranger = ingress.reader("stranger", Vec::new());
    for id in [0, 1, 7, 8, u32::MAX] {
        assert_eq!(stranger.layout(id, TIMEOUT).unwrap(), None, "{id}");
        let named = honest.feed.layout(id, TIMEOUT).unwrap();
        assert_eq!(named.as_deref(), (id == 7).then_some(LAYOUT), "{id}");
    }
    ingress.status(|status| status.readers == 2);
}

//! Tests of definitions that only the node with the writer has: queried at a node of ros2-client.

use std::net::UdpSocket;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use gleaner_dds::{Dds, DdsOptions};
use gleaner_messages::FieldPath;
use gleaner_messages::transport::{DefinitionsSearch, LiveSource, Transport, TransportError};
use ros2_client::qos::{Durability, History, WhenFull};
use ros2_client::{
    Context, Message, MessageTypeName, Name, Node, NodeName, NodeOptions, QosProfile,
    ServiceTypeName,
};
use ros2_client::{Server, ServiceMapping};
use rustdds::no_key::SerializerAdapter;
use rustdds::{CDRSerializerAdapter, DomainParticipant, GUID};
use serde::{Deserialize, Serialize};

use super::Test;
use super::peer::{Little, Peer, domain, options, policies, take, until, write};

pub const TESTS: &[Test] = &[
    ("a_node_provides_definitions_that_are_not_available_locally", || {
        answered(ServiceMapping::Enhanced)
    }),
    ("a_node_that_needs_a_header_gets_one", || answered(ServiceMapping::Cyclone)),
    ("a_long_answer_passes_the_filter_without_a_large_subscription", long),
    ("a_node_that_refuses_is_queried_at_most_three_times", refused),
    ("an_answer_with_another_hash_than_announced_is_rejected", wrong_hash),
    ("a_type_without_a_hash_is_not_queried", no_hash),
    ("a_node_without_the_service_gets_no_further_query", no_service),
    ("a_definition_at_hand_of_another_layout_gives_way_to_that_of_the_node", stale),
    ("a_type_without_a_writer_is_queried_once_it_has_one", late_writer),
];

/// Computed with Python's `json` and `hashlib`.
const WHEEL: &str = "RIHS01_e02cfbfb2ca59b49ca956f751f81f5f9dc3ec4867dbfe44f53a662fd24cbacff";
const TYRE: &str = "RIHS01_809c10637226ef205824b02220c1a10979ffd2fc7ea39c73dda560cc539ea50f";

#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
struct Request {
    type_name: String,
    type_hash: String,
    include_type_sources: bool,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct Response {
    successful: bool,
    failure_reason: String,
    root: TypeDescription,
    referenced: Vec<TypeDescription>,
    /// Type, encoding, text.
    sources: Vec<(String, String, String)>,
    extra: Vec<(String, String)>,
}

#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct TypeDescription {
    name: String,
    fields: Vec<FieldDescription>,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct FieldDescription {
    name: String,
    kind: u8,
    capacity: u64,
    text_capacity: u64,
    nested: String,
    default: String,
}

impl Message for Request {}
impl Message for Response {}

fn described(name: &str, fields: &[(&str, u8, &str)]) -> TypeDescription {
    let field = |(name, kind, nested): &(&str, u8, &str)| FieldDescription {
        name: (*name).to_owned(),
        kind: *kind,
        capacity: 0,
        text_capacity: 0,
        nested: (*nested).to_owned(),
        default: String::new(),
    };
    TypeDescription {
        name: format!("car_msgs/msg/{name}"),
        fields: fields.iter().map(field).collect(),
    }
}

fn source(name: &str, text: &str) -> (String, String, String) {
    (format!("car_msgs/msg/{name}"), "msg".to_owned(), text.to_owned())
}

fn request(type_name: &str, type_hash: &str) -> Request {
    let (type_name, type_hash) = (type_name.to_owned(), type_hash.to_owned());
    Request { type_name, type_hash, include_type_sources: true }
}

/// The correct answer of a node.
fn honest(request: &Request) -> Response {
    let tyre = described("Tyre", &[("bar", 11, "")]);
    let tyre_source = source("Tyre", "float64 bar\n");
    match request.type_name.as_str() {
        "car_msgs/msg/Tyre" => Response {
            successful: true,
            root: tyre,
            sources: vec![tyre_source],
            ..Response::default()
        },
        "car_msgs/msg/Wheel" => Response {
            successful: true,
            root: described("Wheel", &[("tyre", 1, "car_msgs/msg/Tyre"), ("bolts", 151, "")]),
            referenced: vec![tyre],
            sources: vec![
                source("Wheel", "# One of four.\nTyre tyre\nuint32[] bolts\n"),
                tyre_source,
            ],
            ..Response::default()
        },
        _ => Response { failure_reason: "unknown type".to_owned(), ..Response::default() },
    }
}

type Respond = fn(&Request) -> Response;

/// A node of ros2-client that writes `/wheel` and `/tyre`.
struct Car {
    participant: DomainParticipant,
    _node: Node,
    writers: [GUID; 2],
    requests: Arc<Mutex<Vec<Request>>>,
    stop: Arc<AtomicBool>,
    serving: Option<JoinHandle<()>>,
}

impl Car {
    fn join(domain: u16, service: Option<(ServiceMapping, Respond)>) -> Self {
        let participant = DomainParticipant::new(domain).unwrap();
        let context = Context::from_domain_participant(participant.clone()).unwrap();
        let name = NodeName::new("/front", "car").unwrap();
        let mut node = context
            .new_node(name, NodeOptions::new().enable_rosout(false).start_parameter_services(false))
            .unwrap();
        let qos = QosProfile::publisher_default()
            .reliability_reliable(WhenFull::DEFAULT)
            .durability(Durability::Volatile)
            .history(History::KeepLast { depth: 10 });
        let (requests, stop) =
            (Arc::<Mutex<Vec<Request>>>::default(), Arc::<AtomicBool>::default());
        let serving = service.map(|(mapping, respond)| {
            let name = Name::new("/front/car", "get_type_description").unwrap();
            let ty = ServiceTypeName::new("type_description_interfaces", "GetTypeDescription");
            let server = node
                .create_server::<Request, Response>(mapping, &name, &ty, qos.clone(), qos.clone())
                .unwrap();
            let (requests, stop) = (requests.clone(), stop.clone());
            thread::spawn(move || serve(&server, respond, &requests, &stop))
        });
        // Last, so that the announcements that follow in discovery are sent by the test.
        let writers = ["Wheel", "Tyre"].map(|ty| {
            let topic = Name::new("/", &ty.to_lowercase()).unwrap();
            let topic =
                node.create_topic(&topic, MessageTypeName::new("car_msgs", ty), &qos).unwrap();
            let publisher = node.create_publisher::<String>(&topic, None).unwrap();
            let guid = publisher.guid();
            // It lives as long as the process.
            std::mem::forget(publisher);
            guid
        });
        Self { participant, _node: node, writers, requests, stop, serving }
    }

    /// Announces the writers again with the hashes of their types, for which RustDDS has no
    /// interface.
    fn announce_hashes(&self, dds: &Dds, domain: u16) {
        wait_for_both(dds);
        // Sequence numbers that were used are ignored. The last announcement is processed last.
        let announcements = (1..60).map(|seq| {
            let (guid, topic, ty, hash) = match seq {
                50.. => (GUID::default(), "rt/mark", "car_msgs::msg::dds_::Mark_", WHEEL),
                _ if seq % 2 == 0 => {
                    (self.writers[0], "rt/wheel", "car_msgs::msg::dds_::Wheel_", WHEEL)
                }
                _ => (self.writers[1], "rt/tyre", "car_msgs::msg::dds_::Tyre_", TYRE),
            };
            let prefix = self.writers[0].to_bytes();
            let guid = if guid == GUID::default() {
                [&prefix[..12], &[9, 9, 9, 3]].concat()
            } else {
                guid.to_bytes().to_vec()
            };
            let guid = GUID::from_bytes(guid.try_into().unwrap());
            announcement(guid, seq, topic, ty, hash)
        });
        announce(domain, announcements);
        until("the hashes", || dds.discovered().iter().any(|topic| topic.topic == "/mark"));
    }
}

impl Drop for Car {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(serving) = self.serving.take() {
            serving.join().unwrap();
        }
    }
}

fn serve(
    server: &Server<Request, Response>,
    respond: Respond,
    requests: &Mutex<Vec<Request>>,
    stop: &AtomicBool,
) {
    while !stop.load(Ordering::Relaxed) {
        match server.receive_request() {
            Ok(Some((id, request))) => {
                let response = respond(&request);
                requests.lock().unwrap().push(request);
                server.send_response(id, response).unwrap();
            }
            // Errors include requests that are not for this mapping.
            Ok(None) | Err(_) => thread::sleep(Duration::from_millis(2)),
        }
    }
}

/// Sends announcements to the first participant of a domain.
pub fn announce(domain: u16, announcements: impl Iterator<Item = Vec<u8>>) {
    let wire = UdpSocket::bind("127.0.0.1:0").unwrap();
    for announcement in announcements {
        wire.send_to(&announcement, ("127.0.0.1", 7400 + 250 * domain + 10)).unwrap();
    }
}

/// The announcement of a writer or a reader: DATA of the built-in writer for these.
pub fn announcement(endpoint: GUID, seq: u32, topic: &str, ty: &str, hash: &str) -> Vec<u8> {
    let text = |text: &str| {
        let mut value = (text.len() as u32 + 1).to_le_bytes().to_vec();
        value.extend_from_slice(text.as_bytes());
        value.resize((value.len() + 1).next_multiple_of(4), 0);
        value
    };
    let user_data = format!("typehash={hash};");
    let mut octets = (user_data.len() as u32).to_le_bytes().to_vec();
    octets.extend_from_slice(user_data.as_bytes());
    octets.resize(octets.len().next_multiple_of(4), 0);
    let reliable = [2, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0].to_vec();
    let kind = if endpoint.entity_id.kind().is_reader() { 4 } else { 3 };
    let mut body = vec![0, 0, 16, 0, 0, 0, kind, 0xc7, 0, 0, kind, 0xc2, 0, 0, 0, 0];
    body.extend_from_slice(&seq.to_le_bytes());
    // Encapsulation: a list of parameters, little-endian.
    body.extend_from_slice(&[0, 3, 0, 0]);
    for (id, value) in [
        (0x5a_u16, endpoint.to_bytes().to_vec()),
        (5, text(topic)),
        (7, text(ty)),
        (0x1a, reliable),
        (0x2c, octets),
    ] {
        body.extend_from_slice(&id.to_le_bytes());
        body.extend_from_slice(&(value.len() as u16).to_le_bytes());
        body.extend_from_slice(&value);
    }
    body.extend_from_slice(&[1, 0, 0, 0]);
    super::hostile::packet(endpoint, 0x15, &body)
}

fn wait_for_both(dds: &Dds) {
    // A node writes a topic of its own accord, too.
    let found = |name: &str| dds.discovered().iter().any(|topic| topic.topic == name);
    until("both topics", || found("/wheel") && found("/tyre"));
}

/// Searches the definitions of `/wheel` or `/tyre`.
fn may_come(dds: &Dds, topic: &str) -> bool {
    let type_name = if topic == "/wheel" { "car_msgs/msg/Wheel" } else { "car_msgs/msg/Tyre" };
    dds.search_definitions(type_name) != DefinitionsSearch::Ended
}

/// Waits as a recorder does: until there are definitions, or none will come.
fn wait(dds: &Dds, topic: &str) -> bool {
    until("the end of the query", || dds.definitions(topic).is_ok() || !may_come(dds, topic));
    let found = dds.definitions(topic);
    assert!(matches!(found, Ok(_) | Err(TransportError::NoDefinitions { .. })), "{found:?}");
    found.is_ok()
}

fn text(dds: &Dds, topic: &str) -> Option<String> {
    let topics = dds.topics();
    let found = topics.iter().find(|found| found.topic == topic).unwrap();
    found.definitions_text.as_deref().map(str::to_owned)
}

fn open() -> (u16, Dds) {
    let domain = domain();
    (domain, Dds::open(DdsOptions { largest: 0, ..options(domain) }).unwrap())
}

fn answered(mapping: ServiceMapping) {
    let (domain, dds) = open();
    let car = Car::join(domain, Some((mapping, honest)));
    car.announce_hashes(&dds, domain);
    assert_eq!(text(&dds, "/wheel"), None);
    // One after the other, in any order.
    assert!(may_come(&dds, "/wheel") && may_come(&dds, "/tyre"));
    assert!(wait(&dds, "/tyre") && wait(&dds, "/wheel"));
    let definitions = dds.definitions("/wheel").unwrap();
    assert!(FieldPath::compile(&definitions, "tyre.bar").is_ok());
    assert!(text(&dds, "/wheel").unwrap().starts_with("# One of four.\n"));
    // On a slow machine there may be repeated requests.
    let mut requests = car.requests.lock().unwrap().clone();
    requests.sort_by(|a, b| b.type_name.cmp(&a.type_name));
    requests.dedup();
    let expected = [request("car_msgs/msg/Wheel", WHEEL), request("car_msgs/msg/Tyre", TYRE)];
    assert_eq!(requests, expected);
}

/// With plain RustDDS, and with a header: see `docs/dds-limits.md` on the case without.
fn long() {
    const TEXT: usize = 400_000;
    let (domain, dds) = open();
    let car = Car::join(domain, None);
    let peer = Peer(car.participant.clone());
    let policies = policies(true, false);
    let service = |name: &str, part: &str| {
        let ty = format!("type_description_interfaces::srv::dds_::GetTypeDescription_{part}_");
        (format!("{name}/front/car/get_type_description"), ty)
    };
    let (name, ty) = service("rq", "Request");
    let requests = peer.reader(&format!("{name}Request"), &ty, &policies);
    let (name, ty) = service("rr", "Response");
    let replies = peer.writer_of::<Little>(&format!("{name}Reply"), &ty, &policies);
    let _ready = peer.writer("/ready", true, false);
    until("the service", || dds.discovered().iter().any(|topic| topic.topic == "/ready"));
    car.announce_hashes(&dds, domain);

    let mut answer = honest(&request("car_msgs/msg/Wheel", WHEEL));
    answer.sources[0].2 += &"# A long story.\n".repeat(TEXT / 16);
    let answer = CDRSerializerAdapter::<Response>::to_bytes(&answer).unwrap();
    until("the end of the query", || {
        // With a header there is a number before the length of the name.
        if let Some(request) = take(&requests).filter(|request| request[4..8] != *b"car_") {
            let padding = vec![0; answer.len().next_multiple_of(4) - answer.len()];
            write(&replies, &[&request[..16], &answer, &padding].concat());
        }
        dds.definitions("/wheel").is_ok() || !may_come(&dds, "/wheel")
    });
    assert!(dds.definitions("/wheel").is_ok(), "{:?}", dds.health());
    assert!(text(&dds, "/wheel").unwrap().len() > TEXT);
}

fn refused() {
    let (domain, dds) = open();
    let respond: Respond =
        |_| Response { failure_reason: "not today".to_owned(), ..Response::default() };
    let car = Car::join(domain, Some((ServiceMapping::Enhanced, respond)));
    car.announce_hashes(&dds, domain);
    assert!(!wait(&dds, "/wheel"));
    // On a slow machine, a node that answers late may be queried with the other mapping, which it
    // does not support.
    assert!((1..=3).contains(&car.requests.lock().unwrap().len()), "{:?}", car.requests);
    assert!(!may_come(&dds, "/wheel"), "no further query");
}

fn wrong_hash() {
    let (domain, dds) = open();
    let respond: Respond = |request| {
        let mut response = honest(request);
        response.root.fields.pop();
        response
    };
    let car = Car::join(domain, Some((ServiceMapping::Enhanced, respond)));
    car.announce_hashes(&dds, domain);
    assert!(!wait(&dds, "/wheel"));
    assert!(!car.requests.lock().unwrap().is_empty());
}

fn no_hash() {
    let (domain, dds) = open();
    let car = Car::join(domain, Some((ServiceMapping::Enhanced, honest)));
    wait_for_both(&dds);
    assert!(!wait(&dds, "/wheel"));
    assert!(car.requests.lock().unwrap().is_empty());
}

fn no_service() {
    let (domain, dds) = open();
    let car = Car::join(domain, None);
    car.announce_hashes(&dds, domain);
    assert!(!wait(&dds, "/wheel"));
}

fn stale() {
    let folder = std::env::temp_dir().join(format!("gleaner-stale-{}", std::process::id()));
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("Tyre.msg"), "float64 bar\nfloat64 temperature\n").unwrap();
    let answers: [Respond; 2] = [honest, |_| Response::default()];
    for (respond, of_node) in answers.into_iter().zip([Some("float64 bar\n"), None]) {
        let domain = domain();
        let messages = vec![folder.clone()];
        let dds = Dds::open(DdsOptions { largest: 0, messages, ..options(domain) }).unwrap();
        let car = Car::join(domain, Some((ServiceMapping::Enhanced, respond)));
        wait_for_both(&dds);
        let at_hand = text(&dds, "/tyre").expect("no hash is announced");
        assert!(at_hand.ends_with("temperature\n"), "{at_hand}");
        car.announce_hashes(&dds, domain);
        assert_eq!((text(&dds, "/tyre"), dds.type_hash("/tyre").as_deref()), (None, Some(TYRE)));
        assert_eq!(wait(&dds, "/tyre"), of_node.is_some());
        assert_eq!(text(&dds, "/tyre").as_deref(), of_node);
    }
    std::fs::remove_dir_all(&folder).unwrap();
}

fn late_writer() {
    let (domain, mut dds) = open();
    let spec = gleaner_messages::transport::TopicSpec {
        type_name: "car_msgs/msg/Wheel".to_owned(),
        ..super::peer::spec("/wheel", gleaner_messages::transport::Qos::Auto)
    };
    dds.subscribe(&spec, super::peer::KeptSamples::new()).unwrap();
    for _ in 0..5 {
        assert!(!wait(&dds, "/wheel"));
    }
    let car = Car::join(domain, Some((ServiceMapping::Enhanced, honest)));
    car.announce_hashes(&dds, domain);
    until("the definitions", || {
        may_come(&dds, "/wheel");
        dds.definitions("/wheel").is_ok()
    });
}

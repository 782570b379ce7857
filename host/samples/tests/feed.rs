//! A feed and an ingress that this test plays, in one process, over real shared memory.

use std::error::Error;
use std::fs::File;
use std::io::Write;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::thread;
use std::time::Duration;

use gleaner_base::Explain;
use gleaner_buffers::shared::{
    HAZARDS, META_WORDS, Notifier, PinLimits, SharedLayout, SharedWriter, WriterMemory,
};
use gleaner_protocol::ingress::{
    AttachedTopic, Health, PinGrant, ReaderLink, ReaderMessage, ReaderRequest, RefusedTopic,
    RegionLayout, SourceStatus,
};
use gleaner_protocol::link::Incoming;
use gleaner_samples::regions::{ControlRegion, KernelFutex, TopicRegion};
use gleaner_samples::{Feed, FeedError, FeedEvent, SharedTopicReader};
use gleaner_test_support::random::XorShift64;
use rustix::fs::{MemfdFlags, SealFlags, fcntl_add_seals, memfd_create};

/// Longer than any test takes.
const TIMEOUT: Duration = Duration::from_secs(60);

const LAYOUT: SharedLayout = SharedLayout { depth: 4, slots: 16, slot_bytes: 64 };
const HOLDS: PinGrant = PinGrant { windows: 1, window: 4, singles: 2 };
/// Words of `HOLDS`.
const WORDS: u32 = 3;

struct FakeIngress {
    link: ReaderLink,
    control: ControlRegion,
}

fn connected() -> (FakeIngress, Feed) {
    let (ingress_end, reader_end) = UnixStream::pair().unwrap();
    let mut link = ReaderLink::new(ingress_end.into());
    let (control, page) = ControlRegion::create().unwrap();
    link.send(&ReaderMessage::Welcome, Some(page.as_fd())).unwrap();
    (FakeIngress { link, control }, Feed::connect(reader_end.into()).unwrap())
}

fn info(id: u32, first_word: u32) -> AttachedTopic {
    let SharedLayout { depth, slots, slot_bytes } = LAYOUT;
    AttachedTopic {
        id,
        type_name: "sensor_msgs/msg/Imu".to_owned(),
        layout: RegionLayout { depth, slots, slot_bytes },
        first_word,
        holds: HOLDS,
        ..AttachedTopic::default()
    }
}

impl FakeIngress {
    fn send(&mut self, message: &ReaderMessage, file: Option<BorrowedFd<'_>>) {
        self.link.send(message, file).unwrap();
    }

    fn attach(&mut self, id: u32, first_word: u32) -> SharedWriter {
        let (region, file) = region();
        let mut writer = SharedWriter::new(WriterMemory::new(region, LAYOUT).unwrap());
        let PinGrant { windows, window, singles } = HOLDS;
        let limits = PinLimits { first_word, windows, window, singles };
        writer.attach(self.control.clone(), limits).unwrap();
        self.send(&ReaderMessage::Attached(Box::new(info(id, first_word))), Some(file.as_fd()));
        writer
    }

    fn request(&mut self) -> ReaderRequest {
        loop {
            match self.link.poll().unwrap() {
                Incoming::Message(request) => return request,
                Incoming::Nothing => thread::yield_now(),
                Incoming::Ended => panic!("the reader has ended"),
            }
        }
    }
}

fn region() -> (TopicRegion, OwnedFd) {
    let bytes = LAYOUT.bytes_needed().unwrap();
    let (region, file) = TopicRegion::create("test", bytes, bytes).unwrap();
    (region, file.into())
}

fn publish(writer: &mut SharedWriter, value: u8) {
    writer.draft(8).unwrap().fill(value);
    writer.publish(&[value.into(); META_WORDS]).unwrap();
}

fn newest(topic: &SharedTopicReader) -> Option<Vec<u8>> {
    topic.reader.newest_before(u64::MAX).unwrap().map(|sample| sample.to_vec())
}

#[test]
fn a_reader_waits_for_its_topics_in_any_order_and_reads_them_in_place() {
    let (mut ingress, mut feed) = connected();
    let mut camera = ingress.attach(5, 0);
    let mut imu = ingress.attach(2, WORDS);
    let imu_topic = feed.topic(2, TIMEOUT).unwrap();
    let camera_topic = feed.topic(5, TIMEOUT).unwrap();
    assert_eq!((imu_topic.info, newest(&camera_topic)), (info(2, WORDS), None));
    publish(&mut imu, 1);
    let held = imu_topic.reader.get(0).unwrap().unwrap();
    for value in 2..40 {
        publish(&mut imu, value);
    }
    publish(&mut camera, 9);
    assert_eq!((&*held, held.meta()), ([1; 8].as_slice(), &[1; META_WORDS]), "it is held");
    assert_eq!(imu_topic.reader.newest_before(u64::MAX).unwrap().unwrap().position(), 38);
    assert_eq!(newest(&camera_topic), Some(vec![9; 8]));
    assert!(feed.poll().unwrap().is_empty());
}

#[test]
fn events_come_in_order_and_the_newest_status_counts() {
    let (mut ingress, mut feed) = connected();
    assert_eq!(feed.status(), &SourceStatus::default());
    ingress.attach(1, 0);
    let refused = RefusedTopic::WrongType { found: "std_msgs/msg/String".to_owned() };
    ingress.send(&ReaderMessage::Refused { id: 2, reason: refused.clone() }, None);
    for dead in ["old", "new"] {
        let health = Health { dead: Some(dead.to_owned()), ..Health::default() };
        let status = SourceStatus { health, ..SourceStatus::default() };
        ingress.send(&ReaderMessage::Status(Box::new(status)), None);
    }
    ingress.send(&ReaderMessage::Definitions { id: 1, text: Some("x".to_owned()) }, None);
    drop(ingress);
    let events = feed.poll().unwrap();
    let [
        FeedEvent::Attached(topic),
        FeedEvent::Refused { id: 2, reason },
        FeedEvent::Definitions { id: 1, text: Some(_) },
    ] = events.as_slice()
    else {
        panic!("{events:?}")
    };
    assert_eq!((topic.info.id, reason), (1, &refused));
    assert_eq!(feed.status().health.dead.as_deref(), Some("new"));
    assert!(matches!(feed.poll(), Err(FeedError::Gone)), "after its last messages");
}

#[test]
fn a_refusal_has_its_causes_and_help() {
    let (mut ingress, mut feed) = connected();
    let mut refused = |reason: RefusedTopic| {
        ingress.send(&ReaderMessage::Refused { id: 3, reason }, None);
        feed.topic(3, TIMEOUT).unwrap_err()
    };
    let lines = ["cannot subscribe", "no memory", "the system refuses it"];
    let error = refused(RefusedTopic::Other(lines.map(str::to_owned).to_vec()));
    let cause = error.source().unwrap();
    assert_eq!(
        [error.to_string(), cause.to_string(), cause.source().unwrap().to_string()],
        lines.map(str::to_owned)
    );
    let (known, nearest) = (vec!["/imu".to_owned()], Some("/imu".to_owned()));
    let error = refused(RefusedTopic::NoSuchTopic { known, nearest });
    assert_eq!(error.to_string(), "the source has no such topic");
    assert_eq!(error.help().unwrap(), "the most similar topic is `/imu`");
}

#[test]
fn a_ring_ends_the_wait_of_the_reader() {
    let (mut ingress, mut feed) = connected();
    let mut writer = ingress.attach(0, 0);
    let topic = feed.topic(0, TIMEOUT).unwrap();
    let (mut bell, other) = (feed.bell(), feed.bell().clone());
    let reader = thread::spawn(move || {
        for position in 0..100 {
            loop {
                let seen = bell.value();
                if topic.reader.get(position).unwrap().is_some() {
                    break;
                }
                bell.wait(seen, TIMEOUT);
            }
            other.ring();
        }
    });
    let (rings, answers) = (Notifier::of(ingress.control.clone()), feed.bell());
    for value in 0..100 {
        let seen = answers.value();
        publish(&mut writer, value);
        rings.ring(&KernelFutex);
        // Two rings follow: this one and the answer of the other thread.
        while answers.value().wrapping_sub(seen) < 2 {
            thread::yield_now();
        }
    }
    reader.join().unwrap();
}

#[test]
fn definitions_are_requested_and_messages_published_over_the_socket() {
    let (mut ingress, mut feed) = connected();
    ingress.send(&ReaderMessage::Definitions { id: 8, text: None }, None);
    let answering = thread::spawn(move || {
        let request = ingress.request();
        let text = Some("float64 x".to_owned());
        ingress.send(&ReaderMessage::Definitions { id: 7, text }, None);
        (request, ingress)
    });
    assert_eq!(feed.definitions(7, TIMEOUT).unwrap().as_deref(), Some("float64 x"));
    let (request, mut ingress) = answering.join().unwrap();
    assert_eq!(request, ReaderRequest::NeedDefinitions { id: 7 });
    assert!(matches!(
        feed.poll().unwrap().as_slice(),
        [FeedEvent::Definitions { id: 8, text: None }]
    ));
    let publisher = feed.publisher(3);
    publisher.publish(b"cdr").unwrap();
    assert_eq!(ingress.request(), ReaderRequest::Publish { index: 3, cdr: b"cdr".to_vec() });
    // The connection lives as long as the publisher.
    drop(feed);
    publisher.publish(b"later").unwrap();
    assert_eq!(ingress.request(), ReaderRequest::Publish { index: 3, cdr: b"later".to_vec() });
    drop(publisher);
    assert_eq!(ingress.link.poll().unwrap(), Incoming::Ended);
}

#[test]
fn held_samples_stay_valid_after_the_ingress_has_ended() {
    let (mut ingress, mut feed) = connected();
    let mut writer = ingress.attach(0, 0);
    let topic = feed.topic(0, TIMEOUT).unwrap();
    let publisher = feed.publisher(0);
    publish(&mut writer, 6);
    let held = topic.reader.get(0).unwrap().unwrap();
    drop((ingress, writer));
    assert!(matches!(feed.poll(), Err(FeedError::Gone)));
    assert!(matches!(feed.poll(), Err(FeedError::Gone)), "each time");
    assert!(matches!(feed.topic(1, TIMEOUT), Err(FeedError::Gone)));
    assert!(matches!(feed.definitions(1, TIMEOUT), Err(FeedError::Gone)));
    assert!(publisher.publish(b"x").is_err());
    drop(feed);
    assert_eq!((&*held, newest(&topic)), ([6; 8].as_slice(), Some(vec![6; 8])));
}

#[test]
fn a_topic_that_does_not_match_its_memory_is_an_error() {
    let refusal = |change: fn(&mut AttachedTopic), file: Option<BorrowedFd<'_>>| {
        let (mut ingress, mut feed) = connected();
        let mut writer = ingress.attach(1, 0);
        let healthy = feed.topic(1, TIMEOUT).unwrap();
        let (_region, own) = region();
        let mut info = info(2, WORDS);
        change(&mut info);
        let file = file.unwrap_or(own.as_fd());
        ingress.send(&ReaderMessage::Attached(Box::new(info)), Some(file));
        let error = feed.topic(2, TIMEOUT).unwrap_err();
        assert!(matches!(feed.poll(), Err(FeedError::Gone)), "nothing more is read");
        publish(&mut writer, 7);
        assert_eq!(newest(&healthy), Some(vec![7; 8]), "other topics stay valid");
        let FeedError::Malformed { reason } = error else { panic!("{error}") };
        reason
    };
    let size = "topic 2: the memory of the topic has another size";
    let words = "topic 2: its words on the control page are not its own";
    assert_eq!(refusal(|info| info.layout.slots = 1 << 30, None), size);
    assert_eq!(refusal(|info| info.layout.slot_bytes = 1 << 20, None), size);
    assert_eq!(refusal(|info| info.layout.depth = 0, None), "topic 2: its sizes are impossible");
    assert_eq!(refusal(|info| info.layout.depth = 16, None), "topic 2: its sizes are impossible");
    let expected = "topic 2: its first position is impossible";
    assert_eq!(refusal(|info| info.first = u64::MAX, None), expected);
    assert_eq!(refusal(|info| info.first_word = WORDS - 1, None), words, "one is of topic 1");
    assert_eq!(refusal(|info| info.first_word = HAZARDS as u32 - 1, None), words);
    assert_eq!(refusal(|info| info.first_word = u32::MAX, None), words);
    assert_eq!(
        refusal(|info| info.holds = PinGrant { windows: 0, window: 0, singles: 0 }, None),
        words
    );
    let unsealed = File::from(memfd_create("test", MemfdFlags::ALLOW_SEALING).unwrap());
    unsealed.set_len(LAYOUT.bytes_needed().unwrap() as u64).unwrap();
    let expected = "topic 2: the memory of the topic is not sealed";
    assert_eq!(refusal(|_| {}, Some(unsealed.as_fd())), expected);
    let device = File::open("/dev/null").unwrap();
    assert_eq!(refusal(|_| {}, Some(device.as_fd())), size);
}

#[test]
fn a_connection_that_is_not_opened_or_opened_twice_is_an_error() {
    let connect = |message: &ReaderMessage, file: Option<BorrowedFd<'_>>| {
        let (ingress_end, reader_end) = UnixStream::pair().unwrap();
        ReaderLink::new(ingress_end.into()).send(message, file).unwrap();
        Feed::connect(reader_end.into()).err().unwrap()
    };
    let early = connect(&ReaderMessage::Definitions { id: 1, text: None }, None);
    assert!(matches!(early, FeedError::Malformed { .. }), "{early}");
    let no_page = File::open("/dev/null").unwrap();
    let error = connect(&ReaderMessage::Welcome, Some(no_page.as_fd()));
    assert!(matches!(error, FeedError::Control { .. }), "{error}");
    let error = connect(&ReaderMessage::Welcome, None);
    assert!(matches!(error, FeedError::Socket { .. }), "{error}");

    let (mut ingress, mut feed) = connected();
    let (_control, page) = ControlRegion::create().unwrap();
    ingress.send(&ReaderMessage::Welcome, Some(page.as_fd()));
    assert!(matches!(feed.poll(), Err(FeedError::Malformed { .. })));
}

#[test]
fn random_memory_of_a_topic_never_crashes_its_reader() {
    let mut random = XorShift64(0x2545_f491_4f6c_dd1d);
    for round in 0..100 {
        let flags = MemfdFlags::ALLOW_SEALING | MemfdFlags::CLOEXEC;
        let mut file = File::from(memfd_create("test", flags).unwrap());
        // Small numbers, so that some places name positions and slots that exist.
        let bits = [8, 16, 48, 64][round % 4];
        let words = LAYOUT.bytes_needed().unwrap() / 8;
        let bytes: Vec<u8> =
            (0..words).flat_map(|_| (random.number() >> (64 - bits)).to_le_bytes()).collect();
        file.write_all(&bytes).unwrap();
        let seals = SealFlags::SHRINK | SealFlags::GROW | SealFlags::FUTURE_WRITE | SealFlags::SEAL;
        fcntl_add_seals(&file, seals).unwrap();
        let (mut ingress, mut feed) = connected();
        ingress.send(&ReaderMessage::Attached(Box::new(info(1, 0))), Some(file.as_fd()));
        let topic = feed.topic(1, TIMEOUT).unwrap();
        let head = topic.reader.head();
        for position in [0, 1, head, head.wrapping_sub(1), u64::MAX].into_iter().chain(0..300) {
            let _ = topic.reader.get(position).map(|found| found.map(|held| held.to_vec()));
            let _ = topic.reader.window(position, 4).map(drop);
            let _ = topic.reader.last_before(position, u32::MAX).map(drop);
        }
        topic.reader.counters();
    }
}

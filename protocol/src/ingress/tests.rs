//! Tests of the ingress's connections: valid exchanges, invalid frames, and peers that end, do not
//! read, or pass descriptors that are not expected.

use std::io::{IoSlice, Read, Write};
use std::mem::MaybeUninit;
use std::os::fd::{AsFd, BorrowedFd, OwnedFd};
use std::os::unix::net::UnixStream;

use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};

use super::*;
use crate::link::frame::{self, tag};
use crate::link::{Incoming, LinkError};

fn grant(id: u32) -> TopicGrant {
    TopicGrant {
        id,
        topic: format!("/topic_{id}"),
        type_name: Some("sensor_msgs/msg/Imu".to_owned()),
        qos: Qos::Fixed { reliable: true, transient_local: false, depth: 3 },
        queue: 10,
        max_bytes: Some(4096),
        depth: 20,
        holds: PinGrant { windows: 1, window: 20, singles: 3 },
        wakes: id == 0,
        ..TopicGrant::default()
    }
}

fn reader(name: &str, topics: u32) -> AddReader {
    let publish = PublishGrant {
        topic: "/out".to_owned(),
        type_name: "std_msgs/msg/String".to_owned(),
        depth: 5,
        max_bytes: 100,
    };
    let topics = (0..topics).map(grant).collect();
    AddReader { name: name.to_owned(), topics, publishes: vec![publish] }
}

fn send_with(to: &UnixStream, bytes: &[u8], descriptors: &[BorrowedFd<'_>]) {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(8))];
    let mut ancillary = SendAncillaryBuffer::new(&mut space);
    assert!(ancillary.push(SendAncillaryMessage::ScmRights(descriptors)));
    sendmsg(to, &[IoSlice::new(bytes)], &mut ancillary, SendFlags::NOSIGNAL).unwrap();
}

/// Returns a descriptor to send, and a stream that reaches its end once all copies are closed.
fn observed() -> (OwnedFd, UnixStream) {
    let (sent, observer) = UnixStream::pair().unwrap();
    (sent.into(), observer)
}

fn is_closed(mut observer: &UnixStream) -> bool {
    observer.set_nonblocking(true).unwrap();
    matches!(observer.read(&mut [0]), Ok(0))
}

struct RandomBytes(u64);

impl RandomBytes {
    fn next(&mut self, len: usize) -> Vec<u8> {
        let bytes = std::iter::repeat_with(|| {
            self.0 ^= self.0 << 13;
            self.0 ^= self.0 >> 7;
            self.0 ^= self.0 << 17;
            self.0 as u8
        });
        bytes.take(len).collect()
    }
}

const SEED: RandomBytes = RandomBytes(0x2545_f491_4f6c_dd1d);

#[test]
fn requests_of_a_starter_arrive_in_order_and_each_reader_has_its_own_socket() {
    let (mut control, ingress_end) = IngressControl::pair().unwrap();
    let mut server = IngressServer::new(ingress_end);
    assert!(matches!(server.poll(), Ok(Incoming::Nothing)));
    let ends = ["first", "second"].map(|name| control.add_reader(&reader(name, 3)).unwrap());
    let further = AddTopics { reader: "first".to_owned(), topics: vec![grant(9)] };
    control.add_topics(&further).unwrap();
    control.begin().unwrap();
    control.stop().unwrap();
    drop(control);
    for (name, reader_end) in ["first", "second"].into_iter().zip(ends) {
        let Incoming::Message(IngressRequest::AddReader(added, ingress_end)) =
            server.poll().unwrap()
        else {
            panic!()
        };
        assert_eq!(added, reader(name, 3));
        UnixStream::from(reader_end).write_all(name.as_bytes()).unwrap();
        let mut read = String::new();
        UnixStream::from(ingress_end).read_to_string(&mut read).unwrap();
        assert_eq!(read, name);
    }
    let Some(IngressRequest::AddTopics(added)) = server.receive().unwrap() else { panic!() };
    assert_eq!(added, further);
    assert!(matches!(server.receive(), Ok(Some(IngressRequest::Begin))));
    assert!(matches!(server.receive(), Ok(Some(IngressRequest::Stop))));
    assert!(matches!(server.receive(), Ok(None)), "the parent has ended");
    assert!(matches!(server.poll(), Ok(Incoming::Ended)));
}

#[test]
fn an_ingress_that_has_ended_is_an_error_not_a_signal() {
    let (mut control, ingress_end) = IngressControl::pair().unwrap();
    drop(ingress_end);
    let gone = |result: Result<(), LinkError>| {
        assert!(matches!(result, Err(LinkError::Gone { peer: "the ingress" })));
    };
    gone(control.add_reader(&reader("x", 1)).map(drop));
    gone(control.begin());
    gone(control.stop());
}

#[test]
fn a_request_that_arrives_in_pieces_is_returned_once_it_is_complete() {
    let (mut starter_end, ingress_end) = UnixStream::pair().unwrap();
    let mut server = IngressServer::new(ingress_end.into());
    let bytes = frame::encode(tag::ADD_READER, &serde_json::to_vec(&reader("x", 2)).unwrap());
    let (socket, observer) = observed();
    send_with(&starter_end, &bytes[..1], &[socket.as_fd()]);
    drop(socket);
    for byte in &bytes[1..] {
        assert!(matches!(server.poll(), Ok(Incoming::Nothing)));
        starter_end.write_all(&[*byte]).unwrap();
    }
    let request = server.poll().unwrap();
    let Incoming::Message(IngressRequest::AddReader(added, _socket)) = &request else { panic!() };
    assert_eq!(*added, reader("x", 2));
    assert!(!is_closed(&observer));
    drop(request);
    assert!(is_closed(&observer));
    starter_end.write_all(&bytes[..9]).unwrap();
    drop(starter_end);
    assert!(matches!(server.poll(), Err(LinkError::Gone { peer: "the parent" })));
}

#[test]
fn surplus_descriptors_of_a_starter_are_closed() {
    let (starter_end, ingress_end) = UnixStream::pair().unwrap();
    let mut server = IngressServer::new(ingress_end.into());
    let all: Vec<_> = (0..6).map(|_| observed()).collect();
    let descriptors: Vec<_> = all.iter().map(|(sent, _)| sent.as_fd()).collect();
    // A request without a descriptor came with two, a reader's came with four.
    send_with(&starter_end, &frame::encode(tag::BEGIN, &[]), &descriptors[..2]);
    let add = frame::encode(tag::ADD_READER, &serde_json::to_vec(&reader("x", 1)).unwrap());
    send_with(&starter_end, &add, &descriptors[2..]);
    let observers: Vec<_> = all.into_iter().map(|(_, observer)| observer).collect();
    assert!(matches!(server.receive(), Ok(Some(IngressRequest::Begin))));
    let Some(IngressRequest::AddReader(_, socket)) = server.receive().unwrap() else { panic!() };
    let open: Vec<_> = observers.iter().map(|observer| !is_closed(observer)).collect();
    assert_eq!(open, [false, false, true, false, false, false], "the reader has its own socket");
    drop(socket);
    assert!(is_closed(&observers[2]));
}

#[test]
fn an_invalid_grant_is_not_sent_and_is_refused_if_it_is() {
    let (mut control, ingress_end) = IngressControl::pair().unwrap();
    let mut server = IngressServer::new(ingress_end);
    let mut invalid = reader("x", 1);
    invalid.topics[0].depth = 0;
    let refused = control.add_reader(&invalid).unwrap_err();
    assert!(matches!(refused, LinkError::Grant { .. }), "{refused}");
    assert!(matches!(server.poll(), Ok(Incoming::Nothing)));

    let (mut starter_end, ingress_end) = UnixStream::pair().unwrap();
    let mut server = IngressServer::new(ingress_end.into());
    let add = frame::encode(tag::ADD_READER, &serde_json::to_vec(&invalid).unwrap());
    starter_end.write_all(&add).unwrap();
    starter_end.write_all(&frame::encode(tag::BEGIN, &[])).unwrap();
    let refused = server.receive().unwrap_err();
    assert!(
        matches!(&refused, LinkError::Grant { source } if source.to_string().contains("`depth`")),
        "{refused}"
    );
    assert!(
        matches!(server.receive(), Ok(Some(IngressRequest::Begin))),
        "the connection is usable"
    );

    // As if the ingress had too many open files for the socket.
    let add = serde_json::to_vec(&reader("x", 1)).unwrap();
    starter_end.write_all(&frame::encode(tag::ADD_READER, &add)).unwrap();
    starter_end.write_all(&frame::encode(tag::BEGIN, &[])).unwrap();
    let refused = server.receive().unwrap_err();
    assert!(matches!(&refused, LinkError::NoSocket { reader } if reader == "x"), "{refused}");
    assert!(matches!(server.receive(), Ok(Some(IngressRequest::Begin))));
}

#[test]
fn invalid_frames_of_a_starter_are_refused_by_name() {
    let refusal = |bytes: &[u8]| {
        let (mut starter_end, ingress_end) = UnixStream::pair().unwrap();
        starter_end.write_all(bytes).unwrap();
        drop(starter_end);
        IngressServer::new(ingress_end.into()).poll().unwrap_err().to_string()
    };
    let add = serde_json::to_vec(&reader("x", 1)).unwrap();
    assert_eq!(
        refusal(&frame::encode(tag::ADD_READER, &add)),
        "cannot serve reader `x`: its socket did not arrive"
    );
    assert!(
        refusal(&frame::encode(tag::ADD_TOPICS, b"[]"))
            .starts_with("frame `add topics` from the parent is invalid")
    );
    assert_eq!(refusal(&frame::encode(tag::PUBLISH, &[])), "frame 65 from the parent is unknown");
    let too_long = [&u32::MAX.to_le_bytes()[..], &[tag::ADD_READER]].concat();
    assert!(refusal(&too_long).contains("has 4294967295 bytes, above the maximum of 2097152"));
    let many = AddTopics { reader: "x".to_owned(), topics: (0..2000).map(grant).collect() };
    let (mut control, _ingress_end) = IngressControl::pair().unwrap();
    assert!(matches!(control.add_topics(&many), Err(LinkError::Grant { .. })));
}

fn connected() -> (ReaderLink, IngressLink, IngressRequests) {
    let (ingress_end, reader_end) = UnixStream::pair().unwrap();
    let (link, requests) = IngressLink::new(reader_end.into());
    (ReaderLink::new(ingress_end.into()), link, requests)
}

fn attached(definitions: usize) -> ReaderMessage {
    ReaderMessage::Attached(Box::new(AttachedTopic {
        id: 7,
        type_name: "sensor_msgs/msg/Imu".to_owned(),
        layout: RegionLayout { depth: 4, slots: 9, slot_bytes: 4096 },
        first_word: 3,
        holds: PinGrant { windows: 1, window: 4, singles: 2 },
        first: 12,
        digests: 3,
        refused: 4,
        definitions: Some("x".repeat(definitions)),
        ..AttachedTopic::default()
    }))
}

fn status(received: u64) -> ReaderMessage {
    let reception = ReceptionStatus { malformed: received, ..ReceptionStatus::default() };
    ReaderMessage::Status(Box::new(SourceStatus {
        health: Health::default(),
        topics: vec![(7, reception)],
        unsent: 5,
    }))
}

#[test]
fn messages_arrive_with_their_descriptors() {
    let (mut link, mut ingress, _requests) = connected();
    assert!(matches!(ingress.poll(), Ok(Incoming::Nothing)));
    let refused = ReaderMessage::Refused { id: 3, reason: RefusedTopic::Other(vec!["x".into()]) };
    let sent = [
        (ReaderMessage::Welcome, Some(observed())),
        (attached(3), Some(observed())),
        (refused, None),
        (ReaderMessage::Definitions { id: 7, text: None }, None),
        (status(1), None),
    ];
    for (message, descriptor) in &sent {
        link.send(message, descriptor.as_ref().map(|(fd, _)| fd.as_fd())).unwrap();
    }
    for (message, descriptor) in sent {
        let Incoming::Message(mut delivery) = ingress.poll().unwrap() else { panic!() };
        assert_eq!(delivery.message, message);
        assert_eq!(delivery.descriptor.is_some(), descriptor.is_some());
        if let (Some((own, mut observer)), Some(received)) =
            (descriptor, delivery.descriptor.take())
        {
            drop(own);
            UnixStream::from(received).write_all(b"here").unwrap();
            let mut read = String::new();
            observer.read_to_string(&mut read).unwrap();
            assert_eq!(read, "here");
        }
    }
    drop(link);
    assert!(matches!(ingress.poll(), Ok(Incoming::Ended)));
}

#[test]
fn messages_of_an_erroneous_ingress_are_refused_or_keep_no_descriptor() {
    let json =
        |message: &ReaderMessage| frame::encode(tag::READER, &serde_json::to_vec(message).unwrap());
    let refusal = |bytes: &[u8]| {
        let (mut ingress_end, reader_end) = UnixStream::pair().unwrap();
        ingress_end.write_all(bytes).unwrap();
        IngressLink::new(reader_end.into()).0.poll().unwrap_err().to_string()
    };
    for message in [ReaderMessage::Welcome, attached(1)] {
        assert_eq!(refusal(&json(&message)), "frame `message` came without its descriptor");
    }
    assert_eq!(refusal(&frame::encode(tag::READY, &[])), "frame 32 from the ingress is unknown");
    assert!(
        refusal(&frame::encode(tag::READER, b"{}"))
            .starts_with("frame `message` from the ingress is invalid")
    );
    let (ingress_end, reader_end) = UnixStream::pair().unwrap();
    let (mut ingress, _requests) = IngressLink::new(reader_end.into());
    let (first, second, third) = (observed(), observed(), observed());
    send_with(&ingress_end, &json(&status(1)), &[first.0.as_fd()]);
    let both = [second.0.as_fd(), third.0.as_fd()];
    send_with(&ingress_end, &json(&ReaderMessage::Welcome), &both);
    drop((first.0, second.0, third.0));
    let Incoming::Message(delivery) = ingress.poll().unwrap() else { panic!() };
    assert!(delivery.descriptor.is_none() && is_closed(&first.1));
    let Incoming::Message(delivery) = ingress.poll().unwrap() else { panic!() };
    assert!(delivery.descriptor.is_some() && !is_closed(&second.1) && is_closed(&third.1));
}

#[test]
fn requests_of_a_reader_arrive_and_never_bring_a_descriptor() {
    let (mut link, _ingress, requests) = connected();
    assert!(matches!(link.poll(), Ok(Incoming::Nothing)));
    let largest = vec![5; PUBLISH_MAX];
    requests.need_definitions(9).unwrap();
    requests.need_layout(8).unwrap();
    requests.publish(1, b"cdr").unwrap();
    assert!(matches!(
        requests.publish(1, &[&largest[..], &[0]].concat()),
        Err(LinkError::TooLong { max: PUBLISH_MAX, .. })
    ));
    requests.publish(2, &largest).unwrap();
    let mut received = Vec::new();
    while received.len() < 4 {
        requests.flush().unwrap();
        if let Incoming::Message(request) = link.poll().unwrap() {
            received.push(request);
        }
    }
    assert_eq!(
        received,
        [
            ReaderRequest::NeedDefinitions { id: 9 },
            ReaderRequest::NeedLayout { id: 8 },
            ReaderRequest::Publish { index: 1, cdr: b"cdr".to_vec() },
            ReaderRequest::Publish { index: 2, cdr: largest },
        ]
    );
    drop((_ingress, requests));
    assert!(matches!(link.poll(), Ok(Incoming::Ended)));

    let (ingress_end, reader_end) = UnixStream::pair().unwrap();
    let mut link = ReaderLink::new(ingress_end.into());
    let (sent, observer) = observed();
    let request = frame::encode(tag::DEFINITIONS, &4_u32.to_le_bytes());
    send_with(&reader_end, &request, &[sent.as_fd()]);
    drop(sent);
    assert_eq!(link.poll().unwrap(), Incoming::Message(ReaderRequest::NeedDefinitions { id: 4 }));
    assert!(is_closed(&observer), "the kernel discarded it");
}

#[test]
fn a_reader_that_sends_byte_by_byte_does_not_keep_the_ingress_in_a_call() {
    let (mut reader_end, ingress_end) = UnixStream::pair().unwrap();
    let mut link = ReaderLink::new(ingress_end.into());
    let cdr = vec![5; PUBLISH_MAX];
    let frame = frame::encode(tag::PUBLISH, &[&[1, 0, 0, 0], &cdr[..]].concat());
    let len = frame.len();
    let sender = std::thread::spawn(move || {
        frame.chunks(1).for_each(|byte| reader_end.write_all(byte).unwrap());
        reader_end
    });
    let (mut received, mut calls) = (0, 0);
    let request = loop {
        let found = link.poll().unwrap();
        let now = link.take_received();
        received += now;
        calls += usize::from(now > 0);
        if let Incoming::Message(request) = found {
            break request;
        }
    };
    assert_eq!(request, ReaderRequest::Publish { index: 1, cdr });
    assert_eq!(received, len, "each byte is counted once");
    assert!(calls > 1, "the ingress has other work between them");
    drop(sender.join().unwrap());
}

#[test]
fn invalid_frames_of_a_reader_are_refused_by_name() {
    let refusal = |bytes: &[u8]| {
        let (mut reader_end, ingress_end) = UnixStream::pair().unwrap();
        reader_end.write_all(bytes).unwrap();
        ReaderLink::new(ingress_end.into()).poll().unwrap_err().to_string()
    };
    assert_eq!(
        refusal(&frame::encode(tag::DEFINITIONS, &[0; 5])),
        "frame `definitions` from the reader is invalid: it has 5 bytes instead of 4"
    );
    assert_eq!(
        refusal(&frame::encode(tag::PUBLISH, &[0; 3])),
        "frame `publish` from the reader is invalid: it has 3 bytes instead of 4 to 262148"
    );
    // The head alone is enough: no byte of a frame that is too long is kept.
    let head = [&((PUBLISH_MAX + 5) as u32).to_le_bytes()[..], &[tag::PUBLISH]].concat();
    assert!(refusal(&head).contains("it has 262149 bytes"));
    assert_eq!(refusal(&frame::encode(tag::READER, b"{}")), "frame 48 from the reader is unknown");
    assert_eq!(refusal(&frame::encode(tag::STOP, &[])), "frame 2 from the reader is unknown");
}

#[test]
fn random_bytes_are_an_error_or_an_end() {
    let mut random = SEED;
    for len in 0..300 {
        let raw = random.next(len);
        let tags = [tag::DEFINITIONS, tag::PUBLISH, tag::READER, tag::ADD_READER, tag::ADD_TOPICS];
        let framed = frame::encode(tags[len % tags.len()], &raw);
        for bytes in [&raw, &framed] {
            let sent = || {
                let (mut stranger, end) = UnixStream::pair().unwrap();
                stranger.write_all(bytes).unwrap();
                OwnedFd::from(end)
            };
            let (mut link, mut server) = (ReaderLink::new(sent()), IngressServer::new(sent()));
            let (mut ingress, _requests) = IngressLink::new(sent());
            // Each of them must return, whatever the results are.
            while matches!(link.poll(), Ok(Incoming::Message(_))) {}
            while matches!(server.poll(), Ok(Incoming::Message(_))) {}
            while matches!(ingress.poll(), Ok(Incoming::Message(_))) {}
        }
    }
}

#[test]
fn a_reader_that_does_not_read_misses_status_messages_and_is_reported_in_the_end() {
    let (mut link, mut ingress, _requests) = connected();
    let (descriptor, observer) = observed();
    let (mut queued, mut last) = (0, 0);
    let full = loop {
        match link.send(&attached(100_000), Some(descriptor.as_fd())) {
            Ok(()) => queued += 1,
            Err(error) => break error,
        }
        last += 1;
        link.send(&status(last), None).unwrap();
    };
    assert!(matches!(full, LinkError::Full { peer: "the reader" }), "{full}");
    assert!(link.is_pending() && (100..1000).contains(&queued), "{queued}");
    let (mut attached, mut statuses) = (0, 0);
    while attached < queued {
        match ingress.poll().unwrap() {
            Incoming::Message(ReaderDelivery { message: ReaderMessage::Status(_), .. }) => {
                statuses += 1;
            }
            Incoming::Message(_) => attached += 1,
            _ => link.flush().unwrap(),
        }
    }
    assert!(!link.is_pending() && statuses < 10, "{statuses}");
    link.send(&status(0), None).unwrap();
    let Incoming::Message(newest) = ingress.poll().unwrap() else { panic!() };
    assert_eq!(newest.message, status(0));
    drop(descriptor);
    assert!(is_closed(&observer), "sent descriptors are closed");
    let too_long = link.send(&self::attached(crate::link::FRAME_MAX), None).unwrap_err();
    assert!(matches!(too_long, LinkError::TooLong { .. }), "{too_long}");
    link.send(&status(5), None).unwrap();
}

#[test]
fn an_ingress_that_does_not_read_refuses_messages_but_never_blocks_the_reader() {
    let (mut link, _ingress, requests) = connected();
    let sent = (0_u32..).find(|index| {
        let published = requests.publish(*index, &index.to_le_bytes().repeat(5000));
        matches!(published, Err(LinkError::Full { peer: "the ingress" }))
    });
    let (sent, mut received) = (sent.unwrap(), 0);
    while received < sent {
        match link.poll().unwrap() {
            Incoming::Message(ReaderRequest::Publish { index, cdr }) => {
                assert_eq!((index, cdr), (received, received.to_le_bytes().repeat(5000)));
                received += 1;
            }
            other => {
                assert_eq!(other, Incoming::Nothing);
                requests.flush().unwrap();
            }
        }
    }
    drop(link);
    assert!(matches!(requests.need_definitions(1), Err(LinkError::Gone { peer: "the ingress" })));
}

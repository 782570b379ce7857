//! Tests of both connections: valid exchanges, invalid frames, and peers that end, do not respond
//! or do not read.

use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::thread;
use std::time::Duration;

use super::frame::{self, tag};
use super::*;
use crate::counts::LinkLosses;
use gleaner_journal::{InputView, JournalEntry, JournalHeader, JournalInput, WakeSource};
use gleaner_lambda::manifest::Limits;
use gleaner_lambda::{Fault, FaultKind, Trigger, TriggerKind};

pub(super) const TIMEOUT: Duration = Duration::from_secs(60);

pub(super) fn header(lambda: &str) -> JournalHeader {
    let input = JournalInput {
        name: "imu".to_owned(),
        topic: "/imu".to_owned(),
        wire_topic: "/imu".to_owned(),
        type_name: "sensor_msgs/msg/Imu".to_owned(),
    };
    JournalHeader {
        gleaner: "0.1.0".to_owned(),
        engine: "none".to_owned(),
        machine: "x".to_owned(),
        lambda: lambda.to_owned(),
        version: "0.1.0".to_owned(),
        inputs: vec![input],
        event_input: Some(0),
        clock: "x".to_owned(),
        ..JournalHeader::default()
    }
}

pub(super) fn entry(at_ns: i64, label: Option<&str>) -> JournalEntry {
    let trigger = |label: &str| Trigger {
        kind: TriggerKind::Event,
        label: label.to_owned(),
        score: Some(0.5),
        attributes: serde_json::Map::new(),
    };
    JournalEntry {
        at_ns,
        cause: WakeSource::Sample { writer: [7; 16], seq: at_ns as u64 },
        seen: vec![InputView { new: 1, digest: 5, newest: Some(([7; 16], 1)), reach: 2 }],
        triggers: label.map(trigger).into_iter().collect(),
        fuel: Some(9),
        ..JournalEntry::default()
    }
}

/// Returns the lambda's end of a connection, and both halves of the recorder's end.
pub(super) fn connected() -> (RecorderLink, LambdaLink, LambdaReplies) {
    let (lambda_end, recorder_end) = UnixStream::pair().unwrap();
    let (link, replies) = LambdaLink::new(recorder_end.into()).unwrap();
    (RecorderLink::new(lambda_end.into()), link, replies)
}

fn add(lambda: &str) -> AddLambda {
    AddLambda {
        lambda: lambda.into(),
        remaps: vec![("/imu".to_owned(), "/imu/data".to_owned())],
        most: Limits::DEFAULT,
        grants: vec![("/imu/data".to_owned(), 7)],
    }
}

#[test]
fn each_lambda_is_added_with_a_socket_of_its_own() {
    let (mut client, stdin) = ControlClient::pair().unwrap();
    let mut server = ControlServer::new(stdin);
    let lambdas = ["first", "second", "third"].map(|name| (name, client.add(&add(name)).unwrap()));
    client.give_way().unwrap();
    client.stop().unwrap();
    drop(client);
    for (name, lambda_end) in lambdas {
        let Some(ControlMessage::Add(added, recorder_end)) = server.receive().unwrap() else {
            panic!()
        };
        assert_eq!(added, Box::new(add(name)));
        // Bytes written at the lambda's end arrive at the recorder's.
        UnixStream::from(lambda_end).write_all(name.as_bytes()).unwrap();
        let mut read = String::new();
        UnixStream::from(recorder_end).read_to_string(&mut read).unwrap();
        assert_eq!(read, name);
    }
    assert!(matches!(server.receive(), Ok(Some(ControlMessage::GiveWay))));
    assert!(matches!(server.receive(), Ok(Some(ControlMessage::Stop))));
    assert!(matches!(server.receive(), Ok(None)), "the parent has ended");
}

#[test]
fn a_recorder_that_has_ended_is_an_error_not_a_signal() {
    let (mut client, stdin) = ControlClient::pair().unwrap();
    drop(stdin);
    assert!(matches!(client.add(&add("x")), Err(LinkError::Gone { peer: "the recorder" })));
    assert!(matches!(client.stop(), Err(LinkError::Gone { .. })));
    let (mut lambda, link, replies) = connected();
    drop((link, replies));
    assert!(matches!(lambda.hello(&header("x"), TIMEOUT), Err(LinkError::Gone { .. })));
    assert!(lambda.poll().unwrap().is_empty() && !lambda.is_joined(), "it waits for the next one");
}

#[test]
fn new_engines_arrive_whole_between_wakes() {
    let (mut lambda, mut link, mut replies) = connected();
    let recorder = thread::spawn(move || {
        assert!(matches!(link.receive(), Ok(Some(LambdaMessage::Hello(_)))));
        replies.ready();
        let (mut wakes, mut engines) = (Vec::new(), Vec::new());
        loop {
            match link.receive().unwrap() {
                Some(LambdaMessage::Wake { entry, .. }) => wakes.push(entry.at_ns),
                Some(LambdaMessage::Engine(engine)) => engines.push(engine),
                Some(LambdaMessage::Bye) => return (wakes, engines),
                other => panic!("{other:?}"),
            }
        }
    });
    lambda.hello(&header("hello"), TIMEOUT).unwrap();
    lambda.wake(&entry(1, None), 0).unwrap();
    lambda.engine("rten");
    lambda.wake(&entry(2, Some("here")), 0).unwrap();
    // More than the socket takes at once.
    let long = "x".repeat(1 << 20);
    lambda.engine(&long);
    lambda.poll().unwrap();
    lambda.wake(&entry(3, None), 0).unwrap();
    lambda.engine("onnxruntime");
    lambda.bye(TIMEOUT);
    let (wakes, engines) = recorder.join().unwrap();
    assert_eq!(wakes, [1, 2, 3]);
    assert!(engines == ["rten", &long, "onnxruntime"]);
}

#[test]
fn wakes_arrive_as_they_were_sent() {
    let (mut lambda, mut link, mut replies) = connected();
    let recorder = thread::spawn(move || {
        let Some(LambdaMessage::Hello(hello)) = link.receive().unwrap() else { panic!() };
        assert_eq!(*hello, header("hello"));
        replies.ready();
        let mut received = Vec::new();
        while let Some(LambdaMessage::Wake { entry, decided_ns, missing: 0, .. }) =
            link.receive().unwrap()
        {
            if !entry.triggers.is_empty() {
                replies.opened(decided_ns as u64 + 1);
            }
            received.push((*entry, decided_ns));
        }
        assert!(matches!(link.receive(), Ok(None)));
        received
    });
    lambda.hello(&header("hello"), TIMEOUT).unwrap();
    let sent: Vec<_> =
        (0..1000).map(|at| (entry(at, (at % 10 == 0).then_some("here")), at * 3)).collect();
    let mut messages = Vec::new();
    for (entry, decided) in &sent {
        lambda.wake(entry, *decided).unwrap();
        messages.extend(lambda.poll().unwrap());
    }
    while messages.len() < 100 {
        messages.extend(lambda.poll().unwrap());
        thread::yield_now();
    }
    assert_eq!(messages[3], RecorderMessage::Opened { wait_ns: 91 });
    assert_eq!(lambda.bye(TIMEOUT), LinkLosses::default());
    assert_eq!(recorder.join().unwrap(), sent);
}

#[test]
fn urgent_wakes_are_sent_at_once_and_all_wakes_in_order() {
    let (lambda_end, mut recorder_end) = UnixStream::pair().unwrap();
    let mut lambda = RecorderLink::new(lambda_end.into());
    recorder_end.write_all(&frame::encode(tag::READY, &[])).unwrap();
    lambda.hello(&header("hello"), TIMEOUT).unwrap();
    recorder_end.set_nonblocking(true).unwrap();
    let mut received = Vec::new();
    let mut new_bytes = || {
        let before = received.len();
        let _ = recorder_end.read_to_end(&mut received);
        received.len() - before
    };
    assert!(new_bytes() > 0, "hello");
    let mut at = 0;
    let mut next = |label: Option<&str>| {
        at += 1;
        entry(at, label)
    };
    let wake = |lambda: &mut RecorderLink, entry: JournalEntry| lambda.wake(&entry, 0).unwrap();
    for _ in 0..3 {
        wake(&mut lambda, next(None));
    }
    assert_eq!(new_bytes(), 0, "wakes without a trigger are queued");
    lambda.poll().unwrap();
    assert!(new_bytes() > 0, "`poll` sends them");
    wake(&mut lambda, next(None));
    wake(&mut lambda, next(Some("here")));
    assert!(new_bytes() > 0, "a trigger is sent at once");
    wake(&mut lambda, next(None));
    let fault = Fault { kind: FaultKind::Trap, message: "x".to_owned(), used: None, allowed: None };
    wake(&mut lambda, JournalEntry { fault: Some(fault), ..next(None) });
    assert!(new_bytes() > 0, "and so is a fault");
    let mut waited = 0;
    while new_bytes() == 0 {
        wake(&mut lambda, next(None));
        waited += 1;
    }
    assert!((100..1000).contains(&waited), "16 KiB are sent together: {waited}");
    wake(&mut lambda, next(None));
    assert_eq!(new_bytes(), 0);
    assert_eq!(lambda.bye(TIMEOUT), LinkLosses::default());
    assert!(new_bytes() > 0);
    // All wakes in order, and then the end.
    let (mut writer, reader) = UnixStream::pair().unwrap();
    let (mut link, _replies) = LambdaLink::new(reader.into()).unwrap();
    let writer = thread::spawn(move || writer.write_all(&received).unwrap());
    assert!(matches!(link.receive(), Ok(Some(LambdaMessage::Hello(_)))));
    for expected in 1..=at {
        let message = link.receive().unwrap();
        assert!(
            matches!(
                &message,
                Some(LambdaMessage::Wake { entry, missing: 0, .. }) if entry.at_ns == expected
            ),
            "{expected}: {message:?}"
        );
    }
    assert!(matches!(link.receive(), Ok(Some(LambdaMessage::Bye))));
    writer.join().unwrap();
}

#[test]
fn a_recorder_that_does_not_read_loses_wakes_but_does_not_block_the_lambda() {
    let (mut lambda, mut link, mut replies) = connected();
    replies.ready();
    lambda.hello(&header("hello"), TIMEOUT).unwrap();
    let all = 200_000_i64;
    for at in 0..all {
        lambda.wake(&entry(at, (at % 1000 == 999).then_some("here")), at).unwrap();
    }
    let dropped = lambda.dropped();
    assert!(dropped.wakes_dropped > 0 && dropped.triggers_lost == 0, "{dropped:?}");
    let lambda = thread::spawn(move || lambda.bye(TIMEOUT));
    assert!(matches!(link.receive(), Ok(Some(LambdaMessage::Hello(_)))));
    let (mut next, mut triggers, mut lost) = (0, 0, 0);
    while let Some(LambdaMessage::Wake { entry, missing, .. }) = link.receive().unwrap() {
        next += i64::from(missing);
        lost += u64::from(missing);
        assert_eq!(entry.at_ns, next, "the number of missing wakes");
        next += 1;
        triggers += entry.triggers.len() as i64;
    }
    assert_eq!((triggers, lost), (all / 1000, dropped.wakes_dropped));
    assert_eq!(lambda.join().unwrap(), dropped);
}

#[test]
fn a_refusal_states_its_reason_and_a_silent_recorder_is_a_timeout() {
    let (mut lambda, _link, mut replies) = connected();
    replies.refused("it is another \u{1b}[2J");
    let refused = lambda.hello(&header("x"), TIMEOUT).unwrap_err();
    assert!(
        matches!(&refused, LinkError::Refused { reason } if reason == "it is another \\u{1b}[2J"),
        "{refused}"
    );
    let (mut lambda, _link, _replies) = connected();
    assert!(matches!(
        lambda.hello(&header("x"), Duration::from_millis(20)),
        Err(LinkError::Silent { .. })
    ));
    let (mut lambda, _link, mut replies) = connected();
    replies.refused(&"é".repeat(5000));
    assert!(matches!(lambda.hello(&header("x"), TIMEOUT), Err(LinkError::Refused { .. })));
}

/// Receives `frames` as the recorder; returns the number of messages.
fn receive_all(frames: &[Vec<u8>]) -> Result<usize, LinkError> {
    let (mut lambda_end, recorder_end) = UnixStream::pair().unwrap();
    let bytes = frames.concat();
    let writer = thread::spawn(move || {
        let _ = lambda_end.write_all(&bytes);
    });
    let (mut link, replies) = LambdaLink::new(recorder_end.into()).unwrap();
    let mut count = 0;
    let result = loop {
        match link.receive() {
            Ok(Some(_)) => count += 1,
            Ok(None) => break Ok(count),
            Err(error) => break Err(error),
        }
    };
    drop((link, replies));
    writer.join().unwrap();
    result
}

#[test]
fn invalid_frames_of_a_lambda_are_refused_by_name() {
    let hello = || frame::encode(tag::HELLO, &serde_json::to_vec(&header("x")).unwrap());
    let wake = |payload: &[u8]| frame::encode(tag::WAKE, payload);
    let refusal = |frames: &[Vec<u8>]| receive_all(frames).unwrap_err().to_string();
    assert_eq!(receive_all(&[hello()]).unwrap(), 1);
    assert_eq!(
        refusal(&[wake(&[0; 30])]),
        "received frame `wake` from the lambda instead of `hello`"
    );
    assert_eq!(
        refusal(&[hello(), hello()]),
        "received frame `hello` from the lambda instead of `wake`"
    );
    assert_eq!(
        refusal(&[hello(), wake(&[0; 11])]),
        "frame `wake` from the lambda is invalid: it has 11 bytes"
    );
    assert_eq!(
        refusal(&[hello(), wake(&[255; 40])]),
        "frame `wake` from the lambda cannot be decoded"
    );
    assert_eq!(refusal(&[frame::encode(99, &[])]), "frame 99 from the lambda is unknown");
    assert_eq!(refusal(&[frame::encode(tag::ADD, b"{}")]), "frame 1 from the lambda is unknown");
    assert!(
        refusal(&[frame::encode(tag::HELLO, b"{}")])
            .starts_with("frame `hello` from the lambda is invalid")
    );
    let too_long = [&u32::MAX.to_le_bytes()[..], &[tag::HELLO]].concat();
    assert!(refusal(&[too_long]).contains("has 4294967295 bytes, above the maximum of 2097152"));
    assert_eq!(
        refusal(&[hello()[..20].to_vec()]),
        "the lambda has ended, or closed the connection"
    );
    let no_such_input = JournalHeader { event_input: Some(1), ..header("x") };
    let hello = frame::encode(tag::HELLO, &serde_json::to_vec(&no_such_input).unwrap());
    assert!(refusal(&[hello]).contains("inputs"));
}

#[test]
fn random_bytes_are_an_error_or_an_end() {
    let hello = frame::encode(tag::HELLO, &serde_json::to_vec(&header("x")).unwrap());
    let mut random = 0x2545_f491_4f6c_dd1d_u64;
    for len in 0..200 {
        let payload: Vec<u8> = std::iter::repeat_with(|| {
            random ^= random << 13;
            random ^= random >> 7;
            random ^= random << 17;
            random as u8
        })
        .take(12 + len % 100)
        .collect();
        // It must return, whatever the result.
        let _ = receive_all(&[hello.clone(), frame::encode(tag::WAKE, &payload)]);
        let _ = receive_all(&[payload]);
    }
}

#[test]
fn invalid_frames_of_a_starter_are_refused_by_name() {
    let refusal = |bytes: &[u8]| {
        let (mut starter_end, recorder_end) = UnixStream::pair().unwrap();
        starter_end.write_all(bytes).unwrap();
        drop(starter_end);
        ControlServer::new(OwnedFd::from(recorder_end)).receive().unwrap_err().to_string()
    };
    let add = serde_json::to_vec(&add("x")).unwrap();
    assert_eq!(refusal(&frame::encode(tag::ADD, &add)), "frame `add` came without its descriptor");
    assert!(
        refusal(&frame::encode(tag::ADD, b"[]"))
            .starts_with("frame `add` from the parent is invalid")
    );
    assert_eq!(refusal(&frame::encode(tag::HELLO, &[])), "frame 16 from the parent is unknown");
    assert_eq!(refusal(&[1, 0, 0]), "the parent has ended, or closed the connection");
}

#[test]
fn reports_are_lines_with_their_kind() {
    let loss = RecorderReport::Loss(Loss::Deleted {
        at_ns: 5,
        file: "clips/a.mcap".into(),
        bytes: 9,
        reason: "--clips-max 3".to_owned(),
    });
    let line = serde_json::to_string(&loss).unwrap();
    assert_eq!(
        line,
        concat!(
            r#"{"recorder":"loss","loss":"deleted","at_ns":5,"file":"clips/a.mcap","bytes":9,"#,
            r#""reason":"--clips-max 3"}"#
        )
    );
    assert_eq!(serde_json::from_str::<RecorderReport>(&line).unwrap(), loss);
    let status = RecorderReport::Status(Box::default());
    let line = serde_json::to_string(&status).unwrap();
    assert!(line.starts_with(r#"{"recorder":"status","lambdas":0,"#), "{line}");
    assert_eq!(serde_json::from_str::<RecorderReport>(&line).unwrap(), status);
    assert_eq!(serde_json::to_string(&RecorderReport::Ready).unwrap(), r#"{"recorder":"ready"}"#);
}

#[test]
fn invalid_frames_of_a_recorder_are_refused_by_name() {
    let refusal = |bytes: &[u8]| {
        let (mut recorder_end, lambda_end) = UnixStream::pair().unwrap();
        recorder_end.write_all(bytes).unwrap();
        RecorderLink::new(lambda_end.into()).poll().unwrap_err().to_string()
    };
    assert_eq!(refusal(&frame::encode(99, &[])), "frame 99 from the recorder is unknown");
    assert_eq!(
        refusal(&frame::encode(tag::WAKE, &[0; 20])),
        "frame 17 from the recorder is unknown"
    );
    let short = frame::encode(tag::OPENED, &[0; 7]);
    assert_eq!(
        refusal(&short),
        "frame `opened` from the recorder is invalid: it has 7 bytes instead of 8"
    );
    let too_long = [&5000_u32.to_le_bytes()[..], &[tag::REFUSED]].concat();
    assert_eq!(
        refusal(&too_long),
        "frame `refused` from the recorder is invalid: \
         it has 5000 bytes, above the maximum of 4096"
    );
    let too_long = [&u32::MAX.to_le_bytes()[..], &[tag::READY]].concat();
    assert!(refusal(&too_long).contains("has 4294967295 bytes, above the maximum of 2097152"));
}

#[test]
fn a_request_that_is_too_long_is_not_sent() {
    let (mut client, stdin) = ControlClient::pair().unwrap();
    let long = AddLambda { lambda: "x".repeat(FRAME_MAX).into(), ..add("x") };
    let refused = client.add(&long).unwrap_err();
    assert!(
        matches!(
            refused,
            LinkError::TooLong { peer: "the parent", frame: "add", bytes, .. }
                if bytes > FRAME_MAX as u64
        ),
        "{refused}"
    );
    // Nothing of it was sent, so that the next request is valid.
    client.stop().unwrap();
    assert!(matches!(ControlServer::new(stdin).receive(), Ok(Some(ControlMessage::Stop))));
}

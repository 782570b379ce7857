//! Two ends that talk to each other, and ends that talk nonsense.

use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::thread;
use std::time::Duration;

use super::frame::{self, tag};
use super::*;
use gleaner_journal::{
    InputView, JournalEntry, JournalHeader, JournalInput, LogDigest, WakeSource,
};
use gleaner_lambda::manifest::{LambdaKind, Limits};
use gleaner_lambda::{Fault, FaultKind, Trigger, TriggerKind};

const PATIENCE: Duration = Duration::from_secs(60);

fn header(lambda: &str) -> JournalHeader {
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
        kind: LambdaKind::Wasm,
        files: Vec::new(),
        models: Vec::new(),
        manifest: String::new(),
        inputs: vec![input],
        event_input: Some(0),
        config: serde_json::Map::new(),
        remaps: Vec::new(),
        clock: "x".to_owned(),
        part: Default::default(),
        wakes_before: 0,
        limits: Default::default(),
    }
}

fn entry(at_ns: i64, label: Option<&str>) -> JournalEntry {
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
        fault: None,
        fuel: Some(9),
        log: LogDigest::default(),
    }
}

/// A lambda's end, and the recorder's.
fn connected() -> (RecorderLink, LambdaLink, LambdaReplies) {
    let (ours, theirs) = UnixStream::pair().unwrap();
    let (link, answers) = LambdaLink::new(theirs.into()).unwrap();
    (RecorderLink::new(ours.into()), link, answers)
}

fn add(lambda: &str) -> AddLambda {
    AddLambda {
        lambda: lambda.into(),
        remaps: vec![("/imu".to_owned(), "/imu/data".to_owned())],
        most: Limits::DEFAULT,
    }
}

#[test]
fn each_lambda_is_announced_with_a_socket_of_its_own() {
    let (mut control, stdin) = ControlClient::pair().unwrap();
    let mut controlled = ControlServer::new(stdin);
    let lambdas = ["first", "second", "third"].map(|name| (name, control.add(&add(name)).unwrap()));
    control.stop().unwrap();
    drop(control);
    for (name, theirs) in lambdas {
        let Some(ControlMessage::Add(order, ours)) = controlled.order().unwrap() else { panic!() };
        assert_eq!(order, add(name));
        // What is written at one end comes out at the other, and not elsewhere.
        UnixStream::from(theirs).write_all(name.as_bytes()).unwrap();
        let mut read = String::new();
        UnixStream::from(ours).read_to_string(&mut read).unwrap();
        assert_eq!(read, name);
    }
    assert!(matches!(controlled.order(), Ok(Some(ControlMessage::Stop))));
    assert!(matches!(controlled.order(), Ok(None)), "the starter has ended");
}

#[test]
fn a_recorder_that_has_ended_is_an_error_and_no_signal() {
    let (mut control, stdin) = ControlClient::pair().unwrap();
    drop(stdin);
    assert!(matches!(control.add(&add("x")), Err(LinkError::Gone { who: "the recorder" })));
    assert!(matches!(control.stop(), Err(LinkError::Gone { .. })));
    let (mut lambda, link, answers) = connected();
    drop((link, answers));
    assert!(matches!(lambda.hello(&header("x"), PATIENCE), Err(LinkError::Gone { .. })));
    assert!(matches!(lambda.poll(), Err(LinkError::Gone { .. })));
}

#[test]
fn wakes_arrive_as_they_were_sent() {
    let (mut lambda, mut link, mut answers) = connected();
    let recorder = thread::spawn(move || {
        let Some(LambdaMessage::Hello(said)) = link.hear().unwrap() else { panic!() };
        assert_eq!(*said, header("hello"));
        answers.ready();
        let mut heard = Vec::new();
        while let Some(LambdaMessage::Wake { entry, decided_ns, missing: 0, .. }) =
            link.hear().unwrap()
        {
            if !entry.triggers.is_empty() {
                answers.opened(decided_ns as u64 + 1);
            }
            heard.push((*entry, decided_ns));
        }
        assert!(matches!(link.hear(), Ok(None)));
        heard
    });
    lambda.hello(&header("hello"), PATIENCE).unwrap();
    let sent: Vec<_> =
        (0..1000).map(|at| (entry(at, (at % 10 == 0).then_some("here")), at * 3)).collect();
    let mut said = Vec::new();
    for (entry, decided) in &sent {
        lambda.wake(entry, *decided).unwrap();
        said.extend(lambda.poll().unwrap());
    }
    while said.len() < 100 {
        said.extend(lambda.poll().unwrap());
        thread::yield_now();
    }
    assert_eq!(said[3], RecorderMessage::Opened { wait_ns: 91 });
    assert_eq!(lambda.bye(PATIENCE), crate::LinkLosses::default());
    assert_eq!(recorder.join().unwrap(), sent);
}

#[test]
fn only_what_is_urgent_goes_at_once_and_the_order_stays() {
    let (ours, theirs) = UnixStream::pair().unwrap();
    let (mut lambda, mut theirs) = (RecorderLink::new(ours.into()), theirs);
    theirs.write_all(&frame::whole(tag::READY, &[])).unwrap();
    lambda.hello(&header("hello"), PATIENCE).unwrap();
    theirs.set_nonblocking(true).unwrap();
    let mut came = Vec::new();
    let mut bytes_come = || {
        let before = came.len();
        let _ = theirs.read_to_end(&mut came);
        came.len() - before
    };
    assert!(bytes_come() > 0, "hello");
    let mut at = 0;
    let mut next = |label: Option<&str>| {
        at += 1;
        entry(at, label)
    };
    let wake = |lambda: &mut RecorderLink, entry: JournalEntry| lambda.wake(&entry, 0).unwrap();
    for _ in 0..3 {
        wake(&mut lambda, next(None));
    }
    assert_eq!(bytes_come(), 0, "they wait");
    lambda.poll().unwrap();
    assert!(bytes_come() > 0, "for this");
    wake(&mut lambda, next(None));
    wake(&mut lambda, next(Some("here")));
    assert!(bytes_come() > 0, "a trigger goes at once");
    wake(&mut lambda, next(None));
    let fault = Fault { kind: FaultKind::Trap, message: "x".to_owned(), used: None, allowed: None };
    wake(&mut lambda, JournalEntry { fault: Some(fault), ..next(None) });
    assert!(bytes_come() > 0, "and so does a fault");
    let mut waited = 0;
    while bytes_come() == 0 {
        wake(&mut lambda, next(None));
        waited += 1;
    }
    assert!((100..1000).contains(&waited), "16 KiB go together: {waited}");
    wake(&mut lambda, next(None));
    assert_eq!(bytes_come(), 0);
    assert_eq!(lambda.bye(PATIENCE), crate::LinkLosses::default());
    assert!(bytes_come() > 0);
    // All of them, in their order, and then the end.
    let (mut writer, reader) = UnixStream::pair().unwrap();
    let (mut link, _answers) = LambdaLink::new(reader.into()).unwrap();
    let writer = thread::spawn(move || writer.write_all(&came).unwrap());
    assert!(matches!(link.hear(), Ok(Some(LambdaMessage::Hello(_)))));
    for due in 1..=at {
        let heard = link.hear().unwrap();
        assert!(
            matches!(&heard, Some(LambdaMessage::Wake { entry, missing: 0, .. }) if entry.at_ns == due),
            "{due}: {heard:?}"
        );
    }
    assert!(matches!(link.hear(), Ok(Some(LambdaMessage::Bye))));
    writer.join().unwrap();
}

#[test]
fn a_recorder_that_does_not_read_costs_wakes_and_no_time() {
    let (mut lambda, mut link, mut answers) = connected();
    answers.ready();
    lambda.hello(&header("hello"), PATIENCE).unwrap();
    let all = 200_000_i64;
    for at in 0..all {
        lambda.wake(&entry(at, (at % 1000 == 999).then_some("here")), at).unwrap();
    }
    let dropped = lambda.dropped();
    assert!(dropped.wakes_dropped > 0 && dropped.triggers_lost == 0, "{dropped:?}");
    let lambda = thread::spawn(move || lambda.bye(PATIENCE));
    assert!(matches!(link.hear(), Ok(Some(LambdaMessage::Hello(_)))));
    let (mut next, mut triggers, mut lost) = (0, 0, 0);
    while let Some(LambdaMessage::Wake { entry, missing, .. }) = link.hear().unwrap() {
        next += i64::from(missing);
        lost += u64::from(missing);
        assert_eq!(entry.at_ns, next, "what is missing is said where it is");
        next += 1;
        triggers += entry.triggers.len() as i64;
    }
    assert_eq!((triggers, lost), (all / 1000, dropped.wakes_dropped));
    assert_eq!(lambda.join().unwrap(), dropped);
}

#[test]
fn a_refusal_is_told_and_silence_has_an_end() {
    let (mut lambda, _link, mut answers) = connected();
    answers.refused("it is another \u{1b}[2J");
    let refused = lambda.hello(&header("x"), PATIENCE).unwrap_err();
    assert!(
        matches!(&refused, LinkError::Refused { why } if why == "it is another \\u{1b}[2J"),
        "{refused}"
    );
    let (mut lambda, _link, _answers) = connected();
    assert!(matches!(
        lambda.hello(&header("x"), Duration::from_millis(20)),
        Err(LinkError::Silent { .. })
    ));
    let (mut lambda, _link, mut answers) = connected();
    answers.refused(&"é".repeat(5000));
    assert!(matches!(lambda.hello(&header("x"), PATIENCE), Err(LinkError::Refused { .. })));
}

/// What the recorder makes of these bytes of a lambda.
fn heard(frames: &[Vec<u8>]) -> Result<usize, LinkError> {
    let (mut ours, theirs) = UnixStream::pair().unwrap();
    let bytes = frames.concat();
    let writer = thread::spawn(move || {
        let _ = ours.write_all(&bytes);
    });
    let (mut link, _answers) = LambdaLink::new(theirs.into()).unwrap();
    let mut count = 0;
    let heard = loop {
        match link.hear() {
            Ok(Some(_)) => count += 1,
            Ok(None) => break Ok(count),
            Err(error) => break Err(error),
        }
    };
    drop((link, _answers));
    writer.join().unwrap();
    heard
}

#[test]
fn nonsense_is_refused_by_name() {
    let hello = || frame::whole(tag::HELLO, &serde_json::to_vec(&header("x")).unwrap());
    let wake = |payload: &[u8]| frame::whole(tag::WAKE, payload);
    let said = |frames: &[Vec<u8>]| heard(frames).unwrap_err().to_string();
    assert_eq!(heard(&[hello()]).unwrap(), 1);
    assert_eq!(said(&[wake(&[0; 30])]), "frame `wake` from the lambda comes where `hello` is due");
    assert_eq!(
        said(&[hello(), hello()]),
        "frame `hello` from the lambda comes where `wake` is due"
    );
    assert_eq!(
        said(&[hello(), wake(&[0; 11])]),
        "frame `wake` from the lambda cannot be read: it has 11 bytes"
    );
    assert_eq!(said(&[hello(), wake(&[255; 40])]), "frame `wake` from the lambda is none");
    assert_eq!(said(&[frame::whole(99, &[])]), "frame 99 from the lambda is not known here");
    assert_eq!(said(&[frame::whole(tag::ADD, b"{}")]), "frame 1 from the lambda is not known here");
    assert!(
        said(&[frame::whole(tag::HELLO, b"{}")])
            .starts_with("frame `hello` from the lambda cannot be read")
    );
    let claims = [&u32::MAX.to_le_bytes()[..], &[tag::HELLO]].concat();
    assert!(said(&[claims]).contains("has 4294967295 bytes, above the maximum of 2097152"));
    assert_eq!(said(&[hello()[..20].to_vec()]), "the lambda has ended, or closed the connection");
    let outside = JournalHeader { event_input: Some(1), ..header("x") };
    let outside = frame::whole(tag::HELLO, &serde_json::to_vec(&outside).unwrap());
    assert!(said(&[outside]).contains("inputs"));
}

#[test]
fn random_bytes_are_an_error_or_an_end() {
    let hello = frame::whole(tag::HELLO, &serde_json::to_vec(&header("x")).unwrap());
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
        // Whatever it is, it comes back.
        let _ = heard(&[hello.clone(), frame::whole(tag::WAKE, &payload)]);
        let _ = heard(&[payload]);
    }
}

#[test]
fn a_starter_that_talks_nonsense_is_refused_by_name() {
    let said = |bytes: &[u8]| {
        let (mut ours, theirs) = UnixStream::pair().unwrap();
        ours.write_all(bytes).unwrap();
        drop(ours);
        ControlServer::new(OwnedFd::from(theirs)).order().unwrap_err().to_string()
    };
    let add = serde_json::to_vec(&add("x")).unwrap();
    assert_eq!(said(&frame::whole(tag::ADD, &add)), "frame `add` came without a socket");
    assert!(
        said(&frame::whole(tag::ADD, b"[]"))
            .starts_with("frame `add` from the starter cannot be read")
    );
    assert_eq!(said(&frame::whole(tag::HELLO, &[])), "frame 16 from the starter is not known here");
    assert_eq!(said(&[1, 0, 0]), "the starter has ended, or closed the connection");
}

#[test]
fn reports_are_lines_that_name_themselves() {
    let loss = RecorderReport::Loss(Loss::Deleted {
        at_ns: 5,
        file: "clips/a.mcap".into(),
        bytes: 9,
        reason: "--clips-max 3".to_owned(),
    });
    let line = serde_json::to_string(&loss).unwrap();
    assert_eq!(
        line,
        r#"{"recorder":"loss","loss":"deleted","at_ns":5,"file":"clips/a.mcap","bytes":9,"reason":"--clips-max 3"}"#
    );
    assert_eq!(serde_json::from_str::<RecorderReport>(&line).unwrap(), loss);
    let status = RecorderReport::Status(Box::default());
    let line = serde_json::to_string(&status).unwrap();
    assert!(line.starts_with(r#"{"recorder":"status","lambdas":0,"#), "{line}");
    assert_eq!(serde_json::from_str::<RecorderReport>(&line).unwrap(), status);
    assert_eq!(serde_json::to_string(&RecorderReport::Ready).unwrap(), r#"{"recorder":"ready"}"#);
}

#[test]
fn a_recorder_that_talks_nonsense_is_refused_by_name() {
    let said = |bytes: &[u8]| {
        let (mut ours, theirs) = UnixStream::pair().unwrap();
        ours.write_all(bytes).unwrap();
        RecorderLink::new(theirs.into()).poll().unwrap_err().to_string()
    };
    assert_eq!(said(&frame::whole(99, &[])), "frame 99 from the recorder is not known here");
    assert_eq!(
        said(&frame::whole(tag::WAKE, &[0; 20])),
        "frame 17 from the recorder is not known here"
    );
    let short = frame::whole(tag::OPENED, &[0; 7]);
    assert_eq!(
        said(&short),
        "frame `opened` from the recorder cannot be read: it has 7 bytes instead of 8"
    );
    let claims = [&5000_u32.to_le_bytes()[..], &[tag::REFUSED]].concat();
    assert_eq!(
        said(&claims),
        "frame `refused` from the recorder cannot be read: it has 5000 bytes, above the maximum of 4096"
    );
    let claims = [&u32::MAX.to_le_bytes()[..], &[tag::READY]].concat();
    assert!(said(&claims).contains("has 4294967295 bytes, above the maximum of 2097152"));
}

#[test]
fn an_order_that_no_frame_holds_is_not_sent() {
    let (mut control, stdin) = ControlClient::pair().unwrap();
    let long =
        AddLambda { lambda: "x".repeat(FRAME_MAX).into(), remaps: Vec::new(), most: Limits::MAX };
    let refused = control.add(&long).unwrap_err();
    assert!(
        matches!(refused, LinkError::TooLong { who: "the starter", frame: "add", bytes } if bytes > FRAME_MAX as u64),
        "{refused}"
    );
    // Nothing of it went over, so that what follows is understood.
    control.stop().unwrap();
    assert!(matches!(ControlServer::new(stdin).order(), Ok(Some(ControlMessage::Stop))));
}

//! Tests of the connections to and from `gleaner-inference`.

use std::os::fd::AsFd;
use std::time::{Duration, Instant};

use rustix::net::{SendFlags, send};

use super::*;
use crate::link::{Incoming, LinkError};

#[test]
fn a_call_is_answered_late_replies_are_skipped_and_the_end_of_the_process_arrives() {
    let (lambda, other) = ModelClient::pair().unwrap();
    let starter = other.try_clone().unwrap();
    let (mut client, server) = (ModelClient::new(lambda), ModelSocket::new(other));
    let soon = || Some(Instant::now() + Duration::from_millis(1));
    let open = || ModelCall::Open { model: "m".to_owned() };
    assert!(matches!(client.call(open(), None, soon()), Ok(ModelWait::TimedOut)));
    let Ok(Incoming::Message(request)) = server.poll() else { panic!("no call") };
    assert_eq!(request, ModelRequest { id: 1, deadline_ns: None, regions: [0; 2], call: open() });
    let reply = |id| ModelReply { id, region: 7, result: Ok(ModelResult::Reserved) };
    server.reply(&reply(1), None).unwrap();
    server.reply(&reply(2), Some(starter.as_fd())).unwrap();
    match client.call(open(), Some(5), None).unwrap() {
        ModelWait::Reply(received, region) => {
            assert_eq!((received, region.is_some()), (reply(2), true));
        }
        ModelWait::TimedOut => panic!("no reply"),
    }
    // The socket outlives the process: its successor uses the same one.
    drop(server);
    report_state(&starter, Some("it has ended")).unwrap();
    let Ok(ModelWait::Reply(received, None)) = client.call(open(), None, None) else {
        panic!("no reply")
    };
    assert_eq!((received.id, received.result.is_err()), (0, true));
    report_state(&starter, None).unwrap();
    assert_eq!(client.poll().unwrap().map(|it| it.result), Some(Ok(ModelResult::Started)));
    assert!(client.poll().unwrap().is_none());
    let server = ModelSocket::new(starter);
    let next = || server.poll().unwrap();
    assert!(matches!(next(), Incoming::Message(ModelRequest { id: 2, .. })));
    assert!(matches!(next(), Incoming::Message(ModelRequest { id: 3, .. })));
    assert!(matches!(next(), Incoming::Nothing));
    drop(client);
    assert!(matches!(next(), Incoming::Ended));
}

#[test]
fn a_message_that_is_no_call_or_too_long_is_refused() {
    let (lambda, other) = ModelClient::pair().unwrap();
    let server = ModelSocket::new(other);
    for (bytes, refusal) in [
        (b"{}".to_vec(), "frame `call` from a lambda is invalid"),
        (vec![b'x'; MESSAGE_MAX + 1], "above the maximum of 65536"),
    ] {
        send(&lambda, &bytes, SendFlags::empty()).unwrap();
        let error = server.poll().unwrap_err().to_string();
        assert!(error.contains(refusal), "{error}");
    }
}

#[test]
fn a_call_that_is_too_long_is_not_sent_and_regions_stay_known() {
    let (lambda, other) = ModelClient::pair().unwrap();
    let region = other.try_clone().unwrap();
    let (mut client, server) = (ModelClient::new(lambda), ModelSocket::new(other));
    let reply = ModelReply { id: 1, region: 7, result: Ok(ModelResult::Reserved) };
    server.reply(&reply, Some(region.as_fd())).unwrap();
    let reserved = client.call(ModelCall::Reserve { bytes: 1 }, None, None);
    assert!(matches!(reserved, Ok(ModelWait::Reply(..))));
    let open = |model: String| ModelCall::Open { model };
    let long = client.call(open("m".repeat(MESSAGE_MAX)), None, None);
    assert!(matches!(long, Err(LinkError::TooLong { .. })));
    let late = client.call(open("m".to_owned()), None, Some(Instant::now()));
    assert!(matches!(late, Ok(ModelWait::TimedOut)));
    let regions: Vec<_> = (0..2)
        .map(|_| match server.poll().unwrap() {
            Incoming::Message(request) => request.regions,
            _ => panic!("no call"),
        })
        .collect();
    assert_eq!(regions, [[0, 0], [7, 0]]);
}

#[test]
fn models_and_lambdas_arrive_with_their_descriptors() {
    let (control, end) = InferenceControl::pair().unwrap();
    let mut server = InferenceServer::new(end);
    let file =
        ModelFile { sha256: "0".repeat(64), path: "m.onnx".to_owned(), engine: ModelEngine::None };
    let attached = ModelFile { engine: ModelEngine::Attached, ..file.clone() };
    let model = GrantedModel {
        name: "m".to_owned(),
        sha256: file.sha256.clone(),
        providers: vec!["cpu".to_owned()],
        threads: Some(2),
        refused: None,
    };
    let (demand, pace) = (Some(1), Some([1, 2]));
    let (id, name) = ("front".to_owned(), "yolo".to_owned());
    let client = AddClient { id, name, demand, pace, memory: 1 << 20, models: vec![model] };
    let load = TryLoad { sha256: file.sha256.clone(), providers: Vec::new(), threads: 1 };
    let (passed, _other) = ModelClient::pair().unwrap();
    control.add_model(&file, passed.as_fd(), None).unwrap();
    control.add_model(&attached, passed.as_fd(), Some(passed.as_fd())).unwrap();
    control.add_client(&client, passed.as_fd()).unwrap();
    control.tried(&load, Some("it has ended"), ModelMemory { held: 1, peak: 2 }).unwrap();
    control.stop().unwrap();
    let mut next = || server.poll().unwrap();
    let mut model = |wanted: ModelFile| match next() {
        Incoming::Message(InferenceRequest::Model(it, _, engine)) if it == wanted => engine,
        other => panic!("{other:?}"),
    };
    assert!(model(file).is_none());
    assert!(model(attached.clone()).is_some());
    assert!(matches!(next(), Incoming::Message(InferenceRequest::Client(it, _)) if it == client));
    let tried = next();
    let Incoming::Message(InferenceRequest::Tried(it, Some(_), memory)) = tried else { panic!() };
    assert_eq!((it, memory), (load, ModelMemory { held: 1, peak: 2 }));
    assert!(matches!(next(), Incoming::Message(InferenceRequest::Stop)));
    // One of the two is missing.
    control.add_model(&attached, passed.as_fd(), None).unwrap();
    let error = server.poll().unwrap_err();
    assert!(matches!(error, LinkError::NoDescriptor { .. }), "{error}");
}

#[test]
fn the_end_of_the_starter_arrives() {
    let (control, end) = InferenceControl::pair().unwrap();
    drop(control);
    assert!(matches!(InferenceServer::new(end).poll(), Ok(Incoming::Ended)));
}

#[test]
fn sizes_of_tensors_are_bounded() {
    let bytes = |shape: &[u32]| Element::Float32.bytes_of(shape);
    assert_eq!(bytes(&[1, 3, 416, 416]), Some(2_076_672));
    assert_eq!(bytes(&[]), Some(4));
    assert_eq!(bytes(&[64 << 20]), Some(MAX_TENSOR_BYTES));
    assert_eq!(bytes(&[0, 6]), Some(0));
    for refused in [&[(64 << 20) + 1][..], &[u32::MAX; 8], &[1; 9]] {
        assert_eq!(bytes(refused), None, "{refused:?}");
    }
    let shape = vec![Some(1), None, Some(85)];
    let info = TensorInfo { name: "output".to_owned(), element: Element::Float32, shape };
    assert_eq!(info.to_string(), "float32 [1, ?, 85]");
    assert!(info.accepts(Element::Float32, &[1, 7, 85]));
    assert!(
        !info.accepts(Element::Float32, &[1, 7, 84]) && !info.accepts(Element::Int8, &[1, 7, 85])
    );
}

//! Tests with another end of the connection that plays `gleaner-inference`.

use std::os::fd::AsFd;
use std::thread::{self, JoinHandle};

use gleaner_protocol::inference::{
    Element, MESSAGE_MAX, ModelFaultKind, ModelRequest, ModelSocket, report_state,
};
use gleaner_protocol::link::Incoming;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::fs::{MemfdFlags, ftruncate, memfd_create};
use rustix::net::{SendFlags, send};

use super::*;
use crate::api::call_time::CallTime;

/// `memory` of the lambda.
const MEMORY: u64 = 1 << 20;

enum Sent {
    /// A result, with a region if one is named by its size.
    Result(Result<ModelResult, ModelFault>, Option<u64>),
    /// A message that may be no reply.
    Bytes(Vec<u8>),
}

/// Returns the models of a lambda, and the other end, which makes these replies in order. It
/// returns the number of calls when the lambda has closed the connection.
fn models(replies: Vec<Sent>) -> (Models, JoinHandle<usize>) {
    let (lambda, other) = ModelClient::pair().unwrap();
    let entry = ModelEntry { name: "m".to_owned(), layout: None, labels: Vec::new() };
    let copy = other.try_clone().unwrap();
    let server = ModelSocket::new(other);
    let mut replies = replies.into_iter();
    let serving = thread::spawn(move || {
        let mut calls = 0;
        loop {
            poll(&mut [PollFd::new(&server, PollFlags::IN)], None).unwrap();
            match server.poll().unwrap() {
                Incoming::Message(ModelRequest { id, .. }) => {
                    calls += 1;
                    match replies.next().expect("a further reply") {
                        Sent::Result(result, bytes) => {
                            let region = bytes.map(region);
                            let reply = ModelReply { id, region: 1, result };
                            server.reply(&reply, region.as_ref().map(AsFd::as_fd)).unwrap();
                        }
                        Sent::Bytes(bytes) => {
                            send(&copy, &bytes, SendFlags::empty()).unwrap();
                        }
                    }
                }
                Incoming::Nothing => {}
                Incoming::Ended => return calls,
            }
        }
    });
    (Models::new(vec![entry], Some(lambda), MEMORY), serving)
}

fn region(bytes: u64) -> OwnedFd {
    let region = memfd_create("gleaner-test", MemfdFlags::CLOEXEC).unwrap();
    ftruncate(&region, bytes).unwrap();
    region
}

fn opened() -> Sent {
    let (inputs, outputs, runtime) = (Vec::new(), Vec::new(), "rten".to_owned());
    Sent::Result(Ok(ModelResult::Opened { inputs, outputs, runtime, metadata: Vec::new() }), None)
}

fn reserved() -> Sent {
    Sent::Result(Ok(ModelResult::Reserved), Some(4096))
}

fn fault(kind: ModelFaultKind) -> Sent {
    Sent::Result(Err(ModelFault::new(kind, "a reason")), None)
}

fn place(shape: &[u32], offset: u64) -> TensorPlace {
    TensorPlace { name: "y".to_owned(), element: Element::Float32, shape: shape.to_vec(), offset }
}

fn ran(outputs: Vec<TensorPlace>, region: Option<u64>) -> Sent {
    Sent::Result(Ok(ModelResult::Ran { outputs, run_ns: u64::MAX }), region)
}

fn run(models: &Models) -> Result<Outputs, InferenceError> {
    let input = TensorBytes { place: place(&[1], 0), bytes: &[0; 4][..] };
    models.run("m", &[input], &Due::default())
}

/// Runs a model whose replies after the first two are `last`; returns the error.
#[track_caller]
fn refusal(last: Sent) -> String {
    let (models, serving) = models(vec![opened(), reserved(), last]);
    let Err(InferenceError::Unavailable(message)) = run(&models) else { panic!("no refusal") };
    drop(models);
    assert_eq!(serving.join().unwrap(), 3);
    message
}

#[test]
fn outputs_that_cannot_be_are_refused_before_memory_is_taken_for_them() {
    let invalid = "gleaner-inference sent an invalid reply";
    let large = (MEMORY / 4) as u32;
    for outputs in [
        vec![place(&[u32::MAX; 8], 0)],
        vec![place(&[1; 9], 0)],
        vec![place(&[large + 1], 0)],
        vec![place(&[large], 0), place(&[1], 0)],
        vec![place(&[1024], 0); 257],
    ] {
        assert_eq!(refusal(ran(outputs, Some(8192))), invalid);
    }
    assert_eq!(refusal(ran(vec![place(&[1], 0)], None)), invalid, "without a region");
    for offset in [8192, u64::MAX - 63, 1 << 63] {
        let message = refusal(ran(vec![place(&[1], offset)], Some(8192)));
        assert!(message.starts_with("cannot use the memory of gleaner-inference"), "{message}");
    }
}

#[test]
fn replies_to_other_calls_and_messages_that_are_no_replies_are_refused() {
    let invalid = "gleaner-inference sent an invalid reply";
    assert_eq!(refusal(opened()), invalid);
    assert_eq!(refusal(reserved()), invalid);
    for (bytes, reason) in [
        (b"{}".to_vec(), "is invalid"),
        (b"\xff\0".to_vec(), "is invalid"),
        (vec![b'['; MESSAGE_MAX], "is invalid"),
        (vec![b' '; MESSAGE_MAX + 1], "above the maximum of 65536"),
    ] {
        let message = refusal(Sent::Bytes(bytes));
        assert!(message.contains(reason), "{message}");
    }
    let without = Sent::Result(Ok(ModelResult::Reserved), None);
    let (models, serving) = models(vec![opened(), without]);
    assert_eq!(run(&models).err().map(|it| it.to_string()).as_deref(), Some(invalid));
    drop(models);
    serving.join().unwrap();
}

#[test]
fn a_reply_to_an_earlier_call_is_skipped_and_outputs_may_be_empty() {
    let late = ModelReply { id: 1, region: 9, result: Ok(ModelResult::Started) };
    let late = serde_json::to_vec(&late).unwrap();
    let (lambda, other) = ModelClient::pair().unwrap();
    let server = ModelSocket::new(other);
    let models = Models::new(Vec::new(), Some(lambda), MEMORY);
    let serving = thread::spawn(move || {
        let replies = [opened(), reserved(), ran(vec![place(&[0, 6], 0)], Some(4096))];
        for (index, reply) in (1..).zip(replies) {
            poll(&mut [PollFd::new(&server, PollFlags::IN)], None).unwrap();
            assert!(matches!(server.poll().unwrap(), Incoming::Message(it) if it.id == index));
            if index > 1 {
                send(&server, &late, SendFlags::empty()).unwrap();
            }
            let Sent::Result(result, bytes) = reply else { unreachable!() };
            let region = bytes.map(region);
            let reply = ModelReply { id: index, region: 1, result };
            server.reply(&reply, region.as_ref().map(AsFd::as_fd)).unwrap();
        }
    });
    let outputs = run(&models).unwrap();
    assert_eq!((outputs.len(), outputs[0].bytes.len()), (1, 0));
    serving.join().unwrap();
}

#[test]
fn a_model_that_waits_for_other_loads_has_its_time_once_its_own_begins() {
    let queued = || fault(ModelFaultKind::Queued);
    let slow = || fault(ModelFaultKind::TooSlow);
    for (replies, is_open) in [
        (vec![queued(), queued(), slow(), opened()], true),
        (vec![queued(), slow(), slow()], false),
        (vec![slow()], false),
    ] {
        let count = replies.len();
        let (models, serving) = models(replies);
        models.open_all(Duration::from_secs(60));
        assert_eq!(models.runtimes()[0] == "model `m`: rten", is_open, "{count} replies");
        drop(models);
        assert_eq!(serving.join().unwrap(), count);
    }
}

#[test]
fn a_start_of_the_process_without_its_end_makes_the_lambda_open_its_models_again() {
    let (lambda, other) = ModelClient::pair().unwrap();
    let (server, starter) = (ModelSocket::new(other.try_clone().unwrap()), other);
    let models = Models::new(Vec::new(), Some(lambda), MEMORY);
    let serving = thread::spawn(move || {
        for index in 1..=2 {
            poll(&mut [PollFd::new(&server, PollFlags::IN)], None).unwrap();
            assert!(matches!(server.poll().unwrap(), Incoming::Message(it) if it.id == index));
            let Sent::Result(result, _) = opened() else { unreachable!() };
            server.reply(&ModelReply { id: index, region: 0, result }, None).unwrap();
        }
    });
    let open = || models.lock().open("m", None).unwrap();
    open();
    report_state(&starter, None).unwrap();
    models.lock().connection.as_mut().unwrap().check_process(None).unwrap();
    open();
    serving.join().unwrap();
}

#[test]
fn the_runtimes_that_are_stated_are_those_of_all_processes() {
    let runs_on = |runtime: &str| {
        let (inputs, outputs, runtime) = (Vec::new(), Vec::new(), runtime.to_owned());
        Sent::Result(
            Ok(ModelResult::Opened { inputs, outputs, runtime, metadata: Vec::new() }),
            None,
        )
    };
    let unloadable = fault(ModelFaultKind::Failed);
    let (models, serving) =
        models(vec![unloadable, runs_on("onnxruntime, cuda"), runs_on("rten"), runs_on("rten")]);
    models.open_all(Duration::from_secs(60));
    assert_eq!(models.runtimes(), ["model `m`: none"]);
    for _ in 0..3 {
        models.open("m", &Due::default()).unwrap();
        // As after an end of the process.
        models.lock().connection.as_mut().unwrap().opened.clear();
    }
    assert_eq!(models.runtimes(), ["model `m`: onnxruntime, cuda, then rten"]);
    drop(models);
    serving.join().unwrap();
}

#[test]
fn a_run_that_is_too_slow_names_its_state_and_model_time() {
    let (models, serving) = models(vec![opened(), reserved(), fault(ModelFaultKind::TooSlow)]);
    models.limit(Some(Duration::from_secs(60)));
    let Err(InferenceError::TooSlow(message)) = run(&models) else { panic!("no refusal") };
    let begin = "a reason: the models of this wake, at last `m`, took longer than the 60s of";
    assert!(message.starts_with(begin), "{message}");
    drop(models);
    serving.join().unwrap();
}

#[test]
fn calls_of_a_guest_without_due_times_end_with_its_call() {
    let (lambda, _other) = ModelClient::pair().unwrap();
    let entry = ModelEntry { name: "m".to_owned(), layout: None, labels: Vec::new() };
    let models = Models::new(vec![entry], Some(lambda), MEMORY);
    models.end_with(Some(CallTime::begin(Duration::ZERO)));
    let opened = models.open("m", &Due::default());
    assert!(matches!(opened, Err(InferenceError::OutOfTime)), "nothing replies");
}

//! Lambdas that break the protocol lose their connection; others are served.

use std::os::fd::{AsFd, OwnedFd};
use std::time::{Duration, Instant};

use gleaner_protocol::inference::{
    MAX_TENSOR_BYTES, MESSAGE_MAX, ModelCall, ModelClient, ModelFaultKind, ModelReply, ModelRequest,
};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::net::{RecvFlags, SendFlags, recv, send};

use crate::support::{ModelProgram, ModelUser, TestModel, fault, floats, granted};
use gleaner_test_support::onnx::{ANY, FLOAT32, endless, product, unary};

fn models() -> Vec<TestModel> {
    vec![granted("product", product()), granted("endless", endless(&[ANY]))]
}

fn open() -> ModelCall {
    ModelCall::Open { model: "product".to_owned() }
}

fn request(id: u64, call: ModelCall) -> Vec<u8> {
    let request = ModelRequest { id, deadline_ns: None, regions: [0; 2], call };
    serde_json::to_vec(&request).unwrap()
}

/// Waits until the program has closed the connection.
#[track_caller]
fn is_closed(socket: &OwnedFd) {
    let until = Instant::now() + Duration::from_secs(60);
    loop {
        let second = Timespec { tv_sec: 1, tv_nsec: 0 };
        let fd = socket.as_fd();
        let mut polled = [PollFd::new(&fd, PollFlags::IN)];
        poll(&mut polled, Some(&second)).unwrap();
        match recv(socket, &mut [0; MESSAGE_MAX][..], RecvFlags::DONTWAIT) {
            Ok((_, 0)) => return,
            Ok(_) => {}
            Err(rustix::io::Errno::AGAIN) => {}
            Err(_) => return,
        }
        assert!(Instant::now() < until, "the connection is still open");
    }
}

#[test]
fn messages_that_are_no_calls_close_the_connection() {
    let program = ModelProgram::start(&[]);
    for garbage in [
        b"{}".to_vec(),
        b"\xff\xfe\0".to_vec(),
        vec![b'['; MESSAGE_MAX],
        vec![b'x'; MESSAGE_MAX + 1],
        request(0, open()),
        br#"{"id":1,"deadline_ns":null,"call":{"run":{"model":"m","inputs":[{"name":"x"}]}}}"#
            .to_vec(),
        br#"{"id":1,"deadline_ns":-1,"call":{"reserve":{"bytes":1e30}}}"#.to_vec(),
    ] {
        let socket = program.connect("hostile", &models());
        send(&socket, &garbage, SendFlags::NOSIGNAL).unwrap();
        is_closed(&socket);
    }
    let socket = program.connect("repeats", &models());
    for _ in 0..2 {
        send(&socket, &request(2, open()), SendFlags::NOSIGNAL).unwrap();
    }
    is_closed(&socket);
    program.serves();
}

#[test]
fn a_newer_call_replaces_the_one_before() {
    let program = ModelProgram::start(&["--run-max", "60"]);
    let socket = program.connect("impatient", &models());
    let mut lambda = ModelUser::new(socket.try_clone().unwrap());
    lambda.open("product").unwrap();
    for id in 100..130 {
        send(&socket, &request(id, open()), SendFlags::NOSIGNAL).unwrap();
    }
    // Its replies are read, and the last call has one.
    let last = std::iter::repeat_with(|| {
        let mut bytes = vec![0; MESSAGE_MAX];
        let (length, _) = recv(&socket, &mut *bytes, RecvFlags::empty()).unwrap();
        serde_json::from_slice::<ModelReply>(&bytes[..length]).unwrap()
    });
    assert!(last.into_iter().find(|reply| reply.id == 129).unwrap().result.is_ok());
    program.serves();
}

#[test]
fn a_lambda_that_does_not_read_its_replies_is_disconnected() {
    let program = ModelProgram::start(&[]);
    let socket = program.connect("deaf", &models());
    let fails = |id: u64| {
        let bytes = request(id, ModelCall::Reserve { bytes: 64 });
        send(&socket, &bytes, SendFlags::NOSIGNAL).is_err()
    };
    assert!((1..100_000).any(fails), "all calls were read");
    program.serves();
}

#[test]
fn a_lambda_that_ends_while_it_waits_leaves_nothing_behind() {
    let program = ModelProgram::start(&[]);
    for _ in 0..20 {
        let mut lambda = program.lambda("short", &models());
        lambda.open("product").unwrap();
        let inputs = lambda.place(&[floats("x", &[1, 3], &[2.0; 3])]);
        let call = ModelCall::Run { model: "product".to_owned(), inputs };
        let _ = lambda.client.call(call, None, Some(Instant::now()));
    }
    for _ in 0..20 {
        let mut lambda = program.lambda("early", &models());
        let _ = lambda.client.call(open(), None, Some(Instant::now()));
    }
    program.serves();
    let status = program.status(|status| status.clients == 0 && status.waiting == 0);
    assert_eq!(status.models.len(), 1, "it is kept for a while");
}

#[test]
fn hostile_offsets_and_lengths_are_refused() {
    let program = ModelProgram::start(&[]);
    let mut lambda = program.lambda("hostile", &models());
    lambda.open("product").unwrap();
    for bytes in [0, MAX_TENSOR_BYTES + 1, u64::MAX] {
        fault(ModelFaultKind::WrongInput, lambda.reserve(bytes));
    }
    let input = floats("x", &[1, 3], &[1.0; 3]);
    // Without a region.
    fault(ModelFaultKind::WrongInput, lambda.run_at("product", vec![input.place(0)], None));
    lambda.reserve(128).unwrap();
    for offset in [1, 64 + 63, 4096, u64::MAX - 63, u64::MAX] {
        let ran = lambda.run_at("product", vec![input.place(offset)], None);
        fault(ModelFaultKind::WrongInput, ran);
    }
    for shape in [vec![u32::MAX, 3], vec![0, 3], vec![1 << 30, 3], vec![400, 3], vec![3; 9]] {
        let place = gleaner_protocol::inference::TensorPlace { shape, ..input.place(0) };
        let ran = lambda.run_at("product", vec![place], None);
        fault(ModelFaultKind::WrongInput, ran);
    }
    let many: Vec<_> = (0..500).map(|_| input.place(0)).collect();
    fault(ModelFaultKind::WrongInput, lambda.run_at("product", many, None));
    let long = "n".repeat(40_000);
    fault(ModelFaultKind::NoSuchModel, lambda.open(&long));
    // Escaped, each has 6 bytes. The reply repeats the name, and would exceed a message.
    let controls = "\u{1}".repeat((MESSAGE_MAX - 85) / 6);
    fault(ModelFaultKind::Failed, lambda.open(&controls));
    lambda.reserve(64).unwrap();
    assert_eq!(lambda.run("product", &[input]).unwrap()[0].floats(), [9.0, 12.0]);
}

#[test]
fn a_lambda_cannot_change_the_size_of_its_region() {
    let program = ModelProgram::start(&[]);
    let mut lambda = program.lambda("hostile", &[granted("relu", unary("Relu", FLOAT32, &[1]))]);
    let (_, region) = lambda.call(ModelCall::Reserve { bytes: 4096 }, None);
    let region = std::fs::File::from(region.unwrap());
    for size in [0, 64, 8192] {
        assert!(region.set_len(size).is_err(), "{size}");
    }
}

#[test]
fn log_lines_that_are_not_read_delay_nothing_and_are_counted() {
    let mut program = ModelProgram::start(&[]);
    // Each makes a log line with its name; the pipe of standard error holds 64 KiB.
    let breaks_the_protocol = |index: usize| {
        let lambda = program.connect(&format!("{index}-{}", "x".repeat(4000)), &[]);
        send(&lambda, b"{}", SendFlags::empty()).unwrap();
        is_closed(&lambda);
    };
    (0..40).for_each(breaks_the_protocol);
    program.serves();
    let unread = program.unread_log();
    assert!(unread.contains("connection to a lambda closed"), "{unread}");
    breaks_the_protocol(40);
    drop(program.control.take());
    let (status, log) = program.end();
    assert!(status.success(), "{status} {log}");
    assert!(log.contains("standard error was not read dropped="), "{log}");
}

#[test]
fn calls_of_a_lambda_beyond_the_maximum_fail_with_the_reason() {
    let program = ModelProgram::start(&[]);
    let (_first, socket) = ModelClient::pair().unwrap();
    (0..512).for_each(|_| program.add("one of many", &[], &socket));
    let mut last = program.lambda("last", &models()[..1]);
    let message = fault(ModelFaultKind::Unavailable, last.open("product"));
    assert!(message.contains("serves 512 lambdas, and this one came later"), "{message}");
}

//! The process ends: at a stop, with its starter, and by models that take too much.

use std::os::unix::process::ExitStatusExt;
use std::time::Duration;

use gleaner_protocol::inference::{
    ModelCall, ModelClient, ModelFaultKind, ModelWait, report_state,
};

use crate::support::{
    ModelProgram, ModelUser, fault, floats, granted, in_future, integers, wait_for,
};
use gleaner_test_support::onnx::{ANY, as_many_as_requested, endless, product};

#[test]
fn an_endless_model_is_answered_at_the_deadline_and_ends_the_process_which_names_it() {
    let mut program = ModelProgram::start(&["--run-max", "2"]);
    let models = [granted("endless", endless(&[ANY])), granted("product", product())];
    let (lambda, other_end) = ModelClient::pair().unwrap();
    program.add("stuck", &models, &other_end);
    let mut lambda = ModelUser::new(lambda);
    lambda.open("endless").unwrap();
    let input = floats("x", &[1], &[1.0]);
    let slow = lambda.run_until("endless", &[input], Some(Duration::from_secs(1)));
    fault(ModelFaultKind::TooSlow, slow);
    assert_eq!(program.in_use(), [None, Some(models[0].grant.sha256.clone())]);
    let (status, errors) = program.end();
    assert_eq!(status.code(), Some(6), "{errors}");
    assert!(
        errors.contains("model `endless.onnx` of lambda `stuck` has run for more than 2 s"),
        "{errors}"
    );
    assert_eq!(program.in_use()[1], Some(models[0].grant.sha256.clone()));

    // Its successor serves the same socket.
    report_state(&other_end, Some("it has ended")).unwrap();
    let lost = lambda.call(ModelCall::Open { model: "product".to_owned() }, None).0;
    assert_eq!(fault(ModelFaultKind::Unavailable, lost), "it has ended");
    let successor = ModelProgram::start(&[]);
    successor.add("stuck", &models, &other_end);
    lambda.open("product").unwrap();
    lambda.reserve(64).unwrap();
    let outputs = lambda.run("product", &[floats("x", &[1, 3], &[1.0; 3])]).unwrap();
    assert_eq!(outputs[0].floats(), [9.0, 12.0]);
    assert_eq!(successor.in_use(), [None, None]);
}

#[test]
fn a_model_whose_first_run_is_endless_ends_the_process_too() {
    let mut program = ModelProgram::start(&["--run-max", "2"]);
    let model = granted("endless", endless(&[1]));
    let mut lambda = program.lambda("stuck", std::slice::from_ref(&model));
    let slow = lambda.open_until("endless", Some(Duration::from_secs(1)));
    let message = fault(ModelFaultKind::TooSlow, slow);
    assert_eq!(message, "model `endless` is still being loaded at the deadline");
    let (status, errors) = program.end();
    assert_eq!(status.code(), Some(6), "{errors}");
    assert_eq!(program.in_use(), [Some(model.grant.sha256), None]);
}

#[test]
fn a_model_that_takes_too_much_memory_ends_the_process_which_names_it() {
    let mut program = ModelProgram::start(&["--memory", "500000000"]);
    let model = granted("huge", as_many_as_requested());
    let mut lambda = program.lambda("greedy", std::slice::from_ref(&model));
    lambda.open("huge").unwrap();
    let small = lambda.run("huge", &[integers("x", &[1], &[3])]).unwrap();
    assert_eq!(small[0].floats(), [0.0; 3]);
    // 8 GB.
    let inputs = lambda.place(&[integers("x", &[1], &[2_000_000_000])]);
    let call = ModelCall::Run { model: "huge".to_owned(), inputs };
    let until = Some(std::time::Instant::now() + Duration::from_secs(60));
    let reply = lambda.client.call(call, None, until);
    assert!(!matches!(reply, Ok(ModelWait::Reply(..))), "{reply:?}");
    let (status, errors) = program.end();
    assert!(status.signal().is_some(), "{status} {errors}");
    assert_eq!(program.in_use(), [None, Some(model.grant.sha256)]);
}

#[test]
fn outputs_beyond_the_largest_size_fail_one_run_only() {
    let program = ModelProgram::start(&[]);
    let mut lambda = program.lambda("large", &[granted("huge", as_many_as_requested())]);
    lambda.open("huge").unwrap();
    let large = lambda.run("huge", &[integers("x", &[1], &[(64 << 20) + 1])]);
    assert!(fault(ModelFaultKind::Failed, large).contains("268435456"));
    // They are not kept for the next request.
    program.status(|status| status.resident_bytes < 128 << 20);
    assert_eq!(lambda.run("huge", &[integers("x", &[1], &[2])]).unwrap()[0].floats(), [0.0; 2]);
}

#[test]
fn the_process_ends_with_its_starter_at_a_signal_and_while_a_model_runs() {
    let mut program = ModelProgram::start(&[]);
    program.control = None;
    assert!(program.end().0.success(), "the starter has ended");
    let mut program = ModelProgram::start(&[]);
    let mut lambda = program.lambda("stuck", &[granted("endless", endless(&[ANY]))]);
    lambda.open("endless").unwrap();
    let inputs = lambda.place(&[floats("x", &[1], &[1.0])]);
    let call = ModelCall::Run { model: "endless".to_owned(), inputs };
    let deadline = Some(in_future(Duration::from_secs(1)));
    lambda.client.call(call, deadline, None).unwrap();
    wait_for(|| program.in_use()[1].clone());
    let pid = rustix::process::Pid::from_raw(program.id() as i32).unwrap();
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    let (status, errors) = program.end();
    assert!(status.success(), "{status} {errors}");
}

#[test]
fn the_process_is_sandboxed_before_it_serves_a_lambda() {
    let program = ModelProgram::start(&["--memory", "300000000"]);
    let mut lambda = program.lambda("any", &[granted("product", product())]);
    lambda.open("product").unwrap();
    let of =
        |file: &str| std::fs::read_to_string(format!("/proc/{}/{file}", program.id())).unwrap();
    let status = of("status");
    assert!(status.contains("Seccomp:\t2\n") && status.contains("NoNewPrivs:\t1\n"), "{status}");
    let limit = of("limits");
    let limit = limit.lines().find(|line| line.starts_with("Max data size")).unwrap();
    assert!(!limit.contains("unlimited"), "{limit}");
}

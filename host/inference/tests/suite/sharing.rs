//! Lambdas share models, runs and the order of runs.

use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use gleaner_protocol::inference::{
    InferenceReport, ModelCall, ModelFaultKind, ModelMemory, ModelWait,
};

use crate::support::{
    ModelProgram, ModelUser, TestModel, digest, fault, floats, granted, in_future, wait_for,
};
use gleaner_test_support::onnx::{
    ANY, FLOAT32, constant, endless, graph, model, node, product, unary, value,
};

/// A model that takes some ms for 8 products of large matrices.
fn slow_of(products: usize) -> TestModel {
    let size = 400;
    let last = format!("v{products}");
    let nodes: Vec<_> = (0..products)
        .map(|index| {
            let (from, to) = (format!("v{index}"), format!("v{}", index + 1));
            node("MatMul", &[&from, &from], &[&to], &[])
        })
        .collect();
    granted(
        "slow",
        model(&graph(
            &nodes,
            &[],
            &[value("v0", FLOAT32, &[size, size])],
            &[value(&last, FLOAT32, &[size, size])],
        )),
    )
}

fn slow_input(seed: usize) -> crate::support::TestTensor {
    let mut values = vec![0.0; 400 * 400];
    values[seed % 1000] = seed as f32;
    floats("v0", &[400, 400], &values)
}

#[test]
fn two_lambdas_share_a_model_and_the_run_on_the_same_frame() {
    let program = ModelProgram::start(&[]);
    let mut lambdas = ["one", "two"].map(|name| program.lambda(name, &[granted(name, product())]));
    let input = floats("x", &[2, 3], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    let mut results = Vec::new();
    for (lambda, name) in lambdas.iter_mut().zip(["one", "two"]) {
        lambda.open(name).unwrap();
        results.push((lambda.run(name, std::slice::from_ref(&input)).unwrap(), lambda.run_ns));
    }
    assert_eq!(results[0], results[1]);
    // Another frame, and the first one again.
    lambdas[0].run("one", &[floats("x", &[2, 3], &[0.0; 6])]).unwrap();
    assert_eq!(lambdas[1].run("two", &[input]).unwrap(), results[0].0);
    let last = program.stop();
    assert_eq!(last.models.len(), 1);
    let model = &last.models[0];
    assert_eq!((model.runs, model.shared, model.lambdas.len()), (3, 1, 2));
}

#[test]
fn other_options_are_another_session() {
    let program = ModelProgram::start(&[]);
    let mut two = granted("two", product());
    two.grant.threads = Some(2);
    let mut lambda = program.lambda("options", &[granted("one", product()), two]);
    assert_eq!(lambda.open("one").unwrap().runtime, "rten 0.27.0, cpu, 1 thread");
    assert_eq!(lambda.open("two").unwrap().runtime, "rten 0.27.0, cpu, 2 threads");
    assert_eq!(program.status(|status| status.models.len() == 2).clients, 1);
}

#[test]
fn a_lambda_that_always_runs_does_not_starve_another() {
    let program = ModelProgram::start(&[]);
    let ends = AtomicBool::new(false);
    let counts = [(); 2].map(|()| AtomicUsize::new(0));
    let mut patient = program.lambda("patient", &[slow_of(8)]);
    patient.open("slow").unwrap();
    std::thread::scope(|scope| {
        for (index, count) in counts.iter().enumerate() {
            let (ends, mut flood) = (&ends, program.lambda("flood", &[slow_of(8)]));
            scope.spawn(move || {
                flood.open("slow").unwrap();
                let mut seed = index * 100_000;
                while !ends.load(Ordering::Relaxed) {
                    seed += 1;
                    let deadline = Some(Duration::from_secs(30));
                    flood.run_until("slow", &[slow_input(seed)], deadline).unwrap();
                    count.fetch_add(1, Ordering::Relaxed);
                }
            });
        }
        let sum = || counts.iter().map(|count| count.load(Ordering::Relaxed)).sum::<usize>();
        while sum() < 10 {
            std::thread::sleep(Duration::from_millis(1));
        }
        // By their deadlines alone, the others would always come first, and this would never end.
        for seed in 0..5 {
            patient.run("slow", &[slow_input(900_000 + seed)]).unwrap();
        }
        ends.store(true, Ordering::Relaxed);
    });
}

#[test]
fn models_are_loaded_and_run_beside_a_run_that_does_not_end() {
    let program = ModelProgram::start(&[]);
    let mut stuck = program.lambda("stuck", &[granted("endless", endless(&[ANY]))]);
    stuck.open("endless").unwrap();
    let soon = Some(Duration::from_millis(500));
    let message = fault(
        ModelFaultKind::TooSlow,
        stuck.run_until("endless", &[floats("x", &[1], &[1.0])], soon),
    );
    assert_eq!(message, "model `endless` is still running at the deadline");
    let mut other = program.lambda("other", &[granted("relu", unary("Relu", FLOAT32, &[1]))]);
    other.open("relu").unwrap();
    other.run("relu", &[floats("x", &[1], &[1.0])]).unwrap();
    assert_eq!(program.in_use(), [None, Some(digest(&endless(&[ANY])))]);
}

#[test]
fn a_model_is_loaded_after_its_trial_and_refused_if_that_failed_or_it_does_not_fit() {
    let program = ModelProgram::start(&["--trials", "--memory", "1048576000"]);
    let one = |name: &str, op| granted(name, unary(op, FLOAT32, &[1]));
    let models = [granted("product", product()), one("relu", "Relu"), one("late", "Neg")];
    let mut lambda = program.lambda("any", &models);
    let mut opened = |name: &str, refused: Option<&str>, mib: u64| {
        let (name, lambda) = (name.to_owned(), &mut lambda);
        std::thread::scope(|scope| {
            let opens = scope.spawn(move || lambda.open(&name));
            let load = program.report(|report| match report {
                InferenceReport::Try(load) => Some(load),
                _ => None,
            });
            assert_eq!(program.in_use(), [None, None]);
            let memory = ModelMemory { held: mib << 20, peak: mib << 20 };
            program.control.as_ref().unwrap().tried(&load, refused, memory).unwrap();
            opens.join().unwrap()
        })
    };
    let message = fault(ModelFaultKind::Failed, opened("product", Some("it ended its process"), 0));
    assert_eq!(message, "it ended its process");
    // The first one may take all of the 1000 MiB.
    opened("product", None, 900).expect("it is tried again");
    let message = fault(ModelFaultKind::Failed, opened("relu", None, 800));
    let begin = "model `relu.onnx` of lambda `any`: gleaner-inference may take 1000 MiB; ";
    let numbers = "900 MiB of them by `product.onnx`; this model takes 800 MiB, and 250 MiB are";
    assert!(message.starts_with(begin) && message.contains(numbers), "{message}");
    opened("relu", None, 100).unwrap();
    lambda.run("product", &[floats("x", &[1, 3], &[1.0; 3])]).expect("no process has ended");
    let late = lambda.open_until("late", Some(Duration::from_millis(500)));
    let message = fault(ModelFaultKind::Queued, late);
    assert_eq!(message, "model `late` waits for the trial of its load at the deadline");
}

#[test]
fn the_memory_that_a_model_takes_is_measured() {
    let weights = constant("w", FLOAT32, &[8 << 20], &vec![0; 32 << 20]);
    let (x, y) = (value("x", FLOAT32, &[1]), value("y", FLOAT32, &[8 << 20]));
    let sum = model(&graph(&[node("Add", &["x", "w"], &["y"], &[])], &[weights], &[x], &[y]));
    let program = ModelProgram::start(&[]);
    program.lambda("any", &[granted("sum", sum)]).open("sum").unwrap();
    let taken = program.loaded().memory;
    assert!((32..128).contains(&(taken.held >> 20)) && taken.peak >= taken.held, "{taken:?}");
}

/// Run it on two cores, with a release build: `taskset -c 0,1 cargo test --release
/// -p gleaner-inference --test suite -- --ignored --nocapture`.
#[test]
#[ignore = "it measures for 34 s: it needs two cores, a release build and no other load"]
fn a_hostile_model_of_2_s_costs_a_victim_with_400_ms_no_run() {
    let mut program = ModelProgram::start(&[]);
    let mut victim = program.lambda("victim", &[slow_of(8)]);
    victim.open("slow").unwrap();
    victim.run("slow", &[slow_input(1)]).unwrap();
    let products = 8 * 2_000_000_000 / usize::try_from(victim.run_ns).unwrap();
    program.demand = Some(1_000_000);
    let mut hostile = program.lambda("hostile", &[slow_of(products)]);
    hostile.open("slow").unwrap();
    let (ends, mut failed) = (AtomicBool::new(false), 0);
    let runs = std::thread::scope(|scope| {
        let runs = scope.spawn(|| {
            let mut runs = 0;
            while !ends.load(Ordering::Relaxed) {
                let deadline = Some(Duration::from_secs(8));
                hostile.run_until("slow", &[slow_input(2 * runs)], deadline).unwrap();
                runs += 1;
            }
            runs
        });
        for seed in 0..170 {
            let next = Instant::now() + Duration::from_millis(200);
            let deadline = Some(Duration::from_millis(400));
            failed +=
                u32::from(victim.run_until("slow", &[slow_input(2 * seed + 1)], deadline).is_err());
            std::thread::sleep(next.saturating_duration_since(Instant::now()));
        }
        ends.store(true, Ordering::Relaxed);
        runs.join().unwrap()
    });
    println!("the hostile model ran {runs} times, the victim lost {failed} of 170 runs");
    assert!(failed == 0 && runs >= 8, "{failed} failed beside {runs} runs");
}

#[test]
fn a_request_that_comes_after_its_deadline_is_not_run() {
    let program = ModelProgram::start(&[]);
    let mut lambda = program.lambda("late", &[granted("relu", unary("Relu", FLOAT32, &[1]))]);
    lambda.open("relu").unwrap();
    let inputs = lambda.place(&[floats("x", &[1], &[1.0])]);
    let call = ModelCall::Run { model: "relu".to_owned(), inputs };
    // The first ns of this machine.
    let Ok(ModelWait::Reply(reply, _)) = lambda.client.call(call, Some(1), None) else {
        panic!("no reply")
    };
    fault(ModelFaultKind::TooSlow, reply.result);
    let last = program.stop();
    assert_eq!((last.models[0].runs, last.models[0].failed), (0, 1));
}

#[test]
fn a_model_waits_for_the_load_of_another_one_which_its_error_names() {
    let program = ModelProgram::start(&[]);
    let endless = granted("endless", endless(&[1]));
    let mut stuck = program.lambda("stuck", std::slice::from_ref(&endless));
    // It is sent, and its reply is not awaited.
    let call = ModelCall::Open { model: "endless".to_owned() };
    stuck.client.call(call, None, Some(Instant::now())).unwrap();
    wait_for(|| program.in_use()[0].clone());
    let mut other = program.lambda("other", &[granted("relu", unary("Relu", FLOAT32, &[1]))]);
    let late = other.open_until("relu", Some(Duration::from_millis(200)));
    assert_eq!(
        fault(ModelFaultKind::Queued, late),
        "model `relu` waits for the load of `endless.onnx` of lambda `stuck` at the deadline"
    );
}

#[test]
fn the_model_with_the_earliest_deadline_is_loaded_first() {
    let program = ModelProgram::start(&[]);
    // Its load lasts until the other calls have arrived.
    let mut slow = program.lambda("slow", &[slow_of(200)]);
    let mut patient = program.lambda("patient", &[granted("abs", unary("Abs", FLOAT32, &[1]))]);
    let mut urgent = program.lambda("urgent", &[granted("relu", unary("Relu", FLOAT32, &[1]))]);
    let send = |lambda: &mut ModelUser, model: &str, seconds| {
        let call = ModelCall::Open { model: model.to_owned() };
        let deadline = Some(in_future(Duration::from_secs(seconds)));
        lambda.client.call(call, deadline, Some(Instant::now())).unwrap();
    };
    send(&mut slow, "slow", 600);
    wait_for(|| program.in_use()[0].clone());
    send(&mut patient, "abs", 500);
    send(&mut urgent, "relu", 400);
    let order = [(); 3].map(|()| program.loaded().path);
    assert_eq!(order, ["slow.onnx", "relu.onnx", "abs.onnx"]);
}

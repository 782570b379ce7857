//! Scratch memory of a lambda: equal for both kinds, kept over faults, and empty at the begin of
//! each replay.

use gleaner_lambda::{Decision, FaultKind};
use gleaner_tests::{LambdaCopy, ReplayRun, replay, root, sample_drive};

fn keeper(args: &[&str]) -> ReplayRun {
    let [rust, python] = ["rust", "python"].map(|kind| {
        replay(
            &root().join("tests/lambdas/keeper").join(kind),
            &[sample_drive()],
            &[&["--all"], args].concat(),
        )
    });
    // The messages of faults differ, and only one of them counts fuel.
    let triggers = |run: &ReplayRun| {
        let decisions =
            run.decisions.iter().map(|decision| (decision.at_ns, decision.triggers.clone()));
        decisions.collect::<Vec<_>>()
    };
    assert_eq!(rust.decisions.len(), 399);
    assert_eq!(triggers(&rust), triggers(&python));
    assert!(
        python
            .decisions
            .iter()
            .zip(&rust.decisions)
            .all(|(a, b)| a.fault.is_some() == b.fault.is_some())
    );
    rust
}

/// Number of wakes, as counted by the lambda.
fn counted(decision: &Decision) -> u64 {
    decision.triggers.iter().find(|trigger| trigger.label == "kept").unwrap().score.unwrap() as u64
}

#[test]
fn scratch_survives_faults_and_its_limit_is_exact() {
    let run = keeper(&[]);
    for (n, decision) in (1..).zip(&run.decisions) {
        assert_eq!(counted(decision), n);
        let fault = decision.fault.as_ref().map(|fault| fault.kind);
        assert_eq!(fault, (n % 3 == 0).then_some(FaultKind::Exception));
        // 1 MiB, minus 8 bytes in `wakes` and the bytes of `bulk`, with names and 64 bytes for
        // each.
        let [first, .., last] = [&decision.triggers[0], decision.triggers.last().unwrap()];
        let bulk = last.attributes.get("bulk").map_or(0, |bytes| bytes.as_i64().unwrap());
        let names = if bulk > 0 { 64 + 4 } else { 0 };
        assert_eq!(last.attributes["free"].as_i64(), Some((1 << 20) - (64 + 5 + 8) - names - bulk));
        assert_eq!(first.label == "full", n % 11 == 0, "wake {n}");
        assert_eq!(bulk, i64::try_from(n % 11).unwrap() * 100_000);
    }
    let full = &run.decisions[10].triggers[0];
    let why = full.attributes["why"].as_str().unwrap();
    assert!(why.contains("`bulk` needs 100000 bytes of scratch and 48431 are free"), "{why}");
    assert_eq!(run.decisions[1].triggers[0].attributes["last"], "[2, 2]");
    // The second replay in a process begins with empty scratch, as the first did.
    let twice = replay(
        &root().join("tests/lambdas/keeper/rust"),
        &[sample_drive()],
        &["--all", "--repeat", "2"],
    );
    assert_eq!(twice.decisions.last().map(counted), Some(399));
}

#[test]
fn without_a_limit_in_the_manifest_there_is_no_scratch() {
    for kind in ["rust", "python"] {
        let lambda = LambdaCopy::of(&format!("tests/lambdas/keeper/{kind}"), |toml| {
            toml.replace("scratch = \"1 MiB\"\n", "")
        });
        let run = replay(lambda.path(), &[sample_drive()], &["--all"]);
        let (fault, why) = run.first_fault().unwrap();
        assert_eq!(fault, FaultKind::Exception);
        assert!(why.contains("`wakes` needs 77 bytes of scratch and 0 are free"), "{why}");
    }
}

//! Runs of the fake host: schedules, faults, back-off and time.

use std::rc::Rc;

use gleaner_sdk::testing::{Cause, FaultKind, Host, Message, Run};
use gleaner_sdk::{Error, event, input, now_ns};

use super::lambda::{Handler, TestLambda, imu, load, manifest, on_event};

const MS: i64 = 1_000_000;

fn ticking() -> Run<TestLambda> {
    let imu = "[[input]]\nname = \"imu\"\ntopic = \"/imu/data\"\ntype = \"sensor_msgs/msg/Imu\"\n";
    let host = Host::from_manifest(&manifest(&format!("[schedule]\nperiod = \"100ms\"\n{imu}")));
    load(host, |_| {
        Ok(Handler::Tick(Box::new(|tick| {
            assert_eq!(tick.at_ns, now_ns());
            event("tick", input("imu")?.last(99).len() as f64)
                .with("missed", tick.missed as i64)
                .send()
        })))
    })
    .unwrap()
}

fn at_ms(run: &Run<TestLambda>) -> Vec<i64> {
    run.decisions().iter().map(|decision| decision.at_ns / MS).collect()
}

#[test]
fn ticks_run_before_a_later_message_and_after_one_of_the_same_instant() {
    let mut run = ticking();
    for at in [1000, 1100, 1350] {
        run.deliver("imu", at * MS, Message::new()).unwrap();
    }
    assert_eq!(at_ms(&run), [1100, 1200, 1300]);
    let seen = run.triggers().map(|trigger| trigger.score.unwrap()).collect::<Vec<_>>();
    assert_eq!(seen, [2.0, 2.0, 2.0]);
    assert_eq!(run.pass_to(1400 * MS).unwrap().len(), 1);
    assert!(
        run.decisions()
            .iter()
            .all(|decision| decision.cause == Cause::Tick && decision.seq.is_none())
    );
}

#[test]
fn time_advances_without_messages_and_the_ticks_of_a_long_gap_are_missed() {
    let mut run = ticking();
    run.pass_to(0).unwrap();
    run.pass_to(300 * MS).unwrap();
    assert_eq!(at_ms(&run), [100, 200, 300]);
    // More than 100,000 missed ticks are counted, not run.
    assert!(run.pass_to(20_000_000 * MS).unwrap().is_empty());
    assert_eq!(run.missed_ticks(), 199_997);
    let late = run.pass_to(20_000_100 * MS).unwrap();
    let missed = late[0].triggers[0].attribute("missed").cloned();
    assert_eq!(missed, Some(gleaner_sdk::testing::AttributeValue::Signed(199_997)));
}

#[test]
fn triggers_before_a_fault_count_and_the_next_wake_has_a_fresh_instance() {
    let mut inits = 0;
    let mut run = load(imu("", ""), move |_| {
        inits += 1;
        let made = inits;
        Ok(Handler::Event(Box::new(move |sample| {
            event("seen", f64::from(made)).send()?;
            match sample.identity().seq {
                1 => Err(Error::new("an error")),
                2 => panic!("a panic of {made}"),
                _ => Ok(()),
            }
        })))
    })
    .unwrap();
    for n in 0..3 {
        run.deliver("imu", n, Message::new()).unwrap();
        assert_eq!(run.lambda().is_some(), n == 2);
    }
    let scores = run.triggers().map(|trigger| trigger.score.unwrap()).collect::<Vec<_>>();
    assert_eq!(scores, [1.0, 2.0, 3.0]);
    let faults = run.faults().map(|fault| (fault.kind, fault.message.as_str())).collect::<Vec<_>>();
    assert_eq!(
        faults,
        [(FaultKind::Exception, "an error"), (FaultKind::Trap, "panicked: a panic of 2")]
    );
    assert!(run.log()[0].message.contains("re-initialised after a fault"));
}

#[test]
fn after_eight_faults_in_a_row_the_lambda_backs_off() {
    let mut run = on_event(imu("", ""), |_| Err(Error::new("again")));
    for n in 0..40 {
        run.deliver("imu", n * 10 * MS, Message::new()).unwrap();
    }
    // The eighth fault is at 70 ms, the next at 170 ms; then the back-off doubles.
    assert_eq!(at_ms(&run), [0, 10, 20, 30, 40, 50, 60, 70, 170, 370]);
    assert_eq!(run.backed_off(), 30);
    assert!(run.log().iter().any(|line| line.message.contains("faulted 8 times in a row")));
}

#[test]
fn an_error_in_init_fails_the_load_and_later_the_wake() {
    let refused =
        load(imu("", ""), |_| event("early", 1.0).send().map(|()| unreachable!())).err().unwrap();
    let message = refused.to_string();
    assert!(
        message.starts_with(
            "cannot start lambda `probe`\n  cause: in init: triggers belong to a wake"
        ),
        "{message}"
    );
    let mut inits = 0;
    let mut run = load(imu("", ""), move |_| {
        inits += 1;
        if inits == 2 {
            return Err(Error::new("not twice"));
        }
        Ok(Handler::Event(Box::new(|_| Err(Error::new("never")))))
    })
    .unwrap();
    for n in 0..3 {
        run.deliver("imu", n, Message::new()).unwrap();
    }
    let faults = run.faults().map(|fault| fault.message.as_str()).collect::<Vec<_>>();
    assert_eq!(faults, ["never", "in init: not twice", "never"]);
}

#[test]
fn an_invalid_delivery_is_an_error_without_effect() {
    let mut run = on_event(imu("", ""), |_| Ok(()));
    run.deliver("imu", 10, Message::new().numbered(5)).unwrap();
    for (input, at_ns, message, wanted) in [
        ("imo", 10, Message::new(), "the manifest has `imu`"),
        ("imu", 9, Message::new(), "time cannot go back to 9 ns"),
        ("imu", 10, Message::new().numbered(5), "the previous message has the number 5"),
        ("imu", 10, Message::new().cdr([0; 3]), "its CDR is too short"),
        (
            "imu",
            10,
            Message::image(1, 1, gleaner_sdk::data::Encoding::Mono8, [0]),
            "it is an image, and the input is of",
        ),
    ] {
        let refused = run.deliver(input, at_ns, message).unwrap_err().to_string();
        assert!(refused.contains(wanted), "{refused}");
    }
    assert!(run.pass_to(9).is_err());
    let next = &run.deliver("imu", 10, Message::new()).unwrap()[0];
    assert_eq!(
        (next.seq, next.input.as_deref(), next.topic.as_deref()),
        (Some(6), Some("imu"), Some("/imu/data"))
    );
}

#[test]
fn two_runs_on_one_thread_are_independent() {
    let seen =
        || on_event(imu("", ""), |_| event("seen", input("imu")?.counts().received as f64).send());
    let (mut a, mut b) = (seen(), seen());
    a.deliver("imu", 5, Message::new()).unwrap();
    b.deliver("imu", 1, Message::new()).unwrap();
    a.deliver("imu", 6, Message::new()).unwrap();
    let scores = |run: &Run<TestLambda>| {
        run.triggers().map(|trigger| trigger.score.unwrap()).collect::<Vec<_>>()
    };
    assert_eq!((scores(&a), scores(&b)), (vec![1.0, 2.0], vec![1.0]));
}

#[test]
fn a_lambda_can_call_the_host_while_it_is_dropped() {
    struct Last(Rc<()>);
    impl Drop for Last {
        fn drop(&mut self) {
            gleaner_sdk::log::info("the last word");
            assert!(event("late", 1.0).send().is_err());
        }
    }
    let counted = Rc::new(());
    let held = Rc::clone(&counted);
    let mut run = load(imu("", ""), move |_| {
        let last = Last(Rc::clone(&held));
        Ok(Handler::Event(Box::new(move |_| {
            Err(Error::new(format!("{} hold it", Rc::strong_count(&last.0))))
        })))
    })
    .unwrap();
    run.deliver("imu", 0, Message::new()).unwrap();
    assert!(run.log().iter().any(|line| line.message == "the last word"));
    assert!(run.triggers().next().is_none());
}

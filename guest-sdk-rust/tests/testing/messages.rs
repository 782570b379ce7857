//! Messages and their fields, as a lambda reads them in the fake host.

use gleaner_sdk::data::{DataErrorKind, Value};
use gleaner_sdk::testing::{FaultKind, Message};
use gleaner_sdk::{Error, Result, Sample, input};

use super::lambda::{imu, on_event};

fn get(sample: &Sample, path: &str) -> Result<Value> {
    sample.get(&input("imu")?.field(path)?)
}

#[test]
fn fields_and_stamps_are_those_that_the_test_set() {
    let mut run = on_event(imu("", ""), |sample| {
        assert!(matches!(get(&sample, "a")?, Value::Real(-4.0)));
        assert!(matches!(get(&sample, "b")?, Value::Signed(-4)));
        assert!(matches!(get(&sample, "c")?, Value::Unsigned(4)));
        assert!(matches!(get(&sample, "d")?, Value::Boolean(true)));
        assert!(matches!(get(&sample, "e.f")?, Value::Text(text) if text == "link"));
        assert!(matches!(get(&sample, "cov")?, Value::Numbers(numbers) if numbers == [1.0, 2.0]));
        assert!(matches!(get(&sample, "cov[1]")?, Value::Real(2.0)));
        assert!(matches!(get(&sample, "raw")?, Value::Bytes(bytes) if bytes == [7, 8]));
        assert!(matches!(get(&sample, "names[0]")?, Value::Text(text) if text == "x"));
        assert_eq!(sample.number(&input("imu")?.field("d")?)?, 1.0);
        let (identity, stamps) = (sample.identity(), sample.stamps());
        assert_eq!((identity.topic.as_str(), identity.seq), ("/imu/data", 7));
        assert_eq!(
            (stamps.at_ns, stamps.publish_ns, stamps.header_ns),
            (30, 20, Some(-1_500_000_000))
        );
        assert!(matches!(get(&sample, "header.stamp.sec")?, Value::Signed(-2)));
        assert_eq!((sample.cdr(1, 2), sample.size(), sample.big_endian()), (vec![6, 7], 4, false));
        assert_eq!((sample.cdr(9, 2), sample.cdr(3, 99)), (vec![], vec![8]));
        Ok(())
    });
    let message = Message::new()
        .with("a", -4.0)
        .with("b", -4)
        .with("c", 4_u8)
        .with("d", true)
        .with("e.f", "link");
    let message =
        message.with("cov", [1.0, 2.0]).with("raw", vec![7_u8, 8]).with("names", ["x", "y"]);
    let message =
        message.stamped(-1_500_000_000).published(20).numbered(7).cdr([0, 1, 0, 0, 5, 6, 7, 8]);
    run.deliver("imu", 30, message).unwrap();
    assert_eq!((run.decisions().len(), run.faults().next()), (1, None));
}

#[test]
fn reading_a_missing_field_is_refused_by_name() {
    let mut run = on_event(imu("", ""), |sample| {
        let imu = input("imu")?;
        let error = sample.number(&imu.field("linear_aceleration.x")?).unwrap_err();
        assert!(error.is(DataErrorKind::NoSuchField));
        let error = imu.column(&imu.field("linear_aceleration.x")?, 1).unwrap_err();
        Err(error)
    });
    run.deliver("imu", 0, Message::new().with("linear_acceleration.x", 1.0)).unwrap();
    let fault = run.faults().next().unwrap();
    assert_eq!(fault.kind, FaultKind::Exception);
    assert!(
        fault
            .message
            .contains("no field `linear_aceleration.x`; did you mean `linear_acceleration.x`?"),
        "{fault:?}"
    );
}

#[test]
fn a_blank_message_defines_the_fields_and_their_defaults() {
    let blank = Message::new().with("x", 0.0).with("y", 5.0).with("name", "");
    let mut run = on_event(imu("", "").blank("imu", blank), |sample| {
        let imu = input("imu")?;
        let error = imu.field("z").err().ok_or(Error::new("there is a z"))?;
        assert!(error.is(DataErrorKind::NoSuchField));
        assert_eq!(
            [sample.number(&imu.field("x")?)?, sample.number(&imu.field("y")?)?],
            [2.0, 5.0]
        );
        let error =
            imu.column(&imu.field("name")?, 1).err().ok_or(Error::new("a name is a number"))?;
        assert!(error.is(DataErrorKind::WrongField));
        Ok(())
    });
    // A whole number is accepted for a number.
    run.deliver("imu", 0, Message::new().with("x", 2)).unwrap();
    assert_eq!(run.faults().next(), None);
    for (message, wanted) in [
        (
            Message::new().with("xx", 2.0),
            "`xx` is not in the blank message of this input; did you mean `x`?",
        ),
        (Message::new().with("name", 2.0), "`name` has another type than in the blank message"),
    ] {
        let refused = run.deliver("imu", 1, message).unwrap_err().to_string();
        assert!(refused.contains(wanted), "{refused}");
    }
    assert_eq!(run.decisions().len(), 1);
}

#[test]
fn reading_bytes_that_the_test_did_not_set_is_a_fault_that_asks_for_them() {
    let mut run = on_event(imu("", ""), |sample| {
        sample.cdr(0, 1);
        Ok(())
    });
    run.deliver("imu", 0, Message::new()).unwrap();
    let fault = run.faults().next().unwrap();
    assert_eq!(fault.kind, FaultKind::Trap);
    assert!(fault.message.contains("set them with `Message::cdr`"), "{fault:?}");
}

#[test]
fn a_call_that_would_return_more_than_its_limit_is_a_fault_that_names_the_way_on() {
    let mut run = on_event(imu("max_size = \"2 MiB\"", ""), |sample| {
        assert_eq!(sample.cdr(3, 1 << 20).len(), 1 << 20);
        sample.cdr(0, u32::MAX);
        Ok(())
    });
    run.deliver("imu", 0, Message::new().cdr(vec![0; 4 + 3 + (1 << 20)])).unwrap();
    let fault = run.faults().next().unwrap();
    assert_eq!(fault.kind, FaultKind::Trap);
    assert!(fault.message.contains("1048579 bytes of a sample of `/imu"), "{fault:?}");
    assert!(fault.message.contains("at most 1048576: read it in pieces"), "{fault:?}");
}

#[test]
fn fields_of_another_input_and_malformed_paths_are_refused() {
    let more = "[[input]]\nname = \"speed\"\ntopic = \"/speed\"\ntype = \"car/msg/Speed\"\n";
    let mut run = on_event(imu("", more), |sample| {
        let (imu, speed) = (input("imu")?, input("speed")?);
        let is = |error: Option<Error>, kind| error.is_some_and(|error| error.is(kind));
        assert!(is(sample.number(&speed.field("x")?).err(), DataErrorKind::WrongField));
        assert!(is(speed.column(&imu.field("x")?, 1).err(), DataErrorKind::WrongField));
        assert!(is(imu.field("a..b").err(), DataErrorKind::NoSuchField));
        assert!(is(imu.field(&"x".repeat(1025)).err(), DataErrorKind::WrongField));
        assert!(is(sample.as_frame().err(), DataErrorKind::NotAFrame));
        assert!(speed.newest().is_none());
        Ok(())
    });
    run.deliver("imu", 0, Message::new().with("x", 1.0)).unwrap();
    assert_eq!(run.faults().next(), None);
}

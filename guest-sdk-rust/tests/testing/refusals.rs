//! Errors and faults of the fake host, with their texts.

use gleaner_sdk::scratch::ScratchErrorKind;
use gleaner_sdk::testing::{FaultKind, Host, Message};
use gleaner_sdk::trigger::TriggerErrorKind;
use gleaner_sdk::{Error, event, input, log, scratch, stop};

use super::lambda::{TestLambda, imu, manifest, on_event};

#[test]
fn triggers_are_checked_and_counted() {
    let mut run = on_event(imu("", "[limits]\nevents_per_minute = 18"), |sample| {
        let refused = |result: gleaner_sdk::Result<()>| {
            result.err().map(|error| (error.kind().unwrap(), error.to_string()))
        };
        if sample.identity().seq == 1 {
            let (kind, why) = refused(event("", 1.0).send()).ok_or(Error::new("sent"))?;
            assert_eq!((kind, &*why), (TriggerErrorKind::Invalid.into(), "the label is empty"));
            let twice = refused(event("x", 1.0).with("k", 1.0).with("k", 2.0).send())
                .ok_or(Error::new("sent"))?;
            assert_eq!(twice.1, "attribute `k` of `x`: the key is given twice");
            assert!(refused(event("x", 1.0).with("k", f64::NAN).send()).is_some());
            assert!(refused(event("x", 1.0).with("k", "x".repeat(1025).as_str()).send()).is_some());
            let many = (0..17).fold(event("x", 1.0), |event, n| event.with(["k"; 17][n], n as i64));
            assert_eq!(
                refused(many.send()).ok_or(Error::new("sent"))?.1,
                "`x` has 17 attributes; at most 16 are allowed"
            );
        }
        for _ in 0..16 {
            event("x", 1.0).send()?;
        }
        assert!(event("x", 1.0).send().unwrap_err().is(TriggerErrorKind::TooMany));
        Ok(())
    });
    assert_eq!(run.deliver("imu", 0, Message::new()).unwrap()[0].triggers.len(), 16);
    // Two more in this minute; the next one is refused, and the lambda returns the error.
    let decision = &run.deliver("imu", 1, Message::new()).unwrap()[0];
    assert_eq!(decision.triggers.len(), 2);
    assert!(
        decision.fault.as_ref().unwrap().message.contains("18 triggers in this minute already")
    );
    assert_eq!(run.triggers_refused(), 1);
    let next_minute = run.deliver("imu", 60_000_000_000, Message::new()).unwrap();
    assert_eq!(next_minute[0].triggers.len(), 16);
}

#[test]
fn stop_is_accepted_after_the_limit_per_minute() {
    let mut run = on_event(imu("", "[limits]\nevents_per_minute = 1"), |_| {
        event("x", 1.0).send()?;
        stop("x")
    });
    assert_eq!(run.deliver("imu", 0, Message::new()).unwrap()[0].triggers.len(), 2);
    assert_eq!(run.faults().next(), None);
}

#[test]
fn lines_over_the_limit_are_dropped_and_counted_and_long_ones_are_truncated() {
    let mut run = on_event(imu("", "[limits]\nlog_lines = 3"), |_| {
        log::info(&"é".repeat(3000));
        (0..4).for_each(|n| log::debug(&format!("line {n}")));
        Ok(())
    });
    run.deliver("imu", 0, Message::new()).unwrap();
    run.deliver("imu", 1_000_000_000, Message::new()).unwrap();
    let lines = run.log();
    assert_eq!((lines.len(), run.log_dropped()), (6, 4));
    assert_eq!(
        (lines[0].message.len(), lines[0].level, lines[3].at_ns),
        (4096, log::Level::Info, 1_000_000_000)
    );
}

#[test]
fn scratch_keeps_entries_by_name_within_its_size() {
    let mut run = on_event(imu("", "[limits]\nscratch = \"1 KiB\""), |sample| {
        if sample.identity().seq == 1 {
            assert!(scratch::get("a", 0, 1).unwrap_err().is(ScratchErrorKind::NoSuchEntry));
            scratch::append("a", &[1, 2])?;
            scratch::append("a", &[3])?;
            return Err(Error::new("the entry survives this"));
        }
        assert_eq!(scratch::get("a", 1, 99)?, [2, 3]);
        assert_eq!(scratch::free(), 1024 - (64 + 1 + 3));
        let why = scratch::put("b", &[0; 900]).unwrap_err();
        assert!(why.is(ScratchErrorKind::NoRoom));
        assert!(
            why.to_string().contains("`b` needs 965 bytes of scratch and 956 are free"),
            "{why}"
        );
        // The size of a replaced entry is free again.
        scratch::put("a", &[0; 959])?;
        assert!(scratch::put("bad\u{7}name", &[]).unwrap_err().is(ScratchErrorKind::WrongName));
        assert_eq!(
            scratch::entries()
                .iter()
                .map(|entry| (entry.name.as_str(), entry.bytes))
                .collect::<Vec<_>>(),
            [("a", 959)]
        );
        scratch::remove("a")
    });
    run.deliver("imu", 0, Message::new()).unwrap();
    run.deliver("imu", 1, Message::new()).unwrap();
    let faults = run.faults().map(|fault| fault.message.as_str()).collect::<Vec<_>>();
    assert_eq!(faults, ["the entry survives this"]);
}

#[test]
fn more_handles_or_bytes_than_the_limits_allow_end_the_wake() {
    let mut run = on_event(imu("", "[limits]\nhandles = 16"), |sample| {
        if sample.identity().seq == 1 {
            let held = (0..16).map(|_| input("imu")).collect::<Vec<_>>();
            return Err(Error::new(format!("{} are held", held.len())));
        }
        event(&"x".repeat((1 << 20) + 1), 1.0).send()
    });
    let fault = run.deliver("imu", 0, Message::new()).unwrap()[0].fault.clone().unwrap();
    assert_eq!((fault.kind, fault.used, fault.allowed), (FaultKind::HostCall, Some(17), Some(16)));
    let fault = run.deliver("imu", 1, Message::new()).unwrap()[0].fault.clone().unwrap();
    assert_eq!((fault.kind, fault.allowed), (FaultKind::HostCall, Some(1 << 20)));
    assert!(fault.message.ends_with("at most 1 MiB in one call"), "{fault:?}");
}

#[test]
fn a_call_without_a_host_panics_with_the_way_out() {
    let panic = std::panic::catch_unwind(|| event("x", 1.0).send()).unwrap_err();
    let message = panic.downcast_ref::<&str>().copied().map(str::to_owned);
    let message = message.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap();
    assert!(message.contains("load the lambda with testing::Host"), "{message}");
}

#[test]
fn invalid_manifests_and_settings_are_refused_with_a_way_out() {
    let schedule = "[schedule]\nperiod = \"100ms\"\n";
    let input = "[[input]]\nname = \"a\"\ntopic = \"/a\"\ntype = \"a/msg/A\"\n";
    for (rest, wanted) in [
        ("", "the file has no `schedule`"),
        (
            "[schedule]\nperiod = \"0.1ms\"\n",
            "[schedule] has a `period` of \"0.1ms\"\n  help:  its range is",
        ),
        ("[schedule]\nperiod = 100\n", "for example \"50ms\""),
        ("[schedule]\nevent = \"b\"\n", "names no input: `b`"),
        (&format!("{schedule}{input}dept = 3\n"), "did you mean `depth`?"),
        (&format!("{schedule}{input}depth = 0\n"), "its range is 1 to 65536"),
        (&format!("{schedule}{input}{input}"), "two [[input]] with the name `a`"),
        (&format!("{schedule}{input}decoded_size = \"1 MiB\"\n"), "is not decoded"),
        (&format!("{schedule}[limits]\nfuel = 1\n"), "has a `fuel` of 1"),
        (
            &format!("{schedule}[limits]\nscratch = \"1 MB\"\n"),
            "a whole number and its unit, B, KiB, MiB or GiB",
        ),
        (
            &format!("{schedule}[config]\nx = {{ default = 1, max = 0 }}\n"),
            "config value `x` cannot be 1\n  cause: its max is 0",
        ),
        (&format!("{schedule}[config]\nx = [1]\n"), "has a `default` of an unsupported type"),
        ("x = ", "it is not valid TOML"),
    ] {
        let error = Host::from_manifest(&manifest(rest))
            .load::<TestLambda>()
            .err()
            .expect(rest)
            .to_string();
        assert!(error.contains(wanted), "{rest}: {error}");
    }
    let python = manifest(schedule).replace("\"wasm\"", "\"python\"");
    assert!(
        Host::from_manifest(&python)
            .load::<TestLambda>()
            .err()
            .unwrap()
            .to_string()
            .contains("kind = \"wasm\"")
    );
    let host = || imu("", "[config]\nrate = 1.0\ncount = 3\n");
    for (host, wanted) in [
        (host().set("rat", 1.0), "no config value `rat`\n  help:  did you mean `rate`?"),
        (
            host().set("count", 1.0),
            "config value `count` cannot be Real(1.0)\n  help:  use a whole number",
        ),
        (host().set("rate", f64::NAN), "use a finite number"),
        (host().blank("imo", Message::new()), "no input `imo` for a blank message"),
    ] {
        let error = host.load::<TestLambda>().err().unwrap().to_string();
        assert!(error.contains(wanted), "{error}");
    }
}

//! Repeated faults of a lambda do not change the host. `GLEANER_FAULTS` sets their number.

use std::sync::Arc;

use crate::greedy::{TestGuest, component, limits};
use crate::own_process::ran_elsewhere;
use gleaner_base::ByteSize;
use gleaner_host::guest::Guest;
use gleaner_lambda::FaultKind;
use gleaner_lambda::manifest::Limits;
use gleaner_protocol::process_stats::usage;
use gleaner_tests::times;

/// Growth in bytes that is allowed to the allocator and the kernel, over any number of faults.
const SLACK_BYTES: u64 = 4 << 20;

fn small() -> Limits {
    let mut limits = limits();
    // Enough for a good wake, and soon used up by a bad one.
    (limits.fuel, limits.memory, limits.handles) = (100_000, ByteSize::mib(4), 256);
    limits
}

/// A component that drops a sample that it never had.
fn misuse() -> TestGuest {
    let parts = r#"(alias export $data "sample" (type $a-sample)) (core func $drop (canon resource.drop $a-sample))
        (core instance $host (export "drop" (func $drop)))"#;
    let body = "(import \"host\" \"drop\" (func $drop (param i32))) (func $wake (call $drop (i32.const 99)))";
    TestGuest::written_within(&component(parts, "(with \"host\" (instance $host))", body), &small())
}

fn descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

/// One test, since memory is measured for the whole program.
#[test]
fn repeated_faults_leave_memory_slots_and_handles_unchanged() {
    if ran_elsewhere("faults::repeated_faults_leave_memory_slots_and_handles_unchanged") {
        return;
    }
    let faults = times("GLEANER_FAULTS", 2000);
    let greedy = |behaviour: &str| TestGuest::within(behaviour, 0, &small());
    // Memory costs fuel by the byte.
    let mut roomy = small();
    roomy.fuel *= 10;
    let mut stacked = small();
    stacked.stack = ByteSize::kib(16);
    let endless = component("", "", "(func $wake (call $wake) (call $wake))");
    let rooms = [
        ("fuel", greedy("endless"), FaultKind::Fuel),
        ("trap", greedy("panic"), FaultKind::Trap),
        ("memory", TestGuest::within("memory", 0, &roomy), FaultKind::Memory),
        ("stack", TestGuest::written_within(&endless, &stacked), FaultKind::Stack),
        ("handles kept", greedy("topics"), FaultKind::HostCall),
        ("a handle of nothing", misuse(), FaultKind::HostCall),
        ("frames kept", greedy("frames"), FaultKind::HostCall),
    ];
    for (name, mut test, kind) in rooms {
        test.guest.init().unwrap();
        let mut go_on = |times: u32| {
            for _ in 0..times {
                let fault = test.fault();
                assert_eq!(fault.kind, kind, "{name}: {}", fault.message);
                test.session.end();
                test.session.take_log();
            }
            (usage::resident(), Arc::strong_count(&test.topic), descriptors())
        };
        let (resident, owners, open) = go_on(500);
        let (resident_now, owners_now, open_now) = go_on(faults);
        let (before, now) = (resident / 1024, resident_now / 1024);
        println!(
            "{name}: {faults} faults, {before} KiB resident before, {now} KiB now, {owners_now} owners of the input"
        );
        assert!(resident_now < resident + SLACK_BYTES, "{name}: from {before} to {now} KiB");
        assert_eq!((owners_now, open_now), (owners, open), "{name}");
        let counts = test.topic.counts();
        assert_eq!((counts.received, counts.no_slot), (u64::from(faults) + 500, 0), "{name}");
        // Its frames were released with it: all can be created again.
        let frames: Vec<_> = (0..small().frames)
            .map(|_| test.topic.newest().unwrap().unwrap().as_frame().unwrap())
            .collect();
        assert_eq!(frames.len() as u64, small().frames, "{name}");
    }
}

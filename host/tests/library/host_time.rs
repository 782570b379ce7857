//! Work of the host that instructions do not count: WASI calls cost fuel by that work, and a wake
//! that returns late is a fault.

use std::time::Duration;

use crate::greedy::{FUEL, TestGuest, component, limits};
use gleaner_base::ByteSize;
use gleaner_host::guest::Guest;
use gleaner_lambda::FaultKind;

/// A component with these WASI imports. Its module can call `functions` by name; `fill` writes a
/// number several times from offset 16 on, where the host reads, and `read` returns the number at
/// an offset from there.
fn calls_wasi(imports: &str, functions: &[&str], wake: &str) -> String {
    let lowered: String = functions
        .iter()
        .map(|name| {
            format!("(core func ${name} (canon lower (func ${name}) (memory $its-memory) (realloc $its-realloc)))\n")
        })
        .collect();
    let exported: String =
        functions.iter().map(|name| format!(r#"(export "{name}" (func ${name}))"#)).collect();
    let parts = format!(
        r#"{imports}
           (core module $store
               (memory (export "memory") 32)
               (func (export "realloc") (param i32 i32 i32 i32) (result i32) (i32.const 65536))
               (func (export "read") (param $at i32) (result i32) (i32.load offset=16 (local.get $at)))
               (func (export "fill") (param $value i32) (param $count i32)
                   (loop
                       (local.set $count (i32.sub (local.get $count) (i32.const 1)))
                       (i32.store offset=16 (i32.mul (local.get $count) (i32.const 4)) (local.get $value))
                       (br_if 0 (local.get $count)))))
           (core instance $store (instantiate $store))
           (alias core export $store "memory" (core memory $its-memory))
           (alias core export $store "realloc" (core func $its-realloc))
           (alias core export $store "fill" (core func $fill))
           (alias core export $store "read" (core func $read))
           {lowered}
           (core instance $host (export "fill" (func $fill)) (export "read" (func $read)) {exported})"#
    );
    component(&parts, r#"(with "host" (instance $host))"#, wake)
}

/// Requests `bytes` random bytes; `wake` is the body of the wake.
fn random(bytes: u32, wake: &str) -> TestGuest {
    let imports = r#"
        (import "wasi:random/random@0.2.0" (instance $random
            (export "get-random-bytes" (func (param "len" u64) (result (list u8))))))
        (alias export $random "get-random-bytes" (func $bytes))"#;
    let body = format!(
        r#"(import "host" "bytes" (func $bytes (param i64 i32)))
           (func $random (call $bytes (i64.const {bytes}) (i32.const 16)))
           (func $wake {wake})"#
    );
    TestGuest::written(&calls_wasi(imports, &["bytes"], &body))
}

#[test]
fn random_numbers_cost_fuel_by_the_byte() {
    let [some, more, most] = [1000, 2000, 4000].map(|bytes| random(bytes, "(call $random)").fuel());
    assert_eq!((more - some, most - more), (4 * 1000, 4 * 2000));
    let outcome = random(4096, "(loop (call $random) (br 0))").wake();
    assert_eq!(outcome.result.unwrap_err().kind, FaultKind::Fuel);
    // The host's part alone uses up the fuel, and the last call is not made.
    let fuel = outcome.fuel.unwrap();
    assert!((FUEL..FUEL + FUEL / 20).contains(&fuel), "{fuel}");
    assert_eq!(random(4097, "(call $random)").fault().kind, FaultKind::HostCall);
}

/// Waits for `these` pollables, all of the output, with `fuel`.
fn waits_for(these: u32, fuel: u64) -> TestGuest {
    let imports = r#"
        (import "wasi:io/poll@0.2.0" (instance $poll
            (export "pollable" (type $pollable (sub resource)))
            (export "poll" (func (param "in" (list (borrow $pollable))) (result (list u32))))))
        (alias export $poll "pollable" (type $pollable))
        (import "wasi:io/streams@0.2.0" (instance $streams
            (export "output-stream" (type $out (sub resource)))
            (alias outer 1 $pollable (type $its-pollable))
            (export "[method]output-stream.subscribe" (func (param "self" (borrow $out)) (result (own $its-pollable))))))
        (alias export $streams "output-stream" (type $out))
        (import "wasi:cli/stdout@0.2.0" (instance $cli
            (alias outer 1 $out (type $its-out))
            (export "get-stdout" (func (result (own $its-out))))))
        (alias export $poll "poll" (func $wait))
        (alias export $streams "[method]output-stream.subscribe" (func $subscribe))
        (alias export $cli "get-stdout" (func $stdout))"#;
    let body = format!(
        r#"(import "host" "stdout" (func $stdout (result i32)))
           (import "host" "subscribe" (func $subscribe (param i32) (result i32)))
           (import "host" "wait" (func $wait (param i32 i32 i32)))
           (import "host" "fill" (func $fill (param i32 i32)))
           (func $wake
               (call $fill (call $subscribe (call $stdout)) (i32.const 2000))
               (call $wait (i32.const 16) (i32.const {these}) (i32.const 8)))"#
    );
    let mut limits = limits();
    limits.fuel = fuel;
    TestGuest::written_within(
        &calls_wasi(imports, &["stdout", "subscribe", "wait"], &body),
        &limits,
    )
}

#[test]
fn a_long_list_of_pollables_is_charged() {
    let [some, more] = [1000, 2000].map(|these| waits_for(these, FUEL).fuel());
    assert_eq!(more - some, 400 * 1000);
    // It ends as soon as the guest lacks fuel for the list.
    assert_eq!(waits_for(2000, more - 1).fault().kind, FaultKind::Fuel);
}

/// Resolves a host name of `bytes` bytes; `wake` is the body of the wake, and finds the result at
/// offset 16: whether it is an error, and its code.
fn looks_up(bytes: u32, wake: &str) -> TestGuest {
    let imports = r#"
        (import "wasi:sockets/network@0.2.0" (instance $network
            (export "network" (type $a-network (sub resource)))
            (type $codes (enum "unknown" "access-denied" "not-supported" "invalid-argument" "out-of-memory" "timeout"
                "concurrency-conflict" "not-in-progress" "would-block" "invalid-state" "new-socket-limit"
                "address-not-bindable" "address-in-use" "remote-unreachable" "connection-refused" "connection-reset"
                "connection-aborted" "datagram-too-large" "name-unresolvable" "temporary-resolver-failure"
                "permanent-resolver-failure"))
            (export "error-code" (type $a-code (eq $codes)))))
        (alias export $network "network" (type $network-type))
        (alias export $network "error-code" (type $code))
        (import "wasi:sockets/instance-network@0.2.0" (instance $instance
            (alias outer 1 $network-type (type $its-network))
            (export "instance-network" (func (result (own $its-network))))))
        (import "wasi:sockets/ip-name-lookup@0.2.0" (instance $names
            (alias outer 1 $network-type (type $its-network))
            (alias outer 1 $code (type $its-code))
            (export "resolve-address-stream" (type $stream (sub resource)))
            (export "resolve-addresses" (func (param "network" (borrow $its-network)) (param "name" string)
                (result (result (own $stream) (error $its-code)))))))
        (alias export $instance "instance-network" (func $ours))
        (alias export $names "resolve-addresses" (func $resolve))"#;
    let body = format!(
        r#"(import "host" "ours" (func $ours (result i32)))
           (import "host" "resolve" (func $resolve (param i32 i32 i32 i32)))
           (import "host" "read" (func $read (param i32) (result i32)))
           (func $look_up (param $network i32)
               (call $resolve (local.get $network) (i32.const 1024) (i32.const {bytes}) (i32.const 16)))
           (func $wake {wake})"#
    );
    TestGuest::written(&calls_wasi(imports, &["ours", "resolve"], &body))
}

#[test]
fn a_host_name_is_not_resolved_and_costs_fuel_by_the_byte() {
    let code = "(if (i32.ne (call $read (i32.const 4)) (i32.const 20)) (then (unreachable)))";
    let error = "(if (i32.ne (call $read (i32.const 0)) (i32.const 1)) (then (unreachable)))";
    let answered = format!("(call $look_up (call $ours)) {error} {code}");
    let [some, more, most] =
        [100_000, 200_000, 400_000].map(|bytes| looks_up(bytes, &answered).fuel());
    assert_eq!((more - some, most - more), (100_000 / 8, 200_000 / 8));
    let endless = "(local $network i32) (local.set $network (call $ours)) (loop (call $look_up (local.get $network)) (br 0))";
    let outcome = looks_up(1_000_000, endless).wake();
    assert_eq!(outcome.result.unwrap_err().kind, FaultKind::Fuel);
    let fuel = outcome.fuel.unwrap();
    assert!((FUEL..FUEL + FUEL / 20).contains(&fuel), "{fuel}");
}

/// Tries to open a model whose name has `bytes` bytes.
fn opens_model(bytes: u32) -> TestGuest {
    let imports = r#"
        (import "gleaner:lambda/inference@0.1.0" (instance $inference
            (export "model" (type $model (sub resource)))
            (type $an-error (variant (case "unavailable" string) (case "no-such-model" string)
                (case "wrong-input" string) (case "too-slow" string) (case "failed" string)))
            (export "inference-error" (type $error (eq $an-error)))
            (export "[static]model.open" (func (param "name" string) (result (result (own $model) (error $error)))))))
        (alias export $inference "[static]model.open" (func $open))"#;
    let body = format!(
        r#"(import "host" "open" (func $open (param i32 i32 i32)))
           (func $wake (call $open (i32.const 1024) (i32.const {bytes}) (i32.const 16)))"#
    );
    TestGuest::written(&calls_wasi(imports, &["open"], &body))
}

#[test]
fn the_name_of_a_model_costs_fuel_by_the_byte() {
    let [some, more] = [100_000, 200_000].map(|bytes| opens_model(bytes).fuel());
    assert_eq!(more - some, 100_000 / 8);
}

/// Fills a memory of 256 MiB by one instruction, which no epoch interrupts.
fn fills() -> String {
    let parts = r#"
        (core module $large (memory (export "memory") 4096))
        (core instance $large (instantiate $large))"#;
    let body = r#"
        (import "large" "memory" (memory $large 4096))
        (func $wake (memory.fill $large (i32.const 0) (i32.const 1) (i32.const 0x10000000)))"#;
    component(parts, r#"(with "large" (instance $large))"#, body)
}

#[test]
fn a_wake_that_returns_late_is_a_fault_though_it_was_not_interrupted() {
    let mut limits = limits();
    limits.memory = ByteSize::mib(300);
    limits.fuel = u64::from(u32::MAX);
    limits.deadline = Duration::from_millis(2);
    let mut test = TestGuest::written_timed(&fills(), &limits);
    test.guest.init().unwrap();
    let fault = test.fault();
    assert_eq!(
        (fault.kind, fault.allowed),
        (FaultKind::Deadline, Some(2_000_000)),
        "{}",
        fault.message
    );
    assert!(fault.used > Some(4_000_000), "{}", fault.message);
    assert!(fault.message.ends_with("ms passed); the deadline is 2.0 ms"), "{}", fault.message);
    // A replay has no deadline, and a wake in time is no fault.
    TestGuest::written_within(&fills(), &limits).wake().result.unwrap();
    limits.deadline = Duration::from_secs(60);
    TestGuest::written_timed(&fills(), &limits).wake().result.unwrap();
}

#[test]
fn a_start_function_that_grows_a_memory_for_ever_is_ended_by_its_fuel() {
    let grow = "(start $grow) (func $grow (loop (drop (memory.grow $large (i32.const 1))) (br 0))) (func $wake)";
    let text = component("", "", &format!("(memory $large 1) {grow}"));
    let fault = TestGuest::written(&text).guest.init().unwrap_err();
    // The host's part alone uses up the fuel: 64 KiB cost 8,192 units, and so does a refusal.
    assert_eq!(
        (fault.kind, fault.allowed),
        (FaultKind::Fuel, Some(20 * FUEL)),
        "{}",
        fault.message
    );
    assert!(fault.used < Some(20 * FUEL + 20 * FUEL / 20), "{}", fault.message);
}

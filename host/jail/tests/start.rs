//! Tests the effects of code that runs before the lambda. Each test sandboxes a process of its own.

use std::hint::black_box;
use std::process::Command;
use std::sync::mpsc;
use std::thread;

use gleaner_jail::{JailError, base_filter, memory, sandbox_filter};
use gleaner_protocol::Holds;
use rustix::fs::{MemfdFlags, memfd_create};
use rustix::io::Errno;
use rustix::process::{Resource, getpid, getppid, getrlimit, test_kill_process};

/// Set in the process that a test starts.
const CHILD: &str = "GLEANER_JAIL_TEST";

/// Runs `test`, which has the name `name`, in a process of its own.
#[track_caller]
fn in_own_process(name: &str, test: fn()) {
    if std::env::var_os(CHILD).is_some() {
        return test();
    }
    let mut again = Command::new(std::env::current_exe().unwrap());
    let output = again.args(["--exact", name, "--nocapture"]).env(CHILD, "1").output().unwrap();
    let output_text =
        String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && output_text.contains("1 passed"), "{output_text}");
}

#[test]
fn all_threads_are_sandboxed() {
    in_own_process("all_threads_are_sandboxed", || {
        base_filter::apply();
        let mut layers = vec![sandbox_filter::apply_before_interpreter(true)];
        layers.extend(sandbox_filter::apply(true).unwrap());
        assert!(layers.iter().all(|layer| layer.holds == Holds::Yes), "{layers:?}");
    });
}

#[test]
fn a_thread_with_its_own_filter_is_an_error() {
    in_own_process("a_thread_with_its_own_filter_is_an_error", || {
        base_filter::apply();
        let (ready, is_ready) = mpsc::channel();
        let (_end, ended) = mpsc::channel::<()>();
        thread::spawn(move || {
            assert_eq!(sandbox_filter::apply_before_interpreter(false).holds, Holds::Yes);
            ready.send(()).unwrap();
            let _ = ended.recv();
        });
        is_ready.recv().unwrap();
        let error = sandbox_filter::apply(true).unwrap_err();
        assert!(matches!(error, JailError::ExistingThread(_)), "{}", error.chain());
    });
}

#[test]
fn a_starting_interpreter_sends_no_signals_and_has_no_uncounted_memory() {
    in_own_process("a_starting_interpreter_sends_no_signals_and_has_no_uncounted_memory", || {
        let parent = getppid().unwrap();
        test_kill_process(parent).unwrap();
        assert_eq!(sandbox_filter::apply_before_interpreter(true).holds, Holds::Yes);
        assert_eq!(test_kill_process(parent), Err(Errno::PERM));
        test_kill_process(getpid()).unwrap();
        assert_eq!(memfd_create("more", MemfdFlags::CLOEXEC).unwrap_err(), Errno::PERM);
    });
}

#[test]
fn memory_in_use_does_not_raise_a_limit_above_an_earlier_one() {
    in_own_process("memory_in_use_does_not_raise_a_limit_above_an_earlier_one", || {
        let bound = || getrlimit(Resource::Data).maximum.unwrap();
        memory::limit(512 << 20);
        let first = bound();
        let taken = black_box(Vec::<u8>::with_capacity(256 << 20));
        assert!(black_box(Vec::<u8>::new()).try_reserve_exact(6 << 30).is_err());
        memory::limit(128 << 20);
        let second = bound();
        assert!(second < first && second > 256 << 20, "{first} {second}");
        memory::limit(6 << 30);
        assert_eq!(bound(), second);
        drop(taken);
    });
}

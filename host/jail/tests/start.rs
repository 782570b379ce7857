//! What code that runs before the lambda can leave behind for later. Each test shuts in a process
//! of its own.

use std::hint::black_box;
use std::process::Command;
use std::sync::mpsc;
use std::thread;

use gleaner_jail::{JailError, alone, memory, never};
use gleaner_protocol::Holds;
use rustix::fs::{MemfdFlags, memfd_create};
use rustix::io::Errno;
use rustix::process::{Resource, getpid, getppid, getrlimit, test_kill_process};

/// Is set in the process that a test starts.
const CHILD: &str = "GLEANER_JAIL_TEST";

/// Runs `test`, which is called `name`, in a process of its own.
#[track_caller]
fn apart(name: &str, test: fn()) {
    if std::env::var_os(CHILD).is_some() {
        return test();
    }
    let mut again = Command::new(std::env::current_exe().unwrap());
    let output = again.args(["--exact", name, "--nocapture"]).env(CHILD, "1").output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.contains("1 passed"), "{said}");
}

#[test]
fn all_threads_are_shut_in() {
    apart("all_threads_are_shut_in", || {
        never::forbid();
        let mut layers = vec![alone::before_interpreter(true)];
        layers.extend(alone::stay(true).unwrap());
        assert!(layers.iter().all(|layer| layer.holds == Holds::Yes), "{layers:?}");
    });
}

#[test]
fn a_thread_with_a_filter_of_its_own_is_not_left_loose() {
    apart("a_thread_with_a_filter_of_its_own_is_not_left_loose", || {
        never::forbid();
        let (ready, is_ready) = mpsc::channel();
        let (_end, ended) = mpsc::channel::<()>();
        thread::spawn(move || {
            assert_eq!(alone::before_interpreter(false).holds, Holds::Yes);
            ready.send(()).unwrap();
            let _ = ended.recv();
        });
        is_ready.recv().unwrap();
        let error = alone::stay(true).unwrap_err();
        assert!(matches!(error, JailError::Loose(_)), "{}", error.told());
    });
}

#[test]
fn an_interpreter_that_starts_signals_nobody_and_has_no_memory_that_is_not_counted() {
    apart(
        "an_interpreter_that_starts_signals_nobody_and_has_no_memory_that_is_not_counted",
        || {
            let parent = getppid().unwrap();
            test_kill_process(parent).unwrap();
            assert_eq!(alone::before_interpreter(true).holds, Holds::Yes);
            assert_eq!(test_kill_process(parent), Err(Errno::PERM));
            test_kill_process(getpid()).unwrap();
            assert_eq!(memfd_create("more", MemfdFlags::CLOEXEC).unwrap_err(), Errno::PERM);
        },
    );
}

#[test]
fn what_is_taken_before_a_limit_does_not_raise_it_above_an_earlier_one() {
    apart("what_is_taken_before_a_limit_does_not_raise_it_above_an_earlier_one", || {
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

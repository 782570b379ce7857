//! Denies a system call to programs that a test starts, as the profile of a container does.

use std::collections::BTreeMap;
use std::thread;

use seccompiler::{BpfProgram, SeccompAction, SeccompFilter};

/// Runs `test` in a thread to which, as to the programs that it starts, `call` fails with EPERM.
pub fn without<T: Send>(call: i64, test: impl FnOnce() -> T + Send) -> T {
    let filtered = || {
        let refuse = SeccompAction::Errno(libc::EPERM.unsigned_abs());
        let target = std::env::consts::ARCH.try_into().expect("a known architecture");
        let calls = BTreeMap::from([(call, Vec::new())]);
        let filter = SeccompFilter::new(calls, SeccompAction::Allow, refuse, target);
        let program: BpfProgram = filter.and_then(TryInto::try_into).expect("a filter");
        seccompiler::apply_filter(&program).expect("filters are permitted");
        test()
    };
    thread::scope(|scope| scope.spawn(filtered).join()).expect("the test succeeds")
}

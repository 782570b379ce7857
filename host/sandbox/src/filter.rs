//! Compiles a list of system calls into a seccomp filter that refuses them.

use std::collections::BTreeMap;
use std::ops::Range;

use seccompiler::{
    BpfProgram, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition, SeccompFilter,
    SeccompRule, TargetArch,
};

use crate::JailError;

/// All bits of an argument.
pub(crate) const ALL: u64 = u32::MAX as u64;

/// Bit of the numbers of the x32 ABI, by which a call can also be made on x86-64.
#[cfg(target_arch = "x86_64")]
const X32: i64 = 0x4000_0000;
/// Calls that have numbers of their own in the x32 ABI.
#[cfg(target_arch = "x86_64")]
const X32_OWN: std::ops::RangeInclusive<i64> = 512..=547;

#[derive(Default)]
pub(crate) struct DeniedCalls(BTreeMap<i64, Vec<SeccompRule>>);

impl DeniedCalls {
    /// Refuses `calls`, whatever their arguments.
    pub(crate) fn calls(mut self, calls: &[i64]) -> Self {
        for call in calls {
            self.insert(*call, Vec::new());
        }
        self
    }

    /// Refuses `call` where its argument `index` is `value` in the bits of `mask`.
    pub(crate) fn bits(self, call: i64, index: u8, mask: u64, value: u64) -> Self {
        self.when(call, index, SeccompCmpOp::MaskedEq(mask), value)
    }

    /// Refuses `call` unless the lower half of its argument `index` is `value`.
    pub(crate) fn unless(self, call: i64, index: u8, value: u64) -> Self {
        self.when(call, index, SeccompCmpOp::Ne, value)
    }

    /// Refuses `call` where its argument `index`, an address, lies in `range`.
    pub(crate) fn between(mut self, call: i64, index: u8, range: Range<u64>) -> Self {
        let condition = |operator, value| {
            SeccompCondition::new(index, SeccompCmpArgLen::Qword, operator, value)
        };
        let both = condition(SeccompCmpOp::Ge, range.start)
            .and_then(|from| SeccompRule::new(vec![from, condition(SeccompCmpOp::Lt, range.end)?]));
        self.insert(call, vec![both.expect("an index below 6, and two conditions")]);
        self
    }

    fn when(self, call: i64, index: u8, operator: SeccompCmpOp, value: u64) -> Self {
        // Flags, process numbers and requests are `int`s: the kernel reads the lower half only, and
        // so must the filter.
        self.of_width(call, index, SeccompCmpArgLen::Dword, operator, value)
    }

    fn of_width(
        mut self,
        call: i64,
        index: u8,
        width: SeccompCmpArgLen,
        operator: SeccompCmpOp,
        value: u64,
    ) -> Self {
        let condition = SeccompCondition::new(index, width, operator, value);
        let rule = condition.and_then(|condition| SeccompRule::new(vec![condition]));
        self.insert(call, vec![rule.expect("an index below 6, and one condition")]);
        self
    }

    fn insert(&mut self, call: i64, rules: Vec<SeccompRule>) {
        self.0.entry(call).or_default().extend(rules);
    }

    /// Returns a filter that answers `clone3` with ENOSYS: a filter cannot read its flags, which
    /// are in memory, and libraries fall back to `clone`.
    pub(crate) fn no_clone3() -> Result<BpfProgram, JailError> {
        Self::default().calls(&[libc::SYS_clone3]).filter(libc::ENOSYS)
    }

    /// Returns the filter, which answers refused calls with `errno`.
    pub(crate) fn filter(mut self, errno: i32) -> Result<BpfProgram, JailError> {
        let arch = std::env::consts::ARCH;
        let target: TargetArch = arch.try_into().map_err(|_| JailError::Architecture(arch))?;
        self.refuse_other_numbers();
        let answer = SeccompAction::Errno(errno.unsigned_abs());
        let filter = SeccompFilter::new(self.0, SeccompAction::Allow, answer, target)
            .map_err(JailError::Build)?;
        filter.try_into().map_err(JailError::Build)
    }

    /// Refuses the same calls by their other numbers. Calls of another architecture, such as 32-bit
    /// ones, end the process anyway.
    #[cfg(target_arch = "x86_64")]
    fn refuse_other_numbers(&mut self) {
        let twins: Vec<_> =
            self.0.iter().map(|(call, rules)| (call | X32, rules.clone())).collect();
        self.0.extend(twins);
        for call in X32_OWN {
            // Old kernels accept these numbers without the bit, too.
            self.0.insert(call, Vec::new());
            self.0.insert(call | X32, Vec::new());
        }
    }

    #[cfg(not(target_arch = "x86_64"))]
    fn refuse_other_numbers(&mut self) {}
}

/// Installs `filter` for this thread and its descendants.
pub(crate) fn install(filter: &BpfProgram) -> Result<(), JailError> {
    seccompiler::apply_filter(filter).map_err(JailError::Install)
}

/// Installs `filter` for all threads of this process and their descendants. Fails with
/// [`JailError::ExistingThread`] if a thread cannot get this one, since its filters differ from
/// those of this thread.
pub(crate) fn install_everywhere(filter: &BpfProgram) -> Result<(), JailError> {
    seccompiler::apply_filter_all_threads(filter).map_err(|error| match error {
        seccompiler::Error::ThreadSync(_) => JailError::ExistingThread(error),
        error => JailError::Install(error),
    })
}

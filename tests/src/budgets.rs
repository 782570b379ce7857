//! Budgets of the checkout, which only go down: `tests/tests/house/budgets.rs` compares them.
//!
//! An issue that grants growth is the decision for it, and the budget is then what was reached. Any
//! other raise needs a page in `docs/decisions` with what it buys.

/// Lines of Rust and Python of each folder at the top, without generated files: of sources, and of
/// tests.
pub const LINES: &[(&str, usize, usize)] = &[
    ("base", 1243, 669),
    ("bench", 11757, 745),
    ("cli", 11190, 4437),
    ("cloud", 19276, 6515),
    ("examples", 1318, 757),
    ("fuzz", 4216, 86),
    ("guest-sdk-python", 5883, 4113),
    ("guest-sdk-rust", 5394, 1621),
    ("host", 62560, 30311),
    ("journal", 1869, 1266),
    ("lambda", 4680, 2183),
    ("orchestrator", 25806, 8417),
    ("player", 2242, 793),
    ("report", 2802, 913),
    ("rules", 2707, 1191),
    ("tests", 6579, 12434),
    ("xtask", 6951, 774),
];

/// Files with functions of more than 80 lines, each with its reason.
pub const LONG_FUNCTIONS: &[&str] = &[
    "cloud/server/src/people/mod.rs",
    "orchestrator/daemon/src/cloud/tests.rs",
    "tests/lambdas/driver/rust/src/lib.rs",
];

/// Crates whose top-level modules use each other in a circle: folder of the crate, and number of
/// pairs of modules of which one uses the other and is, over any others, used by it.
pub const CIRCLES: &[(&str, usize)] = &[
    ("bench/results", 3),
    ("cloud/server", 30),
    ("host/python", 7),
    ("host/vision", 4),
    ("lambda", 2),
    ("orchestrator/daemon", 5),
    ("orchestrator/protocol", 5),
    ("orchestrator/spool", 2),
    ("orchestrator/supervisor", 5),
    ("orchestrator/trust", 2),
    ("report", 2),
];

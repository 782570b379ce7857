//! Budgets of the checkout, which only go down: `tests/tests/house/budgets.rs` compares them.
//!
//! An issue that grants growth is the decision for it, and the budget is then what was reached. Any
//! other raise needs a page in `docs/decisions` with what it buys.

/// Lines of Rust and Python of each folder at the top, without generated files: of sources, and of
/// tests.
pub const LINES: &[(&str, usize, usize)] = &[
    ("base", 1223, 669),
    ("bench", 11757, 745),
    ("cli", 11169, 4450),
    ("cloud", 18988, 6656),
    ("examples", 1318, 757),
    ("fleet-client-python", 513, 319),
    ("fuzz", 4135, 83),
    ("guest-sdk-python", 5363, 3718),
    ("guest-sdk-rust", 5335, 1619),
    ("host", 61799, 30390),
    ("journal", 1771, 1251),
    ("lambda", 4434, 2169),
    ("orchestrator", 25971, 8629),
    ("player", 2214, 793),
    ("report", 2688, 908),
    ("rules", 2620, 1179),
    ("tests", 6721, 12672),
    ("xtask", 6101, 679),
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

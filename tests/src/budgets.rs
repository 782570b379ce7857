//! Budgets of the checkout, which only go down: `tests/tests/house/budgets.rs` compares them.
//!
//! An issue that grants growth is the decision for it, and the budget is then what was reached. Any
//! other raise needs a page in `docs/decisions` with what it buys.

/// Lines of Rust and Python of each folder at the top, without generated files: of sources, and of
/// tests.
pub const LINES: &[(&str, usize, usize)] = &[
    ("base", 1248, 669),
    ("bench", 11757, 745),
    ("cli", 11199, 4452),
    ("cloud", 19413, 6587),
    ("examples", 1318, 757),
    ("fuzz", 4135, 83),
    ("guest-sdk-python", 5883, 4113),
    ("guest-sdk-rust", 5394, 1621),
    ("host", 62842, 30395),
    ("journal", 1854, 1251),
    ("lambda", 4669, 2169),
    ("orchestrator", 26099, 8618),
    ("player", 2214, 793),
    ("report", 2764, 908),
    ("rules", 2700, 1179),
    ("tests", 6580, 12452),
    ("xtask", 6893, 765),
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

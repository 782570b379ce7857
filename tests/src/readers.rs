//! Readers of clips that we did not write: the packages `mcap`, `mcap-ros2-support` and `rosbags`.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::root;

/// The Python of `cargo xtask test`, if it has the readers.
pub fn foreign_python() -> Result<PathBuf, String> {
    let python = root().join(".venv/bin/python3");
    let has = Command::new(&python).args(["-I", "-c", "import mcap, mcap_ros2, rosbags"]).output();
    has.is_ok_and(|output| output.status.success()).then_some(python).ok_or_else(|| {
        "no Python with mcap, mcap-ros2-support and rosbags in .venv; run: cargo xtask test"
            .to_owned()
    })
}

/// Compares the clips that `out` lists with the drives of their run, as `tests/readers/clips.py`
/// describes. Does nothing without the readers: tests of `drives` are ignored then.
#[track_caller]
pub fn compare_clips(out: &Path, drives: &[PathBuf]) {
    let Ok(python) = foreign_python() else { return };
    let script = root().join("tests/readers/clips.py");
    let compared = Command::new(python).arg("-I").arg(script).arg(out).args(drives).output();
    let compared = compared.expect("Python starts");
    assert!(compared.status.success(), "{}", String::from_utf8_lossy(&compared.stderr));
}

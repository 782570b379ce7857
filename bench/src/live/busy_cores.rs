//! Keeps the cores from sleeping, as a core that sleeps takes some 50 us to run a woken thread.

use std::io;
use std::process::{Child, Command};

use crate::measure::cores;

/// Processes of the lowest class, one for each core, which keep the cores from sleeping; ended on
/// drop.
pub struct BusyCores(Vec<Child>);

impl BusyCores {
    /// Starts the processes.
    pub fn start() -> io::Result<Self> {
        let start = |_| {
            let mut busy = Command::new("chrt");
            busy.args(["--idle", "0", "sh", "-c", "while :; do :; done"]).spawn()
        };
        cores()?.into_iter().map(start).collect::<io::Result<Vec<Child>>>().map(Self)
    }
}

impl Drop for BusyCores {
    fn drop(&mut self) {
        for busy in &mut self.0 {
            // It has not ended, as nothing else ends it.
            let _ = busy.kill();
            let _ = busy.wait();
        }
    }
}

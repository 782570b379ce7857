//! Tests the results of a live lambda that the shim writes: small programs stand for a runtime, and
//! write arbitrary bytes into the pipe. `GLEANER_KILLS` is the number of kills of a shim with a
//! spool, by default 20; `GLEANER_LONG=1` makes it twenty times as many.

mod files;
mod spool;

use std::fs;
use std::path::PathBuf;
use std::process::Output;

const SHIM: &str = env!("CARGO_BIN_EXE_gleaner-shim");

/// Functions for scripts: `item TEXT` writes an item, `woken` the first one, `log N` a line of the
/// log, `tick N` a decision without a trigger. `asked` makes the shim ask the script to end.
const ITEMS: &str = r#"
item() { printf '%s\n' "$1" > "/proc/self/fd/$GLEANER_RESULTS"; }
log() { item '{"log":{"at_ns":'$1',"level":"info","message":"m"}}'; }
tick() { item '{"decision":{"at_ns":'$1',"cause":"tick","triggers":[],"run_ns":1}}'; }
woken() { item '{"woken":{"cause":"event","input":"camera","topic":"/camera"}}'; }
asked() { local is=; trap 'is=1' TERM; kill -TERM $PPID; until [ "$is" ]; do sleep 0.01; done; }
last() { item '{"last":{"lambda":"l","version":"1.0.0","kind":"wasm","out":"o","restarts":0,'\
'"up_s":1.0,"wakes":2,"triggers":0,"faults":0,"skipped":0,"missed_ticks":0,'\
'"log_lines":0,"log_dropped":0,"triggers_refused":0,"backed_off":0,'\
'"unwritten":5,"topics":[],"network":{"domain":0,"participants":0,'\
'"buffer_requested":0,"buffer_granted":0,"socket_drops":0,"filtered":0},'\
'"rss_bytes":0,"cpu_s":0.0}}'; }
"#;

struct ResultsFolder(PathBuf);

impl ResultsFolder {
    fn of(test: &str) -> Self {
        let path = std::env::temp_dir()
            .join(format!("gleaner-shim-results-{}-{test}", std::process::id()));
        fs::create_dir(&path).unwrap();
        Self(path)
    }

    fn out(&self) -> PathBuf {
        self.0.join("out")
    }
}

impl Drop for ResultsFolder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

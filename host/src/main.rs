//! `gleaner-runtime`: the process that hosts one lambda. `gleaner` starts it; see `gleaner-runtime
//! --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    gleaner_host::program::main()
}

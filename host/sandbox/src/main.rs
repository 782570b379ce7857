//! `gleaner-shim`: see the library.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    gleaner_sandbox::shim::main()
}

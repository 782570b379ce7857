//! The program `gleaner-supervisor`.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    gleaner_supervisor::service::main()
}

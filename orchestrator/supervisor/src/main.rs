//! The program `gleaner-supervisor`.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_supervisor::service::main()
}

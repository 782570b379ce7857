//! The program `gleaner-orchestrator`.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_orchestrator::main()
}

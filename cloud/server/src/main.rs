//! The program `gleaner-cloud`.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_cloud::main()
}

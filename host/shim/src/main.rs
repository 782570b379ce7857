//! `gleaner-shim`: see the library.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_shim::main()
}

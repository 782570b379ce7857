//! `gleaner-recorder`: the process that records for all lambdas of a vehicle. `gleaner` starts it;
//! see `gleaner-recorder --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    gleaner_recorder::program::main()
}

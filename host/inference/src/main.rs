//! `gleaner-inference`: the process that runs the models of all lambdas on a vehicle. `gleaner`
//! starts it; see `gleaner-inference --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    gleaner_inference::program::main()
}

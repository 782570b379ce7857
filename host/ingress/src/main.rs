//! `gleaner-ingress`: the process that receives topics for all lambdas of a vehicle. `gleaner`
//! starts it; see `gleaner-ingress --help`.

use std::process::ExitCode;

fn main() -> ExitCode {
    gleaner_base::set_commit(option_env!("GLEANER_COMMIT"));
    gleaner_ingress::program::main()
}

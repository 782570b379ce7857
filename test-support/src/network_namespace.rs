//! Runs tests in a network namespace of their own.

use std::env;
use std::process::{Command, ExitCode, Stdio};

use libtest_mimic::{Arguments, Trial};

/// A name, and the test.
pub type Test = (&'static str, fn());

const INSIDE: &str = "GLEANER_DDS_TESTS_INSIDE";
/// Brings up `lo`, the only interface, with multicast; then runs `"$@"`.
const SCRIPT: &str = "ip link set lo up && ip link set lo multicast on && \
                      ip route add 224.0.0.0/4 dev lo && exec \"$@\"";

/// Runs each of `tests` by `run`, in a network namespace. Where none can be created, the tests are
/// ignored, and their names give the reason.
pub fn run_tests(tests: impl IntoIterator<Item = Test>, run: fn(Test)) -> ExitCode {
    let arguments = Arguments::from_args();
    let here = match env::var_os(INSIDE) {
        Some(_) => Ok(()),
        None => match rerun() {
            Ok(code) => return code,
            Err(why) => Err(why),
        },
    };
    let trial = |test: Test| match &here {
        Ok(()) => Trial::test(test.0, move || {
            run(test);
            Ok(())
        }),
        Err(why) => Trial::test(format!("{} [{why}]", test.0), || Ok(())).with_ignored_flag(true),
    };
    libtest_mimic::run(&arguments, tests.into_iter().map(trial).collect()).exit_code()
}

fn unshared() -> Command {
    let mut command = Command::new("unshare");
    command.args(["--user", "--map-root-user", "--net", "sh", "-c", SCRIPT, "sh"]).env(INSIDE, "1");
    command
}

/// Runs this program again in a network namespace of its own.
fn rerun() -> Result<ExitCode, String> {
    let may = unshared().arg("true").stdout(Stdio::null()).stderr(Stdio::null()).status();
    if !may.is_ok_and(|status| status.success()) {
        return Err("a network namespace cannot be created here".to_owned());
    }
    let program = env::current_exe().map_err(|error| error.to_string())?;
    let status = unshared()
        .arg(program)
        .args(env::args_os().skip(1))
        .status()
        .map_err(|error| error.to_string())?;
    Ok(if status.success() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

//! The command line, checked as far as it can be without looking at a file.

use std::path::PathBuf;

use clap::{Args, Parser, Subcommand};

/// Small functions next to the sensors, that keep the data worth keeping.
#[derive(Parser, Debug)]
#[command(name = "gleaner", version, propagate_version = true)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// What `gleaner` can do.
#[derive(Subcommand, Debug)]
pub enum Command {
    /// Make the build folder DIR/build of a lambda
    Build(BuildArgs),
    /// Run a built lambda over recorded drives
    ///
    /// Writes OUT/decisions.jsonl, OUT/log.jsonl, OUT/summary.json and the clips that the manifest asks for, and shows a
    /// summary.
    Replay(ReplayArgs),
    /// Make the decisions in a clip again, and compare them with its journal
    ///
    /// Ends with 0 if all are the same, and with 4 at the first that is not.
    Verify(VerifyArgs),
}

/// Arguments of `gleaner build`.
#[derive(Args, Debug)]
pub struct BuildArgs {
    /// The lambda's folder, with its lambda.toml
    #[arg(value_name = "DIR")]
    pub lambda: PathBuf,
}

/// Arguments of `gleaner replay`.
#[derive(Args, Debug)]
pub struct ReplayArgs {
    /// The lambda's folder, built by `gleaner build DIR`
    #[arg(value_name = "DIR")]
    pub lambda: PathBuf,
    /// MCAP files; several are merged by time
    #[arg(value_name = "DRIVE", required = true)]
    pub drives: Vec<PathBuf>,
    /// Another value for a key of the config table, as in brake_mps2=-1.4
    #[arg(long, value_name = "KEY=VALUE", value_parser = assignment)]
    pub set: Vec<String>,
    /// Another name for a topic of the manifest, as in /imu/data:=/car/imu
    #[arg(long, value_name = "FROM:=TO", value_parser = remap)]
    pub remap: Vec<String>,
    /// Where the results go [default: DIR/out]
    #[arg(long)]
    pub out: Option<PathBuf>,
    /// Write every decision, not only those with a trigger or a fault
    #[arg(long)]
    pub all: bool,
    /// Leave out the clips that the table `record` of the manifest asks for
    #[arg(long)]
    pub no_record: bool,
    /// Write a journal: of every wake, what the lambda saw and decided
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// Make every decision of a journal again and compare, instead of writing results; exit code 4 at the first difference
    #[arg(long, value_name = "FILE", conflicts_with_all = ["out", "all", "no_record", "journal"])]
    pub verify: Option<PathBuf>,
    /// Print the summary as one JSON object
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `gleaner verify`.
#[derive(Args, Debug)]
pub struct VerifyArgs {
    /// A clip that gleaner made
    pub clip: PathBuf,
    /// The lambda's folder, built by `gleaner build DIR`
    #[arg(long, value_name = "DIR")]
    pub lambda: PathBuf,
    /// Print the result as one JSON object
    #[arg(long)]
    pub json: bool,
}

// Both are passed on as they are: the runtime takes them apart. Here they are only refused early.

fn assignment(text: &str) -> Result<String, String> {
    match text.split_once('=') {
        Some((key, _)) if !key.trim().is_empty() => Ok(text.to_owned()),
        _ => Err("write KEY=VALUE, as in brake_mps2=-1.4".to_owned()),
    }
}

fn remap(text: &str) -> Result<String, String> {
    match text.split_once(":=") {
        Some((from, to)) if !from.trim().is_empty() && !to.trim().is_empty() => Ok(text.to_owned()),
        _ => Err("write FROM:=TO, as in /imu/data:=/car/imu".to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn replay(arguments: &[&str]) -> Result<ReplayArgs, String> {
        let line = ["gleaner", "replay"].iter().chain(arguments);
        match Cli::try_parse_from(line).map_err(|error| error.to_string())?.command {
            Command::Replay(args) => Ok(args),
            other => Err(format!("{other:?}")),
        }
    }

    #[test]
    fn the_definition_of_the_command_line_is_sound() {
        use clap::CommandFactory;
        Cli::command().debug_assert();
    }

    #[test]
    fn a_value_may_begin_with_a_minus_and_hold_an_equals_sign() {
        let args = replay(&["dir", "a.mcap", "--set", "brake_mps2=-1.4", "--set", "word=a=b", "b.mcap"]).unwrap();
        assert_eq!(args.set, ["brake_mps2=-1.4", "word=a=b"]);
        assert_eq!(args.drives, [PathBuf::from("a.mcap"), PathBuf::from("b.mcap")]);
    }

    #[test]
    fn bad_arguments_are_refused_with_an_example() {
        for (arguments, said) in [
            (["dir", "a.mcap", "--set", "brake_mps2"], "write KEY=VALUE"),
            (["dir", "a.mcap", "--set", "=3"], "write KEY=VALUE"),
            (["dir", "a.mcap", "--remap", "/imu=/car"], "write FROM:=TO"),
            (["dir", "a.mcap", "--remap", "/imu:="], "write FROM:=TO"),
            (["dir", "a.mcap", "--sett", "a=b"], "--set"),
        ] {
            let error = replay(&arguments).unwrap_err();
            assert!(error.contains(said), "{error}");
        }
        assert!(replay(&["dir"]).unwrap_err().contains("<DRIVE>"));
    }
}

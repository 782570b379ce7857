//! The lambdas of a run, as the command line gives them: folders, names, result folders, settings.

use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, safe_file};
use gleaner_lambda::{BuildDir, Manifest};
use gleaner_supervisor::LambdaSpec;

use crate::args::RunArgs;

/// Folder of clips in the result folder of a run of several lambdas.
const CLIPS: &str = "clips";

/// Loads the lambdas, in the order of the command line.
///
/// # Errors
///
/// A failure if a build cannot be used, if two lambdas have one name, or if a setting is for none
/// of several lambdas.
pub(super) fn load(args: &RunArgs) -> Result<Vec<LambdaSpec>, Failure> {
    let mut lambdas: Vec<LambdaSpec> = Vec::new();
    let is_single = args.lambdas.len() == 1;
    for folder in &args.lambdas {
        let build = BuildDir::check_fresh(folder)?;
        let manifest = Manifest::load(build.path())?;
        let name = manifest.lambda.name.as_str();
        if let Some(other) = lambdas.iter().find(|other| other.name() == name) {
            return Err(same_name(name, &other.folder, folder));
        }
        let out = if is_single { out(args) } else { out(args).join(name) };
        if !is_single && name == CLIPS {
            return Err(named_clips(&out));
        }
        // Recorder and shim write into the folder before the runtime checks it.
        safe_file::refuse_linked(&out, folder)?;
        let prefix = if is_single { String::new() } else { format!("{name}: ") };
        // The command line has checked the form of renamed topics.
        let remaps = args.remap.iter().filter_map(|remap| renamed(remap)).collect();
        let (folder, set) = (folder.clone(), args.set.clone());
        let deployment = None;
        lambdas.push(LambdaSpec { folder, manifest, out, prefix, set, remaps, deployment });
    }
    // The runtime checks the settings of a single lambda.
    if !is_single {
        share_out(args, &mut lambdas)?;
    }
    Ok(lambdas)
}

fn topics(manifest: &Manifest) -> impl Iterator<Item = &str> {
    let inputs = manifest.inputs.iter().map(|input| &input.topic);
    inputs.chain(manifest.record.iter().flat_map(|record| &record.topics)).map(AsRef::as_ref)
}

/// Returns the result folder of the run; clips are recorded into it.
pub(super) fn out(args: &RunArgs) -> PathBuf {
    let default = || match &*args.lambdas {
        [only] => only.join("live"),
        _ => PathBuf::from("live"),
    };
    args.out.clone().unwrap_or_else(default)
}

/// Gives each of several lambdas its part of the settings.
fn share_out(args: &RunArgs, lambdas: &mut [LambdaSpec]) -> Result<(), Failure> {
    lambdas.iter_mut().for_each(|lambda| (lambda.set, lambda.remaps) = Default::default());
    for setting in &args.set {
        let (key, value) = setting.split_once('=').unwrap_or((setting, ""));
        let named = key.trim().split_once('.');
        let found = named.and_then(|(name, key)| {
            lambdas.iter_mut().find(|lambda| lambda.name() == name).map(|lambda| (lambda, key))
        });
        let Some((lambda, key)) = found else { return Err(no_lambda_of(setting, lambdas)) };
        lambda.set.push(format!("{key}={value}"));
    }
    for remap in &args.remap {
        let Some((from, to)) = renamed(remap) else { continue };
        let mut is_used = false;
        for lambda in &mut *lambdas {
            if topics(&lambda.manifest).any(|topic| topic == from) {
                lambda.remaps.push((from.clone(), to.clone()));
                is_used = true;
            }
        }
        if !is_used {
            return Err(no_topic(&from, lambdas));
        }
    }
    Ok(())
}

fn renamed(remap: &str) -> Option<(String, String)> {
    let (from, to) = remap.split_once(":=")?;
    Some((from.trim().to_owned(), to.trim().to_owned()))
}

fn same_name(name: &str, first: &Path, second: &Path) -> Failure {
    let (first, second) = (first.display(), second.display());
    let failure =
        Failure::new(Exit::Usage, format!("`{first}` and `{second}` are both named `{name}`"));
    failure.with_help("change `name` in one of the two lambda.toml, and build it again")
}

fn named_clips(out: &Path) -> Failure {
    let message = format!("`{}` cannot hold the results of a lambda", out.display());
    let causes = vec!["it holds the clips of all lambdas".to_owned()];
    Failure { causes, ..Failure::new(Exit::Usage, message) }
        .with_help(format!("change the name `{CLIPS}` in lambda.toml, or run the lambda alone"))
}

fn no_lambda_of(setting: &str, lambdas: &[LambdaSpec]) -> Failure {
    let message = format!("--set `{setting}` is for none of the lambdas");
    let names: Vec<_> = lambdas.iter().map(LambdaSpec::name).collect();
    Failure::new(Exit::Usage, message).with_help(format!(
        "with several lambdas, write NAME.KEY=VALUE; the names are `{}`",
        names.join("`, `")
    ))
}

fn no_topic(from: &str, lambdas: &[LambdaSpec]) -> Failure {
    let mut known: Vec<_> = lambdas.iter().flat_map(|lambda| topics(&lambda.manifest)).collect();
    known.sort_unstable();
    known.dedup();
    let message = format!("no lambda has the topic `{from}` of --remap");
    Failure::new(Exit::Usage, message)
        .with_help(format!("the manifests have `{}`", known.join("`, `")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::args;

    fn lambda(name: &str, topic: &str) -> LambdaSpec {
        let text = format!(
            "lambda = {{ name = '{name}', version = '0.1.0', kind = 'python', entry = 'x.py' }}\n\
             schedule.period = '1s'\nrecord.topics = ['{topic}']\n"
        );
        LambdaSpec {
            folder: PathBuf::from(name),
            manifest: Manifest::parse(&text, "lambda.toml").unwrap(),
            out: PathBuf::new(),
            prefix: String::new(),
            set: Vec::new(),
            remaps: Vec::new(),
            deployment: None,
        }
    }

    fn shared(arguments: &[&str]) -> Result<Vec<LambdaSpec>, String> {
        use clap::Parser;
        let line = ["gleaner", "run", "a", "b"].iter().chain(arguments);
        let command = args::Cli::try_parse_from(line).unwrap().command;
        let args::CliCommand::Run(args) = command else { panic!("{command:?}") };
        let mut lambdas = vec![lambda("a", "/imu"), lambda("b-2", "/camera")];
        share_out(&args, &mut lambdas).map_err(|failure| failure.to_string())?;
        Ok(lambdas)
    }

    #[test]
    fn each_of_several_lambdas_gets_its_own_settings() {
        let lambdas = shared(&[
            "--set",
            "b-2.limit=-1.4",
            "--set",
            "a.word=x=y",
            "--remap",
            "/imu:=/car/imu",
        ])
        .unwrap();
        assert_eq!(lambdas[0].set, ["word=x=y"]);
        assert_eq!(lambdas[0].remaps, [("/imu".to_owned(), "/car/imu".to_owned())]);
        assert_eq!(lambdas[1].set, ["limit=-1.4"]);
        assert!(lambdas[1].remaps.is_empty());
    }

    #[test]
    fn settings_for_none_of_several_lambdas_are_refused() {
        for (arguments, message) in [
            (["--set", "limit=1"], "write NAME.KEY=VALUE; the names are `a`, `b-2`"),
            (["--set", "c.limit=1"], "--set `c.limit=1` is for none of the lambdas"),
            (["--remap", "/lidar:=/l"], "the manifests have `/camera`, `/imu`"),
        ] {
            let error = shared(&arguments).err().unwrap();
            assert!(error.contains(message), "{error}");
        }
    }

    #[test]
    fn two_lambdas_of_one_name_are_refused_with_their_folders() {
        let error = same_name("hello", Path::new("rust"), Path::new("python")).to_string();
        assert!(error.contains("`rust` and `python` are both named `hello`"), "{error}");
    }
}

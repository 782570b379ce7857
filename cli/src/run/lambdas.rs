//! The lambdas of a run, as the command line gives them: folders, names, result folders, settings.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, safe_file};
use gleaner_lambda::{BuildDir, Manifest};
use gleaner_protocol::ExitRecord;

use crate::args::{self, RunArgs};

/// Folder of clips in the result folder of a run of several lambdas.
const CLIPS: &str = "clips";

/// A lambda of the run.
pub(super) struct RunLambda {
    pub(super) folder: PathBuf,
    pub(super) manifest: Manifest,
    /// Its result folder.
    pub(super) out: PathBuf,
    /// Text before each line about this lambda, if there are several; else empty.
    pub(super) prefix: String,
    /// Overrides of its config, as `KEY=VALUE`.
    set: Vec<String>,
    /// Renamed topics, as `FROM:=TO`.
    remap: Vec<String>,
}

impl RunLambda {
    /// Loads the lambdas, in the order of the command line.
    ///
    /// # Errors
    ///
    /// A failure if a build cannot be used, if two lambdas have one name, or if a setting is for
    /// none of several lambdas.
    pub(super) fn load(args: &RunArgs) -> Result<Vec<RunLambda>, Failure> {
        let mut lambdas: Vec<RunLambda> = Vec::new();
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
            let (set, remap) = (args.set.clone(), args.remap.clone());
            lambdas.push(RunLambda { folder: folder.clone(), manifest, out, prefix, set, remap });
        }
        // The runtime checks the settings of a single lambda.
        if !is_single {
            share_out(args, &mut lambdas)?;
        }
        Ok(lambdas)
    }

    pub(super) fn name(&self) -> &str {
        self.manifest.lambda.name.as_str()
    }

    /// Returns the path of the record of how its process ended.
    pub(super) fn exit_record(&self) -> PathBuf {
        self.out.join(ExitRecord::FILE)
    }

    /// Returns the settings as arguments of the runtime.
    pub(super) fn settings(&self, vehicle: Option<&Path>) -> Vec<OsString> {
        args::settings(&self.set, &self.remap, vehicle)
    }

    /// Returns the renamed topics, from and to. The command line has checked their form.
    pub(super) fn remaps(&self) -> Vec<(String, String)> {
        self.remap.iter().filter_map(|remap| renamed(remap)).collect()
    }

    /// Returns the name of a topic of the manifest on the network.
    pub(super) fn on_network(&self, topic: &str) -> String {
        let to = self.remaps().into_iter().find(|(from, _)| from == topic).map(|(_, to)| to);
        to.unwrap_or_else(|| topic.to_owned())
    }

    /// Returns the topics of the manifest.
    fn topics(&self) -> impl Iterator<Item = &str> {
        let inputs = self.manifest.inputs.iter().map(|input| &input.topic);
        inputs
            .chain(self.manifest.record.iter().flat_map(|record| &record.topics))
            .map(AsRef::as_ref)
    }
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
fn share_out(args: &RunArgs, lambdas: &mut [RunLambda]) -> Result<(), Failure> {
    lambdas.iter_mut().for_each(|lambda| (lambda.set, lambda.remap) = Default::default());
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
        let Some((from, _)) = renamed(remap) else { continue };
        let mut is_used = false;
        for lambda in &mut *lambdas {
            if lambda.topics().any(|topic| topic == from) {
                lambda.remap.push(remap.clone());
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
    let mut failure = Failure::new(Exit::Usage, message);
    failure.causes = vec!["it holds the clips of all lambdas".to_owned()];
    failure.with_help(format!("change the name `{CLIPS}` in lambda.toml, or run the lambda alone"))
}

fn no_lambda_of(setting: &str, lambdas: &[RunLambda]) -> Failure {
    let message = format!("--set `{setting}` is for none of the lambdas");
    let names: Vec<_> = lambdas.iter().map(RunLambda::name).collect();
    Failure::new(Exit::Usage, message).with_help(format!(
        "with several lambdas, write NAME.KEY=VALUE; the names are `{}`",
        names.join("`, `")
    ))
}

fn no_topic(from: &str, lambdas: &[RunLambda]) -> Failure {
    let mut known: Vec<_> = lambdas.iter().flat_map(RunLambda::topics).collect();
    known.sort_unstable();
    known.dedup();
    let message = format!("no lambda has the topic `{from}` of --remap");
    Failure::new(Exit::Usage, message)
        .with_help(format!("the manifests have `{}`", known.join("`, `")))
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    /// Returns a lambda with an input, if any: its topic and maximum size. It records `topics`.
    pub(crate) fn recording(name: &str, input: Option<(&str, &str)>, topics: &[&str]) -> RunLambda {
        let mut text = format!(
            "lambda = {{ name = '{name}', version = '0.1.0', kind = 'python', entry = 'x.py' }}\n\
             schedule.period = '1s'\n"
        );
        if let Some((topic, max_size)) = input {
            text += &format!(
                "[[input]]\nname = 'i'\ntopic = '{topic}'\ntype = 'sensor_msgs/msg/Imu'\n\
                 max_size = '{max_size}'\ndepth = 4\n"
            );
        }
        if !topics.is_empty() {
            text += &format!("[record]\ntopics = {topics:?}\n");
        }
        RunLambda {
            folder: PathBuf::from(name),
            manifest: Manifest::parse(&text, "lambda.toml").unwrap(),
            out: PathBuf::from("live").join(name),
            prefix: format!("{name}: "),
            set: Vec::new(),
            remap: Vec::new(),
        }
    }

    fn shared(arguments: &[&str]) -> Result<Vec<RunLambda>, String> {
        use clap::Parser;
        let line = ["gleaner", "run", "a", "b"].iter().chain(arguments);
        let command = args::Cli::try_parse_from(line).unwrap().command;
        let args::CliCommand::Run(args) = command else { panic!("{command:?}") };
        let mut lambdas = vec![
            recording("a", Some(("/imu", "1 KiB")), &[]),
            recording("b-2", Some(("/camera", "1 KiB")), &["/camera"]),
        ];
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
        assert_eq!(
            lambdas[0].settings(None),
            ["--set", "word=x=y", "--remap", "/imu:=/car/imu"].map(OsString::from)
        );
        assert_eq!(lambdas[1].settings(None), ["--set", "limit=-1.4"].map(OsString::from));
        assert_eq!(lambdas[0].on_network("/imu"), "/car/imu");
        assert_eq!(lambdas[1].on_network("/imu"), "/imu");
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

//! Description of a run, as its starter has decided it.

use std::ffi::OsString;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use gleaner_lambda::Manifest;
use gleaner_protocol::ExitRecord;
use gleaner_protocol::supervision::DesiredLambda;

/// A run: what all its lambdas share.
#[derive(Clone, Debug, Default)]
pub struct RunSpec {
    pub clips: PathBuf,
    /// Configuration file of the vehicle.
    pub vehicle: Option<PathBuf>,
    /// Drive to play instead of joining a network.
    pub drives: Vec<PathBuf>,
    /// True to merge separate drives by time, which are refused otherwise.
    pub merge: bool,
    /// Speed of the drive, as a multiple of that of its recording.
    pub rate: Option<f64>,
    /// Arguments of `gleaner-ingress` that select the network.
    pub network: Vec<OsString>,
    /// Size of samples that the ingress expects at least, in bytes.
    pub largest: u64,
    /// Duration of the run, from the time at which all lambdas are ready.
    pub duration: Option<Duration>,
    /// True to write every decision, not only those with a trigger or a fault.
    pub all: bool,
    /// True to record the clips that manifests request.
    pub records: bool,
    /// Topic on which the stamps of each wake are published.
    pub rtt: Option<String>,
    /// Topic on which decisions are published.
    pub decisions: Option<String>,
    /// Topic of recording commands.
    pub commands: Option<String>,
    /// Free bytes of the disk below which no clip is started.
    pub disk_floor: Option<u64>,
    pub clips_max: Option<u64>,
    /// Maximum total size of clips to keep, in bytes.
    pub bytes_max: Option<u64>,
    /// Folder of the spools of deployed lambdas, and the maximum size of each, in bytes.
    pub spool: Option<(PathBuf, u64)>,
    pub signing: Option<ClipSigning>,
    /// Folder of cgroup v2 for the control groups of the lambdas.
    pub cgroup: Option<PathBuf>,
}

impl RunSpec {
    /// Returns whether it is the endless run of a vehicle.
    pub(crate) fn is_vehicle(&self) -> bool {
        self.spool.is_some()
    }
}

#[derive(Clone, Debug)]
pub struct ClipSigning {
    /// The open file of the key, which only the recorder reads.
    pub key: Arc<File>,
    pub vehicle: String,
}

#[derive(Clone, Debug)]
pub struct LambdaSpec {
    /// Its folder, with a fresh build.
    pub folder: PathBuf,
    pub manifest: Manifest,
    /// Its result folder.
    pub out: PathBuf,
    /// Text before each message about it; empty for the only one of a run.
    pub prefix: String,
    /// Overrides of its config, as `KEY=VALUE`.
    pub set: Vec<String>,
    /// Renamed topics: from and to.
    pub remaps: Vec<(String, String)>,
    /// Its deployment, on a vehicle: then its files are checked before each start.
    pub deployment: Option<Box<DesiredLambda>>,
}

impl LambdaSpec {
    pub fn name(&self) -> &str {
        self.manifest.lambda.name.as_str()
    }

    /// Returns whether it is started again after every end, unless it fails too often.
    pub(crate) fn is_kept(&self) -> bool {
        self.deployment.is_some()
    }

    /// Returns the path of the record of how its process ended.
    pub(crate) fn exit_record(&self) -> PathBuf {
        self.out.join(ExitRecord::FILE)
    }

    /// Returns its settings as arguments of the runtime.
    pub(crate) fn settings(&self, vehicle: Option<&Path>) -> Vec<OsString> {
        let set = self.set.iter().flat_map(|set| ["--set".into(), set.into()]);
        let remaps = self.remaps.iter();
        let remaps =
            remaps.flat_map(|(from, to)| ["--remap".into(), format!("{from}:={to}").into()]);
        let vehicle = vehicle.into_iter().flat_map(|file| ["--vehicle".into(), file.into()]);
        set.chain(remaps).chain(vehicle).collect()
    }

    /// Returns the name of a topic of the manifest on the network.
    pub(crate) fn on_network(&self, topic: &str) -> String {
        let renamed = self.remaps.iter().find(|(from, _)| from == topic);
        renamed.map_or_else(|| topic.to_owned(), |(_, to)| to.clone())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// Returns a lambda with an input, if any: its topic and maximum size. It records `topics`.
    pub(crate) fn recording(
        name: &str,
        input: Option<(&str, &str)>,
        topics: &[&str],
    ) -> LambdaSpec {
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
        LambdaSpec {
            folder: PathBuf::from(name),
            manifest: Manifest::parse(&text, "lambda.toml").unwrap(),
            out: PathBuf::from("live").join(name),
            prefix: format!("{name}: "),
            set: Vec::new(),
            remaps: Vec::new(),
            deployment: None,
        }
    }

    #[test]
    fn settings_are_arguments_of_the_runtime() {
        let mut lambda = recording("a", Some(("/imu", "1 KiB")), &[]);
        lambda.set.push("word=x=y".to_owned());
        lambda.remaps.push(("/imu".to_owned(), "/car/imu".to_owned()));
        let settings = lambda.settings(Some(Path::new("vehicle.toml")));
        let expected =
            ["--set", "word=x=y", "--remap", "/imu:=/car/imu", "--vehicle", "vehicle.toml"];
        assert_eq!(settings, expected.map(OsString::from));
        assert_eq!(
            (&*lambda.on_network("/imu"), &*lambda.on_network("/gps")),
            ("/car/imu", "/gps")
        );
    }
}

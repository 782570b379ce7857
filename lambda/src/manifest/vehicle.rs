//! `vehicle.toml`: identity and network of a vehicle, and limits for all lambdas on it. It is
//! parsed as a manifest is, with the same error messages.

use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::path::Path;
use std::time::Duration;

use gleaner_base::ByteSize;

use super::table::Document;
use super::{ItemName, Limits, ManifestError, TopicName, bounds, read_text, read_vehicle};

/// The validated configuration of a vehicle.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
pub struct Vehicle {
    /// `[vehicle]`.
    pub identity: VehicleIdentity,
    pub network: NetworkSettings,
    /// `[limits]`: upper bounds of the limits of each lambda. Limits that the file does not name
    /// are at the maximum of manifests.
    pub limits: Limits,
    pub inference: InferenceLimits,
    pub recording: RecordingSettings,
    pub deployments: DeploymentSettings,
    pub metrics: MetricsSettings,
}

/// `[vehicle]`: the vehicle among others.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct VehicleIdentity {
    /// Its name; without one, that of the machine is used.
    pub name: Option<ItemName>,
    /// Names and values by which deployments select vehicles.
    pub labels: BTreeMap<ItemName, String>,
}

/// `[network]`: the network of the daemon; `gleaner run` has options instead.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct NetworkSettings {
    /// DDS domain; without one, `ROS_DOMAIN_ID` counts, else 0.
    pub domain: Option<u16>,
    /// Addresses of the network interfaces; without any, all.
    pub interfaces: Vec<IpAddr>,
    /// True to receive topics with real-time priority, where the system permits it.
    pub real_time: bool,
}

/// `[recording]`: settings of the recorder of the daemon.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct RecordingSettings {
    pub commands: Option<TopicName>,
    /// Free space of the disk below which no clip is started.
    pub disk_floor: Option<ByteSize>,
    pub clips_max: Option<u64>,
    /// Maximum total size of clips to keep.
    pub bytes_max: Option<ByteSize>,
}

/// `[deployments]`: settings of the daemon.
#[derive(Debug, Clone, PartialEq)]
pub struct DeploymentSettings {
    /// Time that a revision must run without a failure before it is trusted to work.
    pub probation: Duration,
    /// Maximum size of the decisions and log lines of one lambda on the disk.
    pub spool: ByteSize,
    /// Memory that all lambdas together may ask for; without it, half of the machine's.
    pub memory: Option<ByteSize>,
    /// Memory that the topics of all lambdas together may take; without it, a quarter of the
    /// machine's.
    pub topics: Option<ByteSize>,
    /// Share of the machine's cores that all lambdas together may ask for.
    pub cpu: f64,
    /// Share of its time in which the process of models may run models.
    pub model_time: f64,
    /// Topic on which decisions are published.
    pub decisions: Option<TopicName>,
}

/// `[metrics]`: access to the counts of the daemon without its socket.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct MetricsSettings {
    /// Address of this machine at which any of its users can read them; default: none.
    pub listen: Option<SocketAddr>,
}

/// `[inference]`: limits of the process that runs models.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct InferenceLimits {
    pub memory: ByteSize,
    /// Longest run of a model that cannot be interrupted.
    pub run_max: Duration,
    pub load_max: Duration,
}

/// The configuration without a file.
impl Default for Vehicle {
    fn default() -> Self {
        Self {
            identity: VehicleIdentity::default(),
            network: NetworkSettings::default(),
            limits: Limits::MAX,
            inference: InferenceLimits::default(),
            recording: RecordingSettings::default(),
            deployments: DeploymentSettings::default(),
            metrics: MetricsSettings::default(),
        }
    }
}

impl Default for DeploymentSettings {
    fn default() -> Self {
        Self {
            probation: bounds::PROBATION.default,
            spool: bounds::SPOOL.default,
            memory: None,
            topics: None,
            cpu: bounds::CPU_SHARE.default,
            model_time: bounds::MODEL_SHARE.default,
            decisions: None,
        }
    }
}

impl Default for InferenceLimits {
    fn default() -> Self {
        Self {
            memory: bounds::INFERENCE_MEMORY.default,
            run_max: bounds::RUN_MAX.default,
            load_max: bounds::LOAD_MAX.default,
        }
    }
}

impl Vehicle {
    /// Parses the configuration in `text`. `file` is its name in messages, usually `vehicle.toml`.
    ///
    /// # Errors
    ///
    /// The first problem that is found, with its line: an unknown key, or a value outside of the
    /// range of manifests.
    pub fn parse(text: &str, file: impl AsRef<Path>) -> Result<Vehicle, ManifestError> {
        let file = file.as_ref().display().to_string();
        read_vehicle::vehicle(&Document { text, file: &file })
    }

    /// Loads the configuration from the file `path`.
    ///
    /// # Errors
    ///
    /// As [`parse`](Self::parse), and if it cannot be read, is too long, or is not UTF-8.
    pub fn load(path: impl AsRef<Path>) -> Result<Vehicle, ManifestError> {
        let path = path.as_ref();
        Vehicle::parse(&read_text(path)?, path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_base::Explain;

    #[test]
    fn limits_that_a_vehicle_does_not_name_are_at_their_maximum() {
        let vehicle =
            Vehicle::parse("[limits]\nfuel = 10_000_000\nmemory = \"32 MiB\"", "vehicle.toml")
                .unwrap();
        assert_eq!((vehicle.limits.fuel, vehicle.limits.memory), (10_000_000, ByteSize::mib(32)));
        assert_eq!(vehicle.limits.deadline, Limits::MAX.deadline);
        assert_eq!(Vehicle::parse("", "vehicle.toml").unwrap(), Vehicle::default());
    }

    #[test]
    fn limits_of_models_have_defaults_of_their_own() {
        let vehicle = |text: &str| Vehicle::parse(text, "vehicle.toml").unwrap().inference;
        let defaults = InferenceLimits::default();
        assert_eq!(vehicle("[limits]"), defaults);
        assert_eq!(
            vehicle("[inference]\nmemory = \"4 GiB\"\nload_max = \"10min\""),
            InferenceLimits {
                memory: ByteSize::gib(4),
                load_max: Duration::from_secs(600),
                ..defaults
            }
        );
    }

    #[test]
    fn a_vehicle_has_a_name_labels_a_network_and_settings_of_the_daemon() {
        let text = r#"
            [vehicle]
            name = "car-7"
            labels = { site = "berlin", sensor-set = "b" }
            [network]
            domain = 7
            interfaces = ["10.0.0.5", "::1"]
            real_time = true
            [recording]
            commands = "/record"
            clips_max = 100
            bytes_max = "100 GiB"
            [deployments]
            probation = "1min"
            memory = "2 GiB"
            cpu = 0.5
            model_time = 1
            "#;
        let vehicle = Vehicle::parse(text, "vehicle.toml").unwrap();
        assert_eq!(vehicle.identity.name.unwrap().as_str(), "car-7");
        let labels: Vec<_> = vehicle.identity.labels.values().collect();
        assert_eq!(labels, ["b", "berlin"]);
        assert_eq!(vehicle.network.domain, Some(7));
        assert_eq!(vehicle.network.interfaces.len(), 2);
        assert!(vehicle.network.real_time);
        assert_eq!(vehicle.recording.commands.unwrap().as_str(), "/record");
        assert_eq!((vehicle.recording.clips_max, vehicle.recording.disk_floor), (Some(100), None));
        let deployments = DeploymentSettings {
            probation: Duration::from_secs(60),
            memory: Some(ByteSize::gib(2)),
            cpu: 0.5,
            model_time: 1.0,
            ..DeploymentSettings::default()
        };
        assert_eq!(vehicle.deployments, deployments);
    }

    #[test]
    fn unknown_keys_and_values_out_of_range_are_refused_with_their_line() {
        for (text, problem, help) in [
            (
                "[network]\ninterfaces = [\"eth0\"]",
                "vehicle.toml, line 2: `network.interfaces` is `eth0`, which is not a network address",
                "an address of a network interface, such as `192.168.1.5`",
            ),
            (
                "[metrics]\nlisten = \"0.0.0.0:9464\"",
                "vehicle.toml, line 2: `metrics.listen` is `0.0.0.0:9464`, which is not a metrics address",
                "an address and a port of this machine, such as `127.0.0.1:9464`",
            ),
            (
                "[network]\ndomain = 233",
                "vehicle.toml, line 2: `network.domain` is 233, above the maximum of 232",
                "give a value from 0 to 232",
            ),
            (
                "[network]\nreal_time = \"yes\"",
                "vehicle.toml, line 2: `network.real_time` is a text",
                "give true or false",
            ),
            (
                "\n[limits]\nfule = 1",
                "vehicle.toml, line 3: unknown key `fule` in [limits]",
                "did you mean `fuel`?",
            ),
            (
                "[limit]",
                "vehicle.toml, line 1: unknown key `limit` at the top level",
                "did you mean `limits`?",
            ),
            (
                "[inference]\nrun_max = \"0s\"",
                "vehicle.toml, line 2: `inference.run_max` is 0s, below the minimum of 1s",
                "give a value from 1s to 1h",
            ),
            (
                "[deployments]\ncpu = 1.5",
                "vehicle.toml, line 2: `deployments.cpu` is 1.5, above the maximum of 1",
                "give a value from 0.01 to 1",
            ),
            (
                "[deployments]\ncpu = nan",
                "vehicle.toml, line 2: `deployments.cpu` is `nan`, which is not a finite number",
                "give a number that is neither infinite nor nan",
            ),
            (
                "[inference]\nmodels = 3",
                "vehicle.toml, line 2: unknown key `models` in [inference]",
                "the known keys are `memory`, `run_max` and `load_max`",
            ),
        ] {
            let error = Vehicle::parse(text, "vehicle.toml").unwrap_err();
            assert_eq!(
                (error.to_string().as_str(), error.help().as_deref()),
                (problem, Some(help))
            );
        }
    }

    #[test]
    fn a_missing_vehicle_file_has_help_of_its_own() {
        let error = Vehicle::load("no/such/vehicle.toml").unwrap_err();
        assert_eq!(error.to_string(), "cannot read `no/such/vehicle.toml`");
        assert_eq!(
            error.help().as_deref(),
            Some("name the vehicle's configuration file; see docs/limits.md")
        );
    }
}

//! Parses `vehicle.toml`.

use std::net::{IpAddr, SocketAddr};
use std::ops::RangeInclusive;

use gleaner_base::ByteSize;
use toml::de::DeTable;

use super::bounds::{self, Bounds};
use super::error::ManifestError;
use super::read::limits;
use super::syntax;
use super::table::{Document, TomlTable};
use super::value::TomlValue;
use super::vehicle::{
    DeploymentSettings, InferenceLimits, MetricsSettings, NetworkSettings, RecordingSettings,
    Vehicle, VehicleIdentity,
};
use super::{Limits, TopicName};

type Result<T> = std::result::Result<T, ManifestError>;

const TABLES: &[&str] =
    &["vehicle", "network", "limits", "inference", "recording", "deployments", "metrics"];
/// Domains of DDS whose ports exist.
const DOMAINS: RangeInclusive<u64> = 0..=232;
/// Length of a label's value in bytes, as in a signed selector.
const LABEL_MAX: usize = 128;

pub(super) fn vehicle(document: &Document) -> Result<Vehicle> {
    let entries =
        DeTable::parse(document.text).map_err(|error| syntax::explain(document, &error))?;
    let root = TomlTable::root(document, entries.get_ref(), TABLES)?;
    Ok(Vehicle {
        identity: part(&root, "vehicle", &["name", "labels"], identity)?,
        network: part(&root, "network", &["domain", "interfaces", "real_time"], network)?,
        limits: limits(root.get("limits").as_ref(), Limits::MAX)?,
        inference: part(&root, "inference", &["memory", "run_max", "load_max"], inference)?,
        recording: part(
            &root,
            "recording",
            &["commands", "disk_floor", "clips_max", "bytes_max"],
            recording,
        )?,
        deployments: part(
            &root,
            "deployments",
            &["probation", "spool", "memory", "topics", "cpu", "model_time", "decisions"],
            deployments,
        )?,
        metrics: part(&root, "metrics", &["listen"], metrics)?,
    })
}

/// Parses the table `name`; without it, its settings have their defaults.
fn part<T: Default>(
    root: &TomlTable,
    name: &'static str,
    known: &'static [&'static str],
    parse: impl FnOnce(&TomlTable) -> Result<T>,
) -> Result<T> {
    let Some(value) = root.get(name) else { return Ok(T::default()) };
    parse(&value.table(&format!("[{name}]"), known)?)
}

fn identity(table: &TomlTable) -> Result<VehicleIdentity> {
    let label = |value: TomlValue| {
        let text = value.text()?;
        if text.len() > LABEL_MAX || text.contains(char::is_control) {
            let rule = "a text of 128 bytes at most, without control characters";
            return Err(value.wrong_form(text, "label", rule));
        }
        Ok((value.parse_key()?, text.to_owned()))
    };
    let labels = table.get("labels").map(|labels| {
        let labels = labels.open_table("[vehicle.labels]")?;
        labels.entries().into_iter().map(label).collect()
    });
    let name = table.get("name").map(|name| name.parse()).transpose()?;
    Ok(VehicleIdentity { name, labels: labels.transpose()?.unwrap_or_default() })
}

fn network(table: &TomlTable) -> Result<NetworkSettings> {
    let address = |value: TomlValue| -> Result<IpAddr> {
        let text = value.text()?;
        let rule = "an address of a network interface, such as `192.168.1.5`";
        text.parse().map_err(|_| value.wrong_form(text, "network address", rule))
    };
    let interfaces = table.get("interfaces").map(|value| {
        value.items("a list of addresses")?.into_iter().map(address).collect::<Result<_>>()
    });
    let domain = table.get("domain").map(|value| value.integer(&DOMAINS)).transpose()?;
    Ok(NetworkSettings {
        domain: domain.and_then(|domain| u16::try_from(domain).ok()),
        interfaces: interfaces.transpose()?.unwrap_or_default(),
        real_time: table.flag("real_time")?,
    })
}

fn inference(table: &TomlTable) -> Result<InferenceLimits> {
    Ok(InferenceLimits {
        memory: table.size("memory", &bounds::INFERENCE_MEMORY)?,
        run_max: table.duration("run_max", &bounds::RUN_MAX)?,
        load_max: table.duration("load_max", &bounds::LOAD_MAX)?,
    })
}

fn recording(table: &TomlTable) -> Result<RecordingSettings> {
    let all = ByteSize::mib(1)..=ByteSize::gib(1 << 20);
    let size = |key| table.get(key).map(|value| value.size(&all)).transpose();
    let clips_max = table.get("clips_max").map(|value| value.integer(&(1..=1_000_000_000)));
    Ok(RecordingSettings {
        commands: topic(table, "commands")?,
        disk_floor: size("disk_floor")?,
        clips_max: clips_max.transpose()?,
        bytes_max: size("bytes_max")?,
    })
}

fn deployments(table: &TomlTable) -> Result<DeploymentSettings> {
    let sizes = ByteSize::mib(64)..=ByteSize::gib(1024);
    let size = |key| table.get(key).map(|value| value.size(&sizes)).transpose();
    let share = |key, bounds: Bounds<f64>| {
        table.get(key).map_or(Ok(bounds.default), |value| value.number(&bounds.range()))
    };
    Ok(DeploymentSettings {
        probation: table.duration("probation", &bounds::PROBATION)?,
        spool: table.size("spool", &bounds::SPOOL)?,
        memory: size("memory")?,
        topics: size("topics")?,
        cpu: share("cpu", bounds::CPU_SHARE)?,
        model_time: share("model_time", bounds::MODEL_SHARE)?,
        decisions: topic(table, "decisions")?,
    })
}

fn metrics(table: &TomlTable) -> Result<MetricsSettings> {
    let listen = table.get("listen").map(|value| {
        let text = value.text()?;
        // They are not protected: other machines must not reach them.
        let rule = "an address and a port of this machine, such as `127.0.0.1:9464`";
        let address = text.parse().ok().filter(|address: &SocketAddr| address.ip().is_loopback());
        address.ok_or_else(|| value.wrong_form(text, "metrics address", rule))
    });
    Ok(MetricsSettings { listen: listen.transpose()? })
}

fn topic(table: &TomlTable, key: &str) -> Result<Option<TopicName>> {
    table.get(key).map(|value| value.parse()).transpose()
}

//! Options for joining a domain.

use std::error::Error;
use std::io;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;

use gleaner_messages::transport::Clock;
use gleaner_messages::transport::clock::time_of_day;

/// The highest domain that has valid ports.
const LAST_DOMAIN: u16 = 232;
const DOMAIN: &str = "ROS_DOMAIN_ID";
const DOMAINS: &str = "it may be a number from 0 to 232";
/// Most entries of `AMENT_PREFIX_PATH` that are read.
const PREFIXES: usize = 256;

/// A distribution of ROS 2, as far as it changes our messages to other nodes.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Distro {
    /// Humble and older: GIDs of endpoints have 24 bytes in the graph.
    Humble,
    /// Iron and newer: 16 bytes.
    Newer,
}

#[derive(Clone, Debug)]
pub struct DdsOptions {
    /// The domain; `ROS_DOMAIN_ID`.
    pub domain: u16,
    /// Addresses of the interfaces to use; all if empty.
    pub interfaces: Vec<IpAddr>,
    /// Namespace and name of our node in the graph, for example `/gleaner/hello`.
    pub node: String,
    /// The distribution of the other nodes; `None`: detected from their graph messages.
    pub distro: Option<Distro>,
    /// Bytes of the largest sample, which sets the size of socket buffers; 0 if no samples are to
    /// be received.
    pub largest: usize,
    /// True if this process runs in real time and keeps the memory that it frees: then memory for
    /// samples is mapped before the first one.
    pub real_time: bool,
    /// Folders with message definitions, searched first.
    pub messages: Vec<PathBuf>,
    /// Install prefixes of ROS 2, searched last; `AMENT_PREFIX_PATH`.
    pub prefixes: Vec<PathBuf>,
    /// The clock of receive stamps.
    pub clock: Clock,
    /// Returns the time of day, in ns since 1970. No sample is stamped with it: it is watched,
    /// because RustDDS depends on it.
    pub time_of_day: fn() -> i64,
}

#[derive(Debug, thiserror::Error)]
pub enum DdsError {
    #[error("cannot join domain {domain}")]
    Join { domain: u16, source: Box<dyn Error + Send + Sync> },
    #[error("{variable} is `{value}`; {wanted}")]
    Setting {
        variable: &'static str,
        /// Its value, made printable.
        value: String,
        wanted: &'static str,
    },
    #[error("`{name}` is not {what}")]
    Name {
        /// The name, made printable.
        name: String,
        what: &'static str,
    },
    #[error("no network interface has the address {address}")]
    Interface { address: IpAddr, source: io::Error },
    #[error("cannot write topic `{topic}`")]
    Advertise { topic: String, source: Box<dyn Error + Send + Sync> },
    #[error("a message of topic `{topic}` was not sent: {why}")]
    Write { topic: String, why: String },
}

impl DdsOptions {
    /// Domain 0 on all interfaces as `node`, for samples of up to 8 MiB, with the time of day as
    /// clock.
    pub fn new(node: impl Into<String>) -> Self {
        Self {
            domain: 0,
            interfaces: Vec::new(),
            node: node.into(),
            distro: None,
            largest: 8 << 20,
            real_time: false,
            messages: Vec::new(),
            prefixes: Vec::new(),
            clock: Clock::from_time_of_day(),
            time_of_day,
        }
    }

    /// With this domain instead, if one is given, and on these interfaces alone, if there are any.
    pub fn narrowed(self, domain: Option<u16>, interfaces: Vec<IpAddr>) -> Self {
        let interfaces = if interfaces.is_empty() { self.interfaces } else { interfaces };
        Self { domain: domain.unwrap_or(self.domain), interfaces, ..self }
    }

    /// Reads the environment of ROS 2: `ROS_DOMAIN_ID`, `ROS_LOCALHOST_ONLY`,
    /// `ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_DISTRO` and `AMENT_PREFIX_PATH`; otherwise as
    /// [`DdsOptions::new`].
    ///
    /// # Errors
    ///
    /// [`DdsError::Setting`] if a variable has an invalid value.
    pub fn from_env(node: impl Into<String>) -> Result<Self, DdsError> {
        Self::read(node.into(), |variable| {
            std::env::var_os(variable).map(|value| value.to_string_lossy().into_owned())
        })
    }

    /// Checks the options; returns the namespace and name of the node.
    pub(super) fn checked(&self) -> Result<(String, String), DdsError> {
        if self.domain > LAST_DOMAIN {
            return Err(setting(DOMAIN, &self.domain.to_string(), DOMAINS));
        }
        let what = "a node's namespace and name";
        super::names::node(&self.node)
            .ok_or_else(|| DdsError::Name { name: super::names::visible(&self.node), what })
    }

    fn read(node: String, variable: impl Fn(&str) -> Option<String>) -> Result<Self, DdsError> {
        let variable = |name| variable(name).filter(|value| !value.is_empty());
        let mut options = Self::new(node);
        options.domain = domain_of(variable(DOMAIN).as_deref())
            .map_err(|value| setting(DOMAIN, value, DOMAINS))?;
        let range = variable("ROS_AUTOMATIC_DISCOVERY_RANGE");
        let here = match range.as_deref().map(str::to_ascii_uppercase).as_deref() {
            None | Some("SUBNET" | "SYSTEM_DEFAULT") => {
                variable("ROS_LOCALHOST_ONLY").as_deref() == Some("1")
            }
            Some("LOCALHOST") => true,
            Some(_) => {
                let wanted = "use SUBNET, LOCALHOST or SYSTEM_DEFAULT";
                return Err(setting(
                    "ROS_AUTOMATIC_DISCOVERY_RANGE",
                    &range.unwrap_or_default(),
                    wanted,
                ));
            }
        };
        if here {
            options.interfaces = vec![IpAddr::V4(Ipv4Addr::LOCALHOST)];
        }
        options.distro = match variable("ROS_DISTRO").as_deref() {
            Some("foxy" | "galactic" | "humble") => Some(Distro::Humble),
            Some("iron" | "jazzy" | "kilted" | "lyrical" | "rolling") => Some(Distro::Newer),
            // An unknown distribution is detected as if the variable were unset.
            _ => None,
        };
        if let Some(value) = variable("AMENT_PREFIX_PATH") {
            let prefixes = value.split(':').filter(|prefix| !prefix.is_empty());
            options.prefixes = prefixes.take(PREFIXES).map(PathBuf::from).collect();
        }
        Ok(options)
    }
}

/// Parses the content of `ROS_DOMAIN_ID`; 0 if there is none. White space around it is ignored.
///
/// # Errors
///
/// The trimmed content, if it is not a valid domain.
fn domain_of(content: Option<&str>) -> Result<u16, &str> {
    match content.map(str::trim) {
        None | Some("") => Ok(0),
        Some(text) => text.parse().ok().filter(|domain| *domain <= LAST_DOMAIN).ok_or(text),
    }
}

fn setting(variable: &'static str, value: &str, wanted: &'static str) -> DdsError {
    DdsError::Setting { variable, value: super::names::visible(value), wanted }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(variables: &[(&str, &str)]) -> Result<DdsOptions, DdsError> {
        DdsOptions::read("/n".to_owned(), |name| {
            variables.iter().find(|(known, _)| *known == name).map(|(_, value)| (*value).to_owned())
        })
    }

    #[test]
    fn an_empty_environment_means_domain_0_on_all_interfaces() {
        let options = read(&[("ROS_DOMAIN_ID", ""), ("ROS_DISTRO", "")]).unwrap();
        assert_eq!((options.domain, options.interfaces.len(), options.distro), (0, 0, None));
    }

    #[test]
    fn the_environment_of_ros_is_read() {
        let all = [
            ("ROS_DOMAIN_ID", "232"),
            ("ROS_DISTRO", "humble"),
            ("AMENT_PREFIX_PATH", "/opt/a::/opt/b"),
        ];
        let options = read(&all).unwrap();
        assert_eq!((options.domain, options.distro), (232, Some(Distro::Humble)));
        assert_eq!(options.prefixes, [PathBuf::from("/opt/a"), PathBuf::from("/opt/b")]);
        assert_eq!(read(&[("ROS_DISTRO", "jazzy")]).unwrap().distro, Some(Distro::Newer));
        assert_eq!(read(&[("ROS_DISTRO", "unknown")]).unwrap().distro, None);
        for here in [("ROS_LOCALHOST_ONLY", "1"), ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")] {
            assert_eq!(read(&[here]).unwrap().interfaces, [IpAddr::V4(Ipv4Addr::LOCALHOST)]);
        }
        assert_eq!(read(&[("ROS_LOCALHOST_ONLY", "0")]).unwrap().interfaces, [] as [IpAddr; 0]);
    }

    #[test]
    fn all_programs_read_the_same_domain() {
        // `gleaner doctor` and the player are tested with the same page: they cannot share this
        // code.
        let page = include_str!("../../../tests/domains.txt");
        for line in page.lines().filter(|line| line.starts_with('|')) {
            let (content, domain) = line[1..].split_once('|').unwrap();
            let read = read(&[("ROS_DOMAIN_ID", content)]).map(|options| options.domain);
            assert_eq!(read.ok(), domain.trim().parse().ok(), "{line}");
        }
    }

    #[test]
    fn invalid_values_are_refused_by_name() {
        for domain in ["233", "-1", "one", "1 2", "99999999999"] {
            let error = read(&[("ROS_DOMAIN_ID", domain)]).unwrap_err().to_string();
            let expected = format!("ROS_DOMAIN_ID is `{domain}`; it may be a number from 0 to 232");
            assert_eq!(error, expected);
        }
        let refused = read(&[("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")]).unwrap_err();
        assert!(refused.to_string().contains("`OFF`"));
    }
}

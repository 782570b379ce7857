//! How a domain is joined.

use std::error::Error;
use std::net::{IpAddr, Ipv4Addr};
use std::path::PathBuf;

use gleaner_transport::Clock;
use gleaner_transport::clock::time_of_day;

/// The highest domain whose ports exist.
const LAST_DOMAIN: u16 = 232;
const DOMAIN: &str = "ROS_DOMAIN_ID";
const DOMAINS: &str = "it may be a number from 0 to 232";
/// The environment is not longer where it means well.
const PREFIXES: usize = 256;

/// A distribution of ROS 2, as far as nodes of others have to know it of us.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Distro {
    /// Humble and older: names of endpoints have 24 bytes in the graph.
    Humble,
    /// Iron and newer: 16 bytes.
    Newer,
}

/// How a domain is joined.
#[derive(Clone, Debug)]
pub struct Options {
    /// The domain; `ROS_DOMAIN_ID`.
    pub domain: u16,
    /// Addresses of the interfaces to use; all if empty.
    pub interfaces: Vec<IpAddr>,
    /// Namespace and name of the node that others see, for example `/gleaner/hello`.
    pub node: String,
    /// The distribution of the others; `None`: found out from what they say.
    pub distro: Option<Distro>,
    /// Bytes of the largest sample, by which socket buffers are sized; 0 if no samples are to be
    /// received.
    pub largest: usize,
    /// Folders with message definitions, looked through first.
    pub messages: Vec<PathBuf>,
    /// Where ROS 2 is installed, looked through last; `AMENT_PREFIX_PATH`.
    pub prefixes: Vec<PathBuf>,
    /// The clock of receive stamps.
    pub clock: Clock,
    /// What tells the time of day, in ns since 1970. No sample is stamped with it: it is watched,
    /// because RustDDS depends on it.
    pub time_of_day: fn() -> i64,
}

/// Why DDS does not do what it was asked for.
#[derive(Debug, thiserror::Error)]
pub enum DdsError {
    /// No participant.
    #[error("cannot join domain {domain}")]
    Join {
        /// The domain.
        domain: u16,
        /// What the library says.
        source: Box<dyn Error + Send + Sync>,
    },
    /// An environment variable has a value that means nothing.
    #[error("{variable} is `{value}`; {wanted}")]
    Setting {
        /// The variable.
        variable: &'static str,
        /// Its value, made fit to be shown.
        value: String,
        /// What it may be.
        wanted: &'static str,
    },
    /// What should be a name is none in ROS 2.
    #[error("`{name}` is not {what}")]
    Name {
        /// The name, made fit to be shown.
        name: String,
        /// What it should be.
        what: &'static str,
    },
    /// No writer.
    #[error("cannot write topic `{topic}`")]
    Advertise {
        /// The topic.
        topic: String,
        /// What the library says.
        source: Box<dyn Error + Send + Sync>,
    },
    /// A message was not sent.
    #[error("a message of topic `{topic}` was not sent: {why}")]
    Write {
        /// The topic.
        topic: String,
        /// Why.
        why: String,
    },
}

impl Options {
    /// Domain 0 on all interfaces as `node`, for samples of up to 8 MiB, with the time of day as
    /// clock.
    pub fn new(node: impl Into<String>) -> Self {
        Self {
            domain: 0,
            interfaces: Vec::new(),
            node: node.into(),
            distro: None,
            largest: 8 << 20,
            messages: Vec::new(),
            prefixes: Vec::new(),
            clock: Clock::of_today(),
            time_of_day,
        }
    }

    /// With this domain instead, if one is given, and on these interfaces alone, if there are any.
    pub fn narrowed(self, domain: Option<u16>, interfaces: Vec<IpAddr>) -> Self {
        let interfaces = if interfaces.is_empty() { self.interfaces } else { interfaces };
        Self { domain: domain.unwrap_or(self.domain), interfaces, ..self }
    }

    /// As the environment of ROS 2 says: `ROS_DOMAIN_ID`, `ROS_LOCALHOST_ONLY`,
    /// `ROS_AUTOMATIC_DISCOVERY_RANGE`, `ROS_DISTRO` and `AMENT_PREFIX_PATH`; otherwise as
    /// [`Options::new`].
    ///
    /// # Errors
    ///
    /// [`DdsError::Setting`] if a variable has a value that means nothing.
    pub fn from_env(node: impl Into<String>) -> Result<Self, DdsError> {
        Self::read(node.into(), |variable| {
            std::env::var_os(variable).map(|value| value.to_string_lossy().into_owned())
        })
    }

    /// Namespace and name of the node, if all is as it must be.
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
                let wanted = "Gleaner knows SUBNET, LOCALHOST and SYSTEM_DEFAULT";
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
            // One that is not known yet is found out as if nothing were said.
            _ => None,
        };
        if let Some(value) = variable("AMENT_PREFIX_PATH") {
            let prefixes = value.split(':').filter(|prefix| !prefix.is_empty());
            options.prefixes = prefixes.take(PREFIXES).map(PathBuf::from).collect();
        }
        Ok(options)
    }
}

/// The domain that the content of `ROS_DOMAIN_ID` means; 0 if there is none. White space around it
/// means nothing.
///
/// # Errors
///
/// The content, without that space, if it means no domain.
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

    fn read(variables: &[(&str, &str)]) -> Result<Options, DdsError> {
        Options::read("/n".to_owned(), |name| {
            variables.iter().find(|(known, _)| *known == name).map(|(_, value)| (*value).to_owned())
        })
    }

    #[test]
    fn an_empty_environment_means_domain_0_on_all_interfaces() {
        let options = read(&[("ROS_DOMAIN_ID", ""), ("ROS_DISTRO", "")]).unwrap();
        assert_eq!((options.domain, options.interfaces.len(), options.distro), (0, 0, None));
    }

    #[test]
    fn the_environment_of_ros_is_understood() {
        let all = [
            ("ROS_DOMAIN_ID", "232"),
            ("ROS_DISTRO", "humble"),
            ("AMENT_PREFIX_PATH", "/opt/a::/opt/b"),
        ];
        let options = read(&all).unwrap();
        assert_eq!((options.domain, options.distro), (232, Some(Distro::Humble)));
        assert_eq!(options.prefixes, [PathBuf::from("/opt/a"), PathBuf::from("/opt/b")]);
        assert_eq!(read(&[("ROS_DISTRO", "jazzy")]).unwrap().distro, Some(Distro::Newer));
        assert_eq!(read(&[("ROS_DISTRO", "unheard-of")]).unwrap().distro, None);
        for here in [("ROS_LOCALHOST_ONLY", "1"), ("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")] {
            assert_eq!(read(&[here]).unwrap().interfaces, [IpAddr::V4(Ipv4Addr::LOCALHOST)]);
        }
        assert_eq!(read(&[("ROS_LOCALHOST_ONLY", "0")]).unwrap().interfaces, [] as [IpAddr; 0]);
    }

    #[test]
    fn the_domain_is_that_which_all_programs_of_ours_read() {
        // The same page is the test of `gleaner doctor` and of the player: they cannot share this
        // code.
        let page = include_str!("../../../tests/domains.txt");
        for line in page.lines().filter(|line| line.starts_with('|')) {
            let (content, domain) = line[1..].split_once('|').unwrap();
            let read = read(&[("ROS_DOMAIN_ID", content)]).map(|options| options.domain);
            assert_eq!(read.ok(), domain.trim().parse().ok(), "{line}");
        }
    }

    #[test]
    fn values_that_mean_nothing_are_refused_by_name() {
        for domain in ["233", "-1", "one", "1 2", "99999999999"] {
            let error = read(&[("ROS_DOMAIN_ID", domain)]).unwrap_err().to_string();
            assert_eq!(
                error,
                format!("ROS_DOMAIN_ID is `{domain}`; it may be a number from 0 to 232")
            );
        }
        assert!(
            read(&[("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF")])
                .unwrap_err()
                .to_string()
                .contains("`OFF`")
        );
    }
}

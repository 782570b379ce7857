//! Parses the command line; checks all that needs no file.

use std::fmt;
use std::net::IpAddr;
use std::path::PathBuf;
use std::str::FromStr;

use clap::{ArgGroup, Parser};
use gleaner_base::{Exit, Failure};
use gleaner_lambda::manifest::TopicName;

use crate::pace::Rate;
use crate::stamp::StampMode;

/// Play recorded drives as live topics of ROS 2, through Cyclone DDS
///
/// Topics keep their names, types and offered quality of service, so that nodes cannot distinguish
/// a drive from a vehicle. The DDS domain is --domain, else ROS_DOMAIN_ID, else 0. Ctrl-C stops
/// playing and prints the summary.
#[derive(Parser, Debug)]
#[command(name = "gleaner-player", bin_name = "gleaner play")]
#[command(version = gleaner_base::version())]
#[command(group = ArgGroup::new("what")
    .required(true)
    .multiple(true)
    .args(["drives", "synthetic", "imu"]))]
pub(crate) struct Args {
    /// MCAP files of one drive
    #[arg(value_name = "DRIVE")]
    pub(crate) drives: Vec<PathBuf>,
    /// Merge all files by time, even if they are separate drives
    #[arg(long)]
    pub(crate) merge: bool,
    /// Speed: 1 is as recorded, 2 twice as fast, max as fast as writers accept
    #[arg(long, value_name = "R", default_value = "1")]
    pub(crate) rate: Rate,
    /// Start again at the end, until ctrl-C
    #[arg(long = "loop")]
    pub(crate) looped: bool,
    /// Value of header.stamp: the wall clock when sent, as recorded, or the monotonic clock when
    /// sent
    #[arg(long, value_enum, default_value = "now")]
    pub(crate) stamp: StampMode,
    /// Play only these topics of the drive
    #[arg(long, value_name = "TOPIC,TOPIC", value_delimiter = ',')]
    pub(crate) topics: Vec<String>,
    /// New name for a played topic, as in /imu/data:=/car/imu
    #[arg(long, value_name = "FROM:=TO", value_parser = remap)]
    pub(crate) remap: Vec<(String, String)>,
    /// Start this many seconds into the drive
    #[arg(long, value_name = "S", value_parser = seconds, default_value = "0")]
    pub(crate) start: i64,
    /// Play only this many seconds of the drive
    #[arg(long, value_name = "S", value_parser = some_seconds)]
    pub(crate) duration: Option<i64>,
    /// Decode CompressedImage topics and send them as bgr8 images under .../image_raw
    #[arg(long)]
    pub(crate) raw_images: bool,
    /// Scale the images of --raw-images, at most to 3848x2168
    #[arg(long, value_name = "WxH", requires = "raw_images")]
    pub(crate) size: Option<Size>,
    /// Wait until each topic has N readers
    #[arg(long, value_name = "N", default_value = "0")]
    pub(crate) wait: usize,
    /// DDS domain, 0 to 232
    #[arg(
        long,
        value_name = "N",
        value_parser = clap::value_parser!(u32).range(0..=i64::from(LAST_DOMAIN))
    )]
    pub(crate) domain: Option<u32>,
    /// Use only the network interface with this address
    #[arg(long, value_name = "IP")]
    pub(crate) interface: Option<IpAddr>,
    /// Print the summary as one JSON object
    #[arg(long)]
    pub(crate) json: bool,
    /// Without a drive: noise as bgr8 images on /camera/synthetic/image_raw, as in 1920x1080@30
    #[arg(
        long,
        value_name = "WxH@HZ",
        conflicts_with_all = ["drives", "looped", "topics", "start", "raw_images"]
    )]
    pub(crate) synthetic: Option<SyntheticCamera>,
    /// Without a drive: an IMU at rest on /imu/synthetic
    #[arg(
        long,
        value_name = "HZ",
        value_parser = hertz,
        conflicts_with_all = ["drives", "looped", "topics", "start", "raw_images"]
    )]
    pub(crate) imu: Option<f64>,
}

/// The largest domain whose ports fit below 65536.
const LAST_DOMAIN: u32 = 232;

/// Pixels per row, and rows.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Size {
    pub(crate) width: u32,
    pub(crate) height: u32,
}

impl Size {
    /// Resolution of the largest camera of the Zenseact Open Dataset; 25 MB in bgr8.
    const LARGEST: Size = Size { width: 3848, height: 2168 };

    /// Bytes of an image of this size in bgr8.
    pub(crate) fn bytes(self) -> usize {
        3 * self.width as usize * self.height as usize
    }
}

impl fmt::Display for Size {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}x{}", self.width, self.height)
    }
}

impl FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Size, String> {
        let sides = text
            .split_once('x')
            .and_then(|(width, height)| Some((width.parse().ok()?, height.parse().ok()?)));
        match sides {
            Some((width, height))
                if (1..=Size::LARGEST.width).contains(&width)
                    && (1..=Size::LARGEST.height).contains(&height) =>
            {
                Ok(Size { width, height })
            }
            _ => Err(format!("write WIDTHxHEIGHT, as in 1920x1080, at most {}", Size::LARGEST)),
        }
    }
}

#[derive(Copy, Clone, Debug, PartialEq)]
pub(crate) struct SyntheticCamera {
    pub(crate) size: Size,
    pub(crate) hertz: f64,
}

impl FromStr for SyntheticCamera {
    type Err = String;

    fn from_str(text: &str) -> Result<SyntheticCamera, String> {
        let (size, rate) =
            text.split_once('@').ok_or("write WIDTHxHEIGHT@HZ, as in 1920x1080@30")?;
        Ok(SyntheticCamera { size: size.parse()?, hertz: hertz(rate)? })
    }
}

impl Args {
    /// The domain to play in: `--domain`, else `environment`, the content of `ROS_DOMAIN_ID`, else
    /// 0.
    pub(crate) fn domain(&self, environment: Option<&str>) -> Result<u32, Failure> {
        match (self.domain, environment.map(str::trim)) {
            (Some(domain), _) => Ok(domain),
            (None, None | Some("")) => Ok(0),
            (None, Some(text)) => {
                text.parse().ok().filter(|domain| *domain <= LAST_DOMAIN).ok_or_else(|| {
                    Failure::new(
                        Exit::Usage,
                        format!("ROS_DOMAIN_ID is `{text}`, which is not a domain"),
                    )
                    .with_help(format!(
                        "set it to a number from 0 to {LAST_DOMAIN}, or give --domain"
                    ))
                })
            }
        }
    }
}

/// Parses FROM:=TO. A drive may use any topic name; the new name must be valid in ROS 2.
fn remap(text: &str) -> Result<(String, String), String> {
    match text.split_once(":=").map(|(from, to)| (from.trim(), to.trim())) {
        Some((from, to)) if !from.is_empty() && !to.is_empty() => match to.parse::<TopicName>() {
            Ok(to) => Ok((from.to_owned(), to.to_string())),
            Err(error) => Err(format!("{error}: {}", error.rule)),
        },
        _ => Err("write FROM:=TO, as in /imu/data:=/car/imu".to_owned()),
    }
}

/// Parses seconds into nanoseconds; at most a year, so that sums of them do not overflow.
fn seconds(text: &str) -> Result<i64, String> {
    let seconds = text.parse::<f64>().ok().filter(|seconds| (0.0..=31_536_000.0).contains(seconds));
    seconds
        .map(|seconds| (seconds * 1e9) as i64)
        .ok_or_else(|| "write seconds, as in 12.5, at most a year".to_owned())
}

fn some_seconds(text: &str) -> Result<i64, String> {
    seconds(text)
        .and_then(|ns| if ns > 0 { Ok(ns) } else { Err("nothing would be played".to_owned()) })
}

fn hertz(text: &str) -> Result<f64, String> {
    let hertz = text.parse::<f64>().ok().filter(|hertz| (0.01..=10_000.0).contains(hertz));
    hertz.ok_or_else(|| "write a frequency in Hz, 0.01 to 10000".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(arguments: &[&str]) -> Result<Args, String> {
        Args::try_parse_from(["gleaner-player"].iter().chain(arguments))
            .map_err(|error| error.to_string())
    }

    #[test]
    fn the_definition_of_the_command_line_is_valid() {
        use clap::CommandFactory;
        Args::command().debug_assert();
    }

    #[test]
    fn a_drive_is_played_as_recorded_with_stamps_of_now_by_default() {
        let args = parse(&["a.mcap", "b.mcap"]).unwrap();
        assert_eq!(args.drives.len(), 2);
        assert_eq!(
            (args.rate, args.stamp, args.start, args.wait),
            (Rate::Times(1.0), StampMode::Now, 0, 0)
        );
        assert!(args.duration.is_none() && !args.looped && !args.raw_images && !args.json);
    }

    #[test]
    fn synthetic_sensors_need_no_drive_and_exclude_one() {
        let args =
            parse(&["--synthetic", "1920x1080@30", "--imu", "100", "--duration", "2.5"]).unwrap();
        let size = Size { width: 1920, height: 1080 };
        assert_eq!(
            (args.synthetic, args.imu),
            (Some(SyntheticCamera { size, hertz: 30.0 }), Some(100.0))
        );
        assert_eq!(args.duration, Some(2_500_000_000));
        assert!(parse(&[]).unwrap_err().contains("<DRIVE"));
        assert!(parse(&["a.mcap", "--imu", "100"]).is_err());
        assert!(parse(&["--imu", "100", "--loop"]).is_err());
    }

    #[test]
    fn invalid_arguments_are_refused_with_an_example() {
        for (arguments, expected) in [
            (["--rate", "0"], "greater than 0"),
            (["--rate", "-1"], "greater than 0"),
            (["--rate", "inf"], "greater than 0"),
            (["--remap", "/a=/b"], "FROM:=TO"),
            (["--remap", ":=/b"], "FROM:=TO"),
            (["--remap", "/a:=no name"], "`no name` is not a topic name"),
            (["--domain", "233"], "233"),
            (["--interface", "eth0"], "eth0"),
            (["--start", "-1"], "seconds"),
            (["--start", "nan"], "seconds"),
            (["--duration", "0"], "nothing"),
            (["--size", "1x1"], "--raw-images"),
            (["--stamp", "later"], "monotonic"),
        ] {
            let error = parse(&["a.mcap", &arguments.join("=")]).unwrap_err();
            assert!(error.contains(expected), "{arguments:?}: {error}");
        }
        for camera in
            ["1920x1080", "0x10@1", "3849x10@1", "10x2169@1", "10x10@0", "10x10@inf", "x@"]
        {
            assert!(parse(&["--synthetic", camera]).is_err(), "{camera}");
        }
    }

    #[test]
    fn the_domain_comes_from_the_arguments_then_from_ros_then_is_0() {
        let of = |arguments: &[&str], environment| parse(arguments).unwrap().domain(environment);
        assert_eq!(of(&["a", "--domain", "7"], Some("nonsense")), Ok(7));
        assert_eq!(of(&["a"], Some(" 42 ")), Ok(42));
        assert_eq!(of(&["a"], Some("")), Ok(0));
        assert_eq!(of(&["a"], None), Ok(0));
        // All programs are tested with this table.
        for line in
            include_str!("../../tests/domains.txt").lines().filter(|line| line.starts_with('|'))
        {
            let (content, domain) = line[1..].split_once('|').unwrap();
            assert_eq!(of(&["a"], Some(content)).ok(), domain.trim().parse().ok(), "{line}");
        }
        for invalid in ["233", "-1", "a", "4.0"] {
            assert_eq!(of(&["a"], Some(invalid)).unwrap_err().exit, Exit::Usage);
        }
    }
}

//! Workloads: the inputs, and the sides that answer them.

use clap::ValueEnum;
use gleaner_tests::{LambdaCopy, sample_drive};

use super::node::{NodeKind, NodeSide};
use super::sides::{LambdaSide, Side};
use crate::measure::Twin;

/// Limits of socket buffers: that of an ordinary Linux, a larger one, and that of the installation.
const BUFFERS: [u64; 3] = [212_992, 4 << 20, 64 << 20];

/// A workload.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Workload {
    /// An IMU at 100 Hz; nothing is computed.
    Empty,
    /// The same with cores that do not sleep.
    EmptyAwake,
    /// An IMU at 100 Hz: `examples/imu-fft`.
    ImuFft,
    /// Raw images of 1280x720 at 10 Hz: `examples/brake-dark`.
    Brake720,
    /// Raw images of 1920x1080 at 10 Hz.
    Brake1080,
    /// Images of a drive, raw, as 1920x1080 at 30 Hz: `examples/yolo-detector`.
    Detector,
}

impl Workload {
    pub(super) const ALL: [Self; 6] = [
        Self::Empty,
        Self::EmptyAwake,
        Self::ImuFft,
        Self::Brake720,
        Self::Brake1080,
        Self::Detector,
    ];

    /// Returns its title, with the limit of socket buffers.
    pub(super) fn title(self, buffer: u64) -> String {
        let what = match self {
            Self::Empty => "IMU at 100 Hz, empty",
            Self::EmptyAwake => "IMU at 100 Hz, empty, cores awake",
            Self::ImuFft => "IMU at 100 Hz, FFT",
            Self::Brake720 => "720p at 10 Hz, Brake + Dark",
            Self::Brake1080 => "1080p at 10 Hz, Brake + Dark",
            Self::Detector => "1080p at 30 Hz, detector",
        };
        // Powers of two are written by people in MiB, the usual limit of Linux in bytes.
        match buffer {
            0 => what.to_owned(),
            _ if buffer.is_multiple_of(1 << 20) => {
                format!("{what}, socket buffers of {} MiB", buffer >> 20)
            }
            _ => format!("{what}, socket buffers of {buffer} B"),
        }
    }

    /// Returns the limits of socket buffers to measure with; `None` leaves the one that there is.
    /// An IMU fits in any. What a detector skips is not to be the loss of a small buffer.
    pub(super) fn buffers(self) -> Vec<Option<u64>> {
        match self {
            Self::Empty | Self::EmptyAwake | Self::ImuFft => vec![None],
            Self::Brake720 | Self::Brake1080 => BUFFERS.map(Some).to_vec(),
            Self::Detector => vec![BUFFERS.last().copied()],
        }
    }

    pub(super) fn is_of_images(self) -> bool {
        self.is_brake_dark() || self == Self::Detector
    }

    fn is_brake_dark(self) -> bool {
        matches!(self, Self::Brake720 | Self::Brake1080)
    }

    /// Returns the topic whose samples are answered, and its DDS type.
    pub(super) fn event(self) -> (&'static str, &'static str) {
        match self.is_of_images() {
            true => ("/camera/synthetic/image_raw", "sensor_msgs::msg::dds_::Image_"),
            false => ("/imu/synthetic", "sensor_msgs::msg::dds_::Imu_"),
        }
    }

    /// Returns the arguments of the player: those for the event alone, or for all inputs. It plays
    /// for a number of seconds, unless the workload is [looped](Self::is_looped).
    pub(super) fn player(self, is_alone: bool, seconds: u32) -> Vec<String> {
        let (topic, _) = self.event();
        let camera = match self {
            Self::Brake720 => &["--synthetic", "1280x720@10"][..],
            Self::Brake1080 => &["--synthetic", "1920x1080@10"],
            Self::Empty | Self::EmptyAwake | Self::ImuFft => &[],
            Self::Detector => {
                let (drive, from) =
                    (sample_drive().display().to_string(), "/camera/front/compressed");
                let remap = format!("{from}:={topic}");
                let what = [&drive, "--topics", from, "--remap", &remap, "--raw-images"];
                // The drive has 10 images in a second.
                let how = ["--size", "1920x1080", "--rate", "3", "--loop"];
                return what.into_iter().chain(how).map(str::to_owned).collect();
            }
        };
        let has_imu = camera.is_empty() || !is_alone;
        let imu = if has_imu { &["--imu", "100"][..] } else { &[] };
        let duration = ["--duration", &seconds.to_string()].map(str::to_owned);
        camera.iter().chain(imu).map(|it| (*it).to_owned()).chain(duration).collect()
    }

    /// Returns whether the player repeats a drive until a signal ends it. All synthetic images are
    /// equal, and the model of a lambda does not run again for an input that equals the last one.
    pub(super) fn is_looped(self) -> bool {
        self == Self::Detector
    }

    /// Returns the name of the workload in a baseline, and its configuration.
    pub(super) fn of_baseline(self) -> (&'static str, &'static [&'static str]) {
        match self {
            Self::Empty | Self::EmptyAwake => ("empty", &[]),
            Self::ImuFft => ("imu-fft", &[]),
            Self::Brake720 | Self::Brake1080 => ("brake-dark", &["brake_mps2=100"]),
            Self::Detector => ("yolo-detector", &[]),
        }
    }

    /// Returns all sides. `buffer` is the limit of socket buffers. With `real_time`, there are
    /// lambdas that receive with real-time priority, too.
    pub(super) fn sides(self, buffer: u64, real_time: bool) -> Vec<Side> {
        let lambda = |name: String, kind, lambda, real_time| {
            Side::Lambda(Box::new(LambdaSide { name, kind, lambda, real_time, last: None }))
        };
        let kinds = [Twin::Rust, Twin::Python];
        let twins = kinds.map(|kind| lambda(kind.to_string(), kind, self.lambda(kind), false));
        let kinds = if real_time { &kinds[..] } else { &[] };
        let prioritized = kinds
            .iter()
            .map(|&kind| lambda(format!("{kind}, in real time"), kind, self.lambda(kind), true));
        // The same decision where the lambda computes what the host does otherwise.
        let by_kernel = self.is_brake_dark().then(|| {
            let copy = copy_on_player("bench/lambdas/brake-dark-kernel/rust");
            lambda("wasm, SDK kernel".to_owned(), Twin::Rust, copy, false)
        });
        let [stand_in, rclpy] = [NodeKind::StandIn, NodeKind::Rclpy];
        let usual = NodeSide::DEPTH;
        let nodes = match self {
            // A node that is slower than its camera answers old images, or with depth 1 new ones.
            Self::Detector => vec![(stand_in, usual), (stand_in, 1), (rclpy, usual), (rclpy, 1)],
            _ => [stand_in, rclpy, NodeKind::RclpyKeepingMemory].map(|kind| (kind, usual)).to_vec(),
        };
        let nodes =
            nodes.into_iter().map(|(kind, depth)| Side::Node(NodeSide { kind, depth, buffer }));
        [Side::Bare]
            .into_iter()
            .chain(twins)
            .chain(by_kernel)
            .chain(prioritized)
            .chain(nodes)
            .collect()
    }

    /// Returns a copy of the lambda, on the topics of the player.
    pub(crate) fn lambda(self, kind: Twin) -> LambdaCopy {
        let folder = match self {
            Self::Empty | Self::EmptyAwake => "bench/lambdas/imu",
            Self::ImuFft => "examples/imu-fft",
            Self::Brake720 | Self::Brake1080 => "examples/brake-dark",
            Self::Detector => "examples/yolo-detector",
        };
        copy_on_player(&format!("{folder}/{}", kind.folder()))
    }
}

/// Returns a copy of a lambda, on the topics of the player. It looks at each image: at rest, too, a
/// car brakes by less than 100 m/s^2.
fn copy_on_player(folder: &str) -> LambdaCopy {
    LambdaCopy::of(folder, |manifest| {
        manifest
            .replace("/camera/front/compressed", "/camera/synthetic/image_raw")
            .replace("sensor_msgs/msg/CompressedImage", "sensor_msgs/msg/Image")
            .replace("/imu/data", "/imu/synthetic")
            .replace("max_size = \"2 MiB\"", "max_size = \"8 MiB\"")
            .replace("default = -3.0", "default = 100.0")
    })
}

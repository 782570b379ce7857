//! Workloads: the inputs, and the sides that answer them.

use clap::ValueEnum;
use gleaner_tests::{LambdaCopy, sample_drive};

use super::node::{NodeKind, NodeSide};
use super::sides::{LambdaMode, LambdaSide, Side};
use crate::measure::Twin;

/// Limits of socket buffers: that of an ordinary Linux, a larger one, and that of the installation.
const BUFFERS: [u64; 3] = [212_992, 4 << 20, 64 << 20];

/// Topics of the inputs, and their DDS types.
pub(super) const IMU: (&str, &str) = ("/imu/synthetic", "sensor_msgs::msg::dds_::Imu_");
pub(super) const CAMERA: (&str, &str) =
    ("/camera/synthetic/image_raw", "sensor_msgs::msg::dds_::Image_");

/// Configuration of Brake + Dark. A car at rest brakes by less than 100 m/s^2, so that each image
/// is looked at. The mean luma of the noise is 127.5, just above the limit, so that a side whose
/// result is 1 % lower decides otherwise. A trigger would end the arithmetic for 3 s.
pub(super) const BRAKE_MPS2: f64 = 100.0;
pub(super) const DARK_LUMA: f64 = 127.0;
const BRAKE_DARK: [&str; 2] = ["brake_mps2=100", "dark_luma=127"];

const TWINS: [Twin; 2] = [Twin::Rust, Twin::Python];

/// A workload.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(crate) enum Workload {
    /// An IMU at 100 Hz; nothing is computed.
    Empty,
    /// The same with cores that do not sleep.
    EmptyAwake,
    /// An IMU at 100 Hz: `examples/imu-fft`, which computes a spectrum in 3 % of the wakes.
    ImuFft,
    /// The IMU of a drive at 100 Hz: `bench/lambdas/imu-spectrum`, with a spectrum in each wake.
    ImuSpectrum,
    /// Raw images of 1280x720 at 10 Hz: `examples/brake-dark`.
    Brake720,
    /// Raw images of 1920x1080 at 10 Hz.
    Brake1080,
    /// Images of a drive, raw, as 1920x1080 at 30 Hz: `examples/yolo-detector`.
    Detector,
}

impl Workload {
    pub(super) const ALL: [Self; 7] = [
        Self::Empty,
        Self::EmptyAwake,
        Self::ImuFft,
        Self::ImuSpectrum,
        Self::Brake720,
        Self::Brake1080,
        Self::Detector,
    ];

    /// The workloads of the paper.
    pub(super) const PAPER: [Self; 3] = [Self::ImuSpectrum, Self::Brake1080, Self::Detector];

    /// Returns its title, for images with the limit of socket buffers.
    pub(super) fn title(self, buffer: u64) -> String {
        let what = match self {
            Self::Empty => "IMU at 100 Hz, empty",
            Self::EmptyAwake => "IMU at 100 Hz, empty, cores awake",
            Self::ImuFft => "IMU at 100 Hz, a spectrum in 3 % of the wakes",
            Self::ImuSpectrum => "IMU at 100 Hz, a spectrum in each wake",
            Self::Brake720 => "720p at 10 Hz, Brake + Dark",
            Self::Brake1080 => "1080p at 10 Hz, Brake + Dark",
            Self::Detector => "1080p at 30 Hz, detector",
        };
        // Powers of two are written by people in MiB, the usual limit of Linux in bytes.
        match buffer {
            _ if buffer == 0 || !self.is_of_images() => what.to_owned(),
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
            Self::Empty | Self::EmptyAwake | Self::ImuFft | Self::ImuSpectrum => vec![None],
            Self::Brake720 | Self::Brake1080 => BUFFERS.map(Some).to_vec(),
            Self::Detector => vec![BUFFERS.last().copied()],
        }
    }

    pub(super) fn is_of_images(self) -> bool {
        self.is_brake_dark() || self == Self::Detector
    }

    pub(super) fn is_brake_dark(self) -> bool {
        matches!(self, Self::Brake720 | Self::Brake1080)
    }

    /// Returns whether all sides make the same decisions from the same samples. An empty lambda
    /// makes none. A detector skips images that arrive while it is busy, and libraries differ.
    pub(super) fn has_equal_decisions(self) -> bool {
        !matches!(self, Self::Empty | Self::EmptyAwake | Self::Detector)
    }

    /// Returns the topic whose samples are answered, and its DDS type.
    pub(super) fn event(self) -> (&'static str, &'static str) {
        if self.is_of_images() { CAMERA } else { IMU }
    }

    /// Returns the arguments of the player: those for the event alone, or for all inputs. It plays
    /// for a number of seconds, unless the workload is [looped](Self::is_looped).
    pub(super) fn player(self, is_alone: bool, seconds: u32) -> Vec<String> {
        let drive = |from: &str, how: &str| -> Vec<String> {
            let (drive, to) = (sample_drive().display().to_string(), self.event().0);
            let how = format!("--topics {from} --remap {from}:={to} --loop {how}");
            [drive].into_iter().chain(how.split(' ').map(str::to_owned)).collect()
        };
        let camera = match self {
            Self::Empty | Self::EmptyAwake | Self::ImuFft => &[][..],
            // The drive has 104 samples of its IMU, and 10 images, in a second.
            Self::ImuSpectrum => return drive("/imu/data", "--rate 0.959"),
            Self::Brake720 => &["--synthetic", "1280x720@10"],
            Self::Brake1080 => &["--synthetic", "1920x1080@10"],
            Self::Detector => {
                let how = "--raw-images --size 1920x1080 --rate 3";
                return drive("/camera/front/compressed", how);
            }
        };
        let has_imu = camera.is_empty() || !is_alone;
        let imu = if has_imu { &["--imu", "100"][..] } else { &[] };
        let duration = ["--duration", &seconds.to_string()].map(str::to_owned);
        camera.iter().chain(imu).map(|it| (*it).to_owned()).chain(duration).collect()
    }

    /// Returns whether the player repeats a drive until a signal ends it. All synthetic samples are
    /// equal: no spectrum of them is rough, and the model of a lambda does not run again for an
    /// input that equals the last one.
    pub(super) fn is_looped(self) -> bool {
        matches!(self, Self::ImuSpectrum | Self::Detector)
    }

    /// Returns the name of the workload in a baseline.
    pub(super) fn of_baseline(self) -> &'static str {
        match self {
            Self::Empty | Self::EmptyAwake => "empty",
            Self::ImuFft => "imu-fft",
            Self::ImuSpectrum => "imu-spectrum",
            Self::Brake720 | Self::Brake1080 => "brake-dark",
            Self::Detector => "yolo-detector",
        }
    }

    /// Returns the values of the configuration that differ from the manifest's, as KEY=VALUE.
    pub(super) fn config(self) -> &'static [&'static str] {
        if self.is_brake_dark() { &BRAKE_DARK } else { &[] }
    }

    /// Returns all sides. `buffer` is the limit of socket buffers. With `real_time`, there are
    /// lambdas that receive with real-time priority, too.
    pub(super) fn sides(self, buffer: u64, real_time: bool) -> Vec<Side> {
        let lambda = |kind, mode| Side::Lambda(LambdaSide { kind, mode });
        let node = |kind, depth| Side::Node(NodeSide { kind, depth, buffer });
        let usual = NodeSide::DEPTH;
        let mut sides = vec![node(NodeKind::Bare, usual)];
        if self.has_equal_decisions() {
            sides.push(node(NodeKind::Rust, usual));
        }
        sides.extend(TWINS.map(|kind| lambda(kind, LambdaMode::Usual)));
        if self.is_brake_dark() {
            // The same decision where the lambda computes what the host does otherwise.
            sides.push(lambda(Twin::Rust, LambdaMode::Kernel));
        }
        if matches!(self, Self::Empty | Self::ImuFft | Self::ImuSpectrum) {
            sides.push(lambda(Twin::Rust, LambdaMode::Unchecked));
        }
        if real_time {
            sides.extend(TWINS.map(|kind| lambda(kind, LambdaMode::RealTime)));
        }
        let [stand_in, rclpy] = [NodeKind::StandIn, NodeKind::Rclpy];
        let nodes = match self {
            // A node that is slower than its camera answers old images, or with depth 1 new ones.
            Self::Detector => vec![(stand_in, usual), (stand_in, 1), (rclpy, usual), (rclpy, 1)],
            _ => [stand_in, rclpy, NodeKind::RclpyKeepingMemory].map(|kind| (kind, usual)).to_vec(),
        };
        sides.extend(nodes.into_iter().map(|(kind, depth)| node(kind, depth)));
        sides
    }

    /// Returns a copy of the lambda, on the topics of the player.
    pub(crate) fn lambda(self, kind: Twin) -> LambdaCopy {
        let folder = match self {
            Self::Empty | Self::EmptyAwake => "bench/lambdas/imu",
            Self::ImuFft => "examples/imu-fft",
            Self::ImuSpectrum => "bench/lambdas/imu-spectrum",
            Self::Brake720 | Self::Brake1080 => "examples/brake-dark",
            Self::Detector => "examples/yolo-detector",
        };
        copy_on_player(&format!("{folder}/{}", kind.folder()))
    }

    /// Returns a copy of the lambda that computes the mean luma itself.
    pub(super) fn kernel_lambda() -> LambdaCopy {
        copy_on_player("bench/lambdas/brake-dark-kernel/rust")
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

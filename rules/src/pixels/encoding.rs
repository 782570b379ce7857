//! Pixel encodings: the supported ones of `sensor_msgs/msg/Image`.

use super::error::PixelError;
use crate::text::shortened;

/// Arrangement of the colour filter in front of a raw sensor: the first two pixels of the first
/// row, then of the second.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Bayer {
    /// Red, green / green, blue.
    Rggb,
    /// Blue, green / green, red.
    Bggr,
    /// Green, blue / red, green.
    Gbrg,
    /// Green, red / blue, green.
    Grbg,
}

/// The encoding of a pixel.
///
/// Source: `sensor_msgs/image_encodings.hpp` of ROS 2.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Encoding {
    /// Red, green, blue; a byte each.
    Rgb8,
    /// Blue, green, red; a byte each. Also `8UC3`, the OpenCV type.
    Bgr8,
    /// Red, green, blue, alpha; a byte each.
    Rgba8,
    /// Blue, green, red, alpha; a byte each.
    Bgra8,
    /// Grey, a byte. Also `8UC1`.
    Mono8,
    /// Grey, two bytes in the order that the message states. Also `16UC1`.
    Mono16,
    /// Two pixels in four bytes: U, Y of the left one, V, Y of the right one. Also called `yuv422`.
    Yuv422Uyvy,
    /// Two pixels in four bytes: Y of the left one, U, Y of the right one, V. Also called
    /// `yuv422_yuy2`.
    Yuv422Yuyv,
    /// One colour per pixel, a byte.
    Bayer8(Bayer),
    /// One colour per pixel, two bytes in the order that the message states.
    Bayer16(Bayer),
}

/// All supported names. Of several names of an encoding, the first is that of [`Encoding::name`].
const NAMES: [(&str, Encoding); 21] = [
    ("rgb8", Encoding::Rgb8),
    ("bgr8", Encoding::Bgr8),
    ("8UC3", Encoding::Bgr8),
    ("rgba8", Encoding::Rgba8),
    ("bgra8", Encoding::Bgra8),
    ("mono8", Encoding::Mono8),
    ("8UC1", Encoding::Mono8),
    ("mono16", Encoding::Mono16),
    ("16UC1", Encoding::Mono16),
    ("uyvy", Encoding::Yuv422Uyvy),
    ("yuv422", Encoding::Yuv422Uyvy),
    ("yuyv", Encoding::Yuv422Yuyv),
    ("yuv422_yuy2", Encoding::Yuv422Yuyv),
    ("bayer_rggb8", Encoding::Bayer8(Bayer::Rggb)),
    ("bayer_bggr8", Encoding::Bayer8(Bayer::Bggr)),
    ("bayer_gbrg8", Encoding::Bayer8(Bayer::Gbrg)),
    ("bayer_grbg8", Encoding::Bayer8(Bayer::Grbg)),
    ("bayer_rggb16", Encoding::Bayer16(Bayer::Rggb)),
    ("bayer_bggr16", Encoding::Bayer16(Bayer::Bggr)),
    ("bayer_gbrg16", Encoding::Bayer16(Bayer::Gbrg)),
    ("bayer_grbg16", Encoding::Bayer16(Bayer::Grbg)),
];

impl Encoding {
    /// Returns the encoding of this name in ROS.
    ///
    /// # Errors
    ///
    /// [`PixelError::UnknownEncoding`] with the list of supported names.
    pub fn from_ros(name: &str) -> Result<Self, PixelError> {
        NAMES.iter().find(|(known, _)| *known == name).map(|(_, encoding)| *encoding).ok_or_else(
            || PixelError::UnknownEncoding {
                name: shortened(name),
                supported: NAMES.map(|(known, _)| known).join(", "),
            },
        )
    }

    /// Returns the name in ROS; of several names, the current one.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Rgb8 => "rgb8",
            Self::Bgr8 => "bgr8",
            Self::Rgba8 => "rgba8",
            Self::Bgra8 => "bgra8",
            Self::Mono8 => "mono8",
            Self::Mono16 => "mono16",
            Self::Yuv422Uyvy => "uyvy",
            Self::Yuv422Yuyv => "yuyv",
            Self::Bayer8(Bayer::Rggb) => "bayer_rggb8",
            Self::Bayer8(Bayer::Bggr) => "bayer_bggr8",
            Self::Bayer8(Bayer::Gbrg) => "bayer_gbrg8",
            Self::Bayer8(Bayer::Grbg) => "bayer_grbg8",
            Self::Bayer16(Bayer::Rggb) => "bayer_rggb16",
            Self::Bayer16(Bayer::Bggr) => "bayer_bggr16",
            Self::Bayer16(Bayer::Gbrg) => "bayer_gbrg16",
            Self::Bayer16(Bayer::Grbg) => "bayer_grbg16",
        }
    }

    /// Returns the number of bytes per pixel. For the yuv422 encodings it is half of the four bytes
    /// of a pair.
    pub const fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Mono8 | Self::Bayer8(_) => 1,
            Self::Mono16 | Self::Bayer16(_) | Self::Yuv422Uyvy | Self::Yuv422Yuyv => 2,
            Self::Rgb8 | Self::Bgr8 => 3,
            Self::Rgba8 | Self::Bgra8 => 4,
        }
    }

    /// Returns the number of channels per pixel: 1 for grey and raw, 3 for colour, 4 with alpha; 2
    /// for the yuv422 encodings, where a pixel has its own Y and half of a U, V pair.
    pub const fn channels(self) -> usize {
        match self {
            Self::Mono8 | Self::Mono16 | Self::Bayer8(_) | Self::Bayer16(_) => 1,
            Self::Yuv422Uyvy | Self::Yuv422Yuyv => 2,
            Self::Rgb8 | Self::Bgr8 => 3,
            Self::Rgba8 | Self::Bgra8 => 4,
        }
    }

    /// Returns whether two neighbouring pixels share their colour, so that the width must be even.
    pub const fn is_paired(self) -> bool {
        matches!(self, Self::Yuv422Uyvy | Self::Yuv422Yuyv)
    }

    /// Returns whether this is raw data of a sensor with a colour filter, before debayering.
    pub const fn is_raw(self) -> bool {
        matches!(self, Self::Bayer8(_) | Self::Bayer16(_))
    }

    /// Returns whether the image is grey: one value per pixel.
    pub const fn is_grey(self) -> bool {
        matches!(self, Self::Mono8 | Self::Mono16)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_encoding_is_found_by_its_name() {
        for (_, encoding) in NAMES {
            assert_eq!(Encoding::from_ros(encoding.name()).unwrap(), encoding);
        }
    }

    #[test]
    fn old_and_opencv_names_mean_the_same_as_the_current_ones() {
        for (alias, current) in [
            ("8UC1", "mono8"),
            ("8UC3", "bgr8"),
            ("16UC1", "mono16"),
            ("yuv422", "uyvy"),
            ("yuv422_yuy2", "yuyv"),
        ] {
            assert_eq!(Encoding::from_ros(alias).unwrap().name(), current);
        }
    }

    #[test]
    fn an_unknown_encoding_is_refused_with_the_list_of_known_ones() {
        let message = Encoding::from_ros("nv12").unwrap_err().to_string();
        assert!(message.starts_with("encoding `nv12` is not supported"), "{message}");
        for (name, _) in NAMES {
            assert!(message.contains(name), "{message} lacks {name}");
        }
    }

    #[test]
    fn a_hostile_encoding_name_does_not_fill_the_log() {
        let message = Encoding::from_ros(&"é".repeat(100_000)).unwrap_err().to_string();
        assert!(message.len() < 600, "{} bytes", message.len());
    }

    #[test]
    fn a_pixel_has_the_bytes_of_its_channels() {
        let sizes = |name| {
            let encoding = Encoding::from_ros(name).unwrap();
            (encoding.channels(), encoding.bytes_per_pixel())
        };
        assert_eq!(sizes("mono8"), (1, 1));
        assert_eq!(sizes("mono16"), (1, 2));
        assert_eq!(sizes("bayer_grbg8"), (1, 1));
        assert_eq!(sizes("bayer_grbg16"), (1, 2));
        assert_eq!(sizes("uyvy"), (2, 2));
        assert_eq!(sizes("rgb8"), (3, 3));
        assert_eq!(sizes("bgra8"), (4, 4));
    }
}

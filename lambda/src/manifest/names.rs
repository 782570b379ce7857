//! Validated names: each type is a text of one form, so that every path, topic or version is valid.

use std::borrow::Cow;
use std::fmt;
use std::path::Path;
use std::str::FromStr;

use gleaner_rules::names;
use serde::de::Error as _;
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use gleaner_base::{Exit, Explain};

/// A text that does not have the form of the expected name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("`{text}` is not a {what}")]
pub struct NameError {
    pub text: String,
    /// The expected kind of name, for example `topic name`.
    pub what: &'static str,
    /// The form of such a name, for the help line.
    pub rule: &'static str,
}

impl Explain for NameError {
    fn help(&self) -> Option<String> {
        Some(self.rule.to_owned())
    }

    fn exit(&self) -> Exit {
        Exit::Usage
    }
}

macro_rules! checked_text {
    ($(#[$doc:meta])* $name:ident, $what:literal, $rule:literal, $check:path) => {
        $(#[$doc])*
        #[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Hash)]
        pub struct $name(String);

        impl $name {
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl FromStr for $name {
            type Err = NameError;

            fn from_str(text: &str) -> Result<Self, NameError> {
                if $check(text) {
                    Ok(Self(text.to_owned()))
                } else {
                    Err(NameError { text: text.to_owned(), what: $what, rule: $rule })
                }
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }

        impl AsRef<str> for $name {
            fn as_ref(&self) -> &str {
                &self.0
            }
        }

        impl PartialEq<str> for $name {
            fn eq(&self, other: &str) -> bool {
                self.0 == other
            }
        }

        impl PartialEq<&str> for $name {
            fn eq(&self, other: &&str) -> bool {
                self.0 == *other
            }
        }

        impl Serialize for $name {
            fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                serializer.serialize_str(&self.0)
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
                // Not the error itself, which holds the text, however long it is.
                let refused = |_| D::Error::custom(concat!("it is not a ", $what));
                Cow::<str>::deserialize(from)?.parse().map_err(refused)
            }
        }
    };
}

checked_text! {
    /// Name of a lambda: 1 to 63 lower-case letters, digits and hyphens, the first a letter. It
    /// becomes part of file names, host labels and URLs, hence the length of a DNS label.
    LambdaName, "lambda name",
    "a lambda name has 1 to 63 lower-case letters, digits and hyphens and begins with a letter, \
     for example `brake-dark`",
    names::is_lambda
}

checked_text! {
    /// Name of an input, a model or a config item: 1 to 63 lower-case letters, digits, `_` and `-`,
    /// the first a letter.
    ItemName, "name",
    "a name has 1 to 63 lower-case letters, digits, `_` and `-` and begins with a letter, \
     for example `front_camera`",
    names::is_item
}

checked_text! {
    /// An absolute ROS 2 topic name, for example `/camera/front/compressed`.
    ///
    /// Source: the topic and service names page of the ROS 2 design; the length is rmw's
    /// `RMW_TOPIC_MAX_NAME_LENGTH`, the 255 bytes of DDS less 8 for prefixes.
    TopicName, "topic name",
    "a topic begins with `/` and has parts of letters, digits and `_`, none beginning with a \
     digit, for example `/camera/front`",
    names::is_topic
}

checked_text! {
    /// A ROS 2 message type, for example `sensor_msgs/msg/Imu`.
    TypeName, "message type",
    "a ROS 2 type has three parts, `package/msg/Type`, for example `sensor_msgs/msg/Imu`",
    names::is_type
}

checked_text! {
    /// A version `major.minor.patch`, with an optional `-pre.release` part, as in semantic
    /// versioning.
    Version, "version",
    "a version is `major.minor.patch`, for example `0.1.0` or `1.0.0-rc.1`",
    is_version
}

checked_text! {
    /// A path below the lambda's folder: relative, with `/` between its parts, and never leading
    /// out of it.
    RelativePath, "path inside the lambda's folder",
    "give a path relative to the lambda's folder, without `..`, for example `models/detector.onnx`",
    is_relative_path
}

checked_text! {
    /// A sha256 as 64 lower-case hexadecimal digits.
    Sha256, "sha256",
    "a sha256 has 64 lower-case hexadecimal digits: the first column that `sha256sum FILE` prints",
    is_sha256
}

impl RelativePath {
    pub fn as_path(&self) -> &Path {
        Path::new(&self.0)
    }
}

impl TypeName {
    /// Returns whether this is `sensor_msgs/msg/CompressedImage`: a frame that is decoded on the
    /// first access to its pixels.
    pub fn is_compressed_image(&self) -> bool {
        self.0 == names::COMPRESSED_IMAGE
    }

    /// Returns whether samples of this type are frames: `sensor_msgs/msg/Image` and
    /// `CompressedImage`.
    pub fn is_frame(&self) -> bool {
        names::is_frame(&self.0)
    }

    /// Returns whether samples of this type are large, so that few are kept: frames and point
    /// clouds.
    pub fn is_large(&self) -> bool {
        names::is_large(&self.0)
    }
}

fn is_version(text: &str) -> bool {
    let (core, pre) = match text.split_once('-') {
        Some((core, pre)) => (core, Some(pre)),
        None => (text, None),
    };
    // A leading zero would give one version two texts.
    let number = |part: &str| part.parse::<u32>().is_ok_and(|n| n.to_string() == part);
    let identifier = |part: &str| {
        !part.is_empty() && part.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'-')
    };
    text.len() <= 63
        && core.split('.').count() == 3
        && core.split('.').all(number)
        && pre.is_none_or(|pre| pre.split('.').all(identifier))
}

fn is_relative_path(text: &str) -> bool {
    // Checked as text, not by `Path::components`, which drops `.` and doubled separators: each file
    // has exactly one text.
    let part = |part: &str| !part.is_empty() && part != "." && part != "..";
    text.len() <= 255
        && text.split('/').all(part)
        && !text.contains(|c: char| c == '\\' || c.is_control())
}

fn is_sha256(text: &str) -> bool {
    text.len() == 64
        && text.bytes().all(|byte| byte.is_ascii_digit() || (b'a'..=b'f').contains(&byte))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[track_caller]
    fn accepts<T: FromStr<Err = NameError> + fmt::Display>(texts: &[&str]) {
        for text in texts {
            assert_eq!(text.parse::<T>().map(|name| name.to_string()), Ok((*text).to_owned()));
        }
    }

    #[track_caller]
    fn refuses<T: FromStr<Err = NameError> + fmt::Debug>(texts: &[&str]) {
        for text in texts {
            assert!(text.parse::<T>().is_err(), "`{text}` was accepted");
        }
    }

    #[test]
    fn a_lambda_name_is_a_lower_case_label() {
        accepts::<LambdaName>(&["a", "brake-dark", "x1", &"a".repeat(63)]);
        refuses::<LambdaName>(&[
            "",
            "1x",
            "-x",
            "Brake",
            "a_b",
            "a b",
            "ä",
            "a/b",
            &"a".repeat(64),
        ]);
    }

    #[test]
    fn an_item_name_may_have_underscores() {
        accepts::<ItemName>(&["camera", "front_camera", "imu-2"]);
        refuses::<ItemName>(&["", "_x", "2x", "Camera", "a.b", "a=b"]);
    }

    #[test]
    fn a_topic_name_is_absolute_and_has_no_empty_part() {
        accepts::<TopicName>(&["/a", "/imu/data", "/_x/y_2", "/Camera"]);
        refuses::<TopicName>(&[
            "", "/", "imu", "/imu/", "//imu", "/a//b", "/2a", "/a/2b", "/a b", "/a-b", "/~x",
            "/{x}",
        ]);
        refuses::<TopicName>(&[&format!("/{}", "a".repeat(247))]);
        accepts::<TopicName>(&[&format!("/{}", "a".repeat(246))]);
    }

    #[test]
    fn a_message_type_has_three_parts() {
        accepts::<TypeName>(&["sensor_msgs/msg/Imu", "my_msgs2/msg/X1"]);
        refuses::<TypeName>(&[
            "sensor_msgs/Imu",
            "sensor_msgs/srv/Imu",
            "a/msg/b",
            "/msg/B",
            "a/msg/B/c",
            "a/msg/",
            "a/msg/B ",
        ]);
    }

    #[test]
    fn a_version_has_three_numbers_and_perhaps_a_pre_release() {
        accepts::<Version>(&["0.1.0", "1.0.0-rc.1", "1.2.3-a-b"]);
        refuses::<Version>(&[
            "1",
            "1.0",
            "1.0.0.0",
            "v1.0.0",
            "01.0.0",
            "1.0.0-",
            "1.0.0-a..b",
            "+1.0.0",
            "1.0.0 ",
            "9999999999.0.0",
        ]);
    }

    #[test]
    fn a_relative_path_never_leaves_its_folder() {
        accepts::<RelativePath>(&["main.py", "models/a.onnx", "..hidden"]);
        refuses::<RelativePath>(&[
            "",
            "/etc/passwd",
            "..",
            "../x",
            "a/../../x",
            "a/..",
            "./a",
            "a//b",
            "a/",
            "a\\b",
            "a\0b",
        ]);
    }

    #[test]
    fn a_sha256_has_64_lower_case_digits() {
        accepts::<Sha256>(&[&"0123456789abcdef".repeat(4)]);
        refuses::<Sha256>(&[
            "",
            "abc",
            &"0123456789ABCDEF".repeat(4),
            &"g".repeat(64),
            &"a".repeat(65),
        ]);
    }
}

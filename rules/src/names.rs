//! Checks names in a manifest: of lambdas and inputs, of topics, and of message types.

/// Longest topic name that rmw accepts, in bytes.
const TOPIC_NAME_MAX: usize = 247;

pub const IMAGE: &str = "sensor_msgs/msg/Image";
pub const COMPRESSED_IMAGE: &str = "sensor_msgs/msg/CompressedImage";

/// Returns whether `text` has 1 to 63 characters: first a lower-case letter, then those, digits and
/// `extra`.
fn is_name(text: &str, extra: &[u8]) -> bool {
    let rest =
        |byte: u8| byte.is_ascii_lowercase() || byte.is_ascii_digit() || extra.contains(&byte);
    text.len() <= 63
        && text.bytes().next().is_some_and(|first| first.is_ascii_lowercase())
        && text.bytes().all(rest)
}

/// Returns whether `text` is a valid name of a lambda.
pub fn is_lambda(text: &str) -> bool {
    is_name(text, b"-")
}

/// Returns whether `text` is a valid name of an input, a model or a value of `[config]`.
pub fn is_item(text: &str) -> bool {
    is_name(text, b"_-")
}

/// Returns whether `text` is a valid, absolute name of a ROS topic.
pub fn is_topic(text: &str) -> bool {
    let token = |part: &str| {
        part.bytes().next().is_some_and(|first| !first.is_ascii_digit())
            && part.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
    };
    text.len() <= TOPIC_NAME_MAX
        && text.strip_prefix('/').is_some_and(|parts| parts.split('/').all(token))
}

/// Returns whether `text` is a valid name of a ROS message type, such as `sensor_msgs/msg/Imu`.
pub fn is_type(text: &str) -> bool {
    let mut parts = text.split('/');
    let (Some(package), Some("msg"), Some(name), None) =
        (parts.next(), parts.next(), parts.next(), parts.next())
    else {
        return false;
    };
    text.len() <= 255
        && package.bytes().next().is_some_and(|first| first.is_ascii_alphabetic())
        && package.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
        && name.bytes().next().is_some_and(|first| first.is_ascii_uppercase())
        && name.bytes().all(|byte| byte.is_ascii_alphanumeric())
}

pub fn is_frame(type_name: &str) -> bool {
    type_name == IMAGE || type_name == COMPRESSED_IMAGE
}

/// Returns whether samples of this type are large, so that few are kept: frames and point clouds.
pub fn is_large(type_name: &str) -> bool {
    type_name == "sensor_msgs/msg/PointCloud2" || is_frame(type_name)
}

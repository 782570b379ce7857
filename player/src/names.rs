//! Names of ROS 2, and what DDS calls them.

use gleaner_lambda::manifest::TopicName;

/// The DDS name of a topic: `rt/imu/data` of `/imu/data`; `None` if ROS 2 takes no such name.
pub(crate) fn dds_topic(topic: &str) -> Option<String> {
    topic.parse::<TopicName>().ok().map(|topic| format!("rt{topic}"))
}

/// The DDS name of a type: `sensor_msgs::msg::dds_::Imu_` of `sensor_msgs/msg/Imu`; `None` if it is
/// no type of ROS 2.
pub(crate) fn dds_type(type_name: &str) -> Option<String> {
    let parts: Vec<&str> = type_name.split('/').collect();
    let (package, kind, name) = match parts[..] {
        [package, name] => (package, "msg", name),
        [package, kind, name] => (package, kind, name),
        _ => return None,
    };
    let is_whole = [package, kind, name].into_iter().all(is_identifier) && type_name.len() <= 247;
    is_whole.then(|| format!("{package}::{kind}::dds_::{name}_"))
}

/// The name under which the decoded images of a topic of compressed images are sent.
pub(crate) fn image_raw(topic: &str) -> String {
    format!("{}/image_raw", topic.strip_suffix("/compressed").unwrap_or(topic))
}

fn is_identifier(part: &str) -> bool {
    let mut characters = part.chars();
    characters.next().is_some_and(|first| first.is_ascii_alphabetic() || first == '_')
        && characters.all(|character| character.is_ascii_alphanumeric() || character == '_')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_and_types_are_spelt_as_the_middleware_of_ros_2_does() {
        assert_eq!(dds_topic("/imu/data").unwrap(), "rt/imu/data");
        assert_eq!(dds_type("sensor_msgs/msg/Imu").unwrap(), "sensor_msgs::msg::dds_::Imu_");
        assert_eq!(dds_type("sensor_msgs/Imu").unwrap(), "sensor_msgs::msg::dds_::Imu_");
        assert_eq!(dds_type("pkg/srv/Add_Event").unwrap(), "pkg::srv::dds_::Add_Event_");
    }

    #[test]
    fn what_ros_2_does_not_take_has_no_name() {
        for topic in [
            "imu",
            "",
            "/",
            "/a//b",
            "/a/",
            "/1a",
            "/a b",
            "/a\0",
            "/ä",
            &format!("/{}", "a".repeat(300)),
        ] {
            assert_eq!(dds_topic(topic), None, "{topic}");
        }
        for type_name in ["Imu", "", "a/b/c/d", "a//b", "a/msg/", "foxglove.Image", "a/msg/b\0"] {
            assert_eq!(dds_type(type_name), None, "{type_name}");
        }
    }

    #[test]
    fn decoded_images_stand_beside_the_compressed_ones() {
        assert_eq!(image_raw("/camera/front/compressed"), "/camera/front/image_raw");
        assert_eq!(image_raw("/camera/front"), "/camera/front/image_raw");
    }
}

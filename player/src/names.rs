//! Names of topics and types in ROS 2 and in DDS.

use gleaner_lambda::manifest::TopicName;

/// The DDS name of a topic: `rt/imu/data` for `/imu/data`; `None` if the name is invalid in ROS 2.
pub(crate) fn dds_topic(topic: &str) -> Option<String> {
    topic.parse::<TopicName>().ok().map(|topic| format!("rt{topic}"))
}

/// The DDS name of a type: `sensor_msgs::msg::dds_::Imu_` for `sensor_msgs/msg/Imu`; `None` if it
/// is not a ROS 2 type.
pub(crate) fn dds_type(type_name: &str) -> Option<String> {
    let parts: Vec<&str> = type_name.split('/').collect();
    let (package, kind, name) = match parts[..] {
        [package, name] => (package, "msg", name),
        [package, kind, name] => (package, kind, name),
        _ => return None,
    };
    let is_valid = [package, kind, name].into_iter().all(is_identifier) && type_name.len() <= 247;
    is_valid.then(|| format!("{package}::{kind}::dds_::{name}_"))
}

/// The topic on which the decoded images of a compressed topic are sent.
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
    fn topics_and_types_have_the_dds_names_of_ros_2() {
        assert_eq!(dds_topic("/imu/data").unwrap(), "rt/imu/data");
        assert_eq!(dds_type("sensor_msgs/msg/Imu").unwrap(), "sensor_msgs::msg::dds_::Imu_");
        assert_eq!(dds_type("sensor_msgs/Imu").unwrap(), "sensor_msgs::msg::dds_::Imu_");
        assert_eq!(dds_type("pkg/srv/Add_Event").unwrap(), "pkg::srv::dds_::Add_Event_");
    }

    #[test]
    fn names_that_are_invalid_in_ros_2_have_no_dds_name() {
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
    fn decoded_images_are_sent_in_the_namespace_of_the_compressed_ones() {
        assert_eq!(image_raw("/camera/front/compressed"), "/camera/front/image_raw");
        assert_eq!(image_raw("/camera/front"), "/camera/front/image_raw");
    }
}

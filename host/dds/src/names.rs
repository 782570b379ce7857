//! Names of ROS 2 as DDS spells them, and back; names from the wire made fit to be shown.

use ros2_client::{MessageTypeName, Name, NodeName};

/// The longest name that is shown, in bytes. ROS 2's own topics may have 255.
const LONGEST: usize = 256;

/// `/camera/front` as DDS has it: `rt/camera/front`. `None` if it is no absolute name of a topic.
pub(super) fn dds_topic(topic: &str) -> Option<String> {
    let name = Name::parse(topic).ok().filter(Name::is_absolute)?;
    let root = NodeName::new("/", "_").ok()?;
    Some(name.to_dds_name("rt", &root, "")).filter(|name| name.len() <= LONGEST)
}

/// `sensor_msgs/msg/Imu` as DDS has it: `sensor_msgs::msg::dds_::Imu_`. `None` if it is no name of
/// a message type.
pub(super) fn dds_type(type_name: &str) -> Option<String> {
    let (package, name) = type_name.split_once("/msg/").or_else(|| type_name.split_once('/'))?;
    let is_name = |part: &str| {
        part.starts_with(|c: char| c.is_ascii_alphabetic())
            && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
            && part.len() <= LONGEST / 2
    };
    (is_name(package) && is_name(name)).then(|| MessageTypeName::new(package, name).dds_msg_type())
}

/// `/camera/front` of `rt/camera/front`; `None` for what is no topic of ROS 2, such as the topics
/// of its services.
pub(super) fn ros_topic(dds_name: &str) -> Option<&str> {
    dds_name.strip_prefix("rt").filter(|name| name.starts_with('/'))
}

/// `sensor_msgs/msg/Imu` of `sensor_msgs::msg::dds_::Imu_`; any other type as it is.
pub(super) fn ros_type(dds_type: &str) -> String {
    let parts = || {
        let (package, name) = dds_type.split_once("::msg::dds_::")?;
        Some(format!("{package}/msg/{}", name.strip_suffix('_')?))
    };
    parts().unwrap_or_else(|| dds_type.to_owned())
}

/// Namespace and name of a node: `/gleaner` and `hello` of `/gleaner/hello`. `None` if they are no
/// names.
pub(super) fn node(full: &str) -> Option<(String, String)> {
    let (namespace, base) = full.rsplit_once('/')?;
    let name = NodeName::new(if namespace.is_empty() { "/" } else { namespace }, base).ok()?;
    let (namespace, base) = (name.namespace().to_owned(), name.base_name().to_owned());
    (namespace.len() + base.len() < LONGEST && !namespace.contains("//"))
        .then_some((namespace, base))
}

/// `text`, in which everything that a terminal or a log could take for something else is escaped,
/// and which is cut where it is too long.
pub(super) fn visible(text: &str) -> String {
    let mut shown = String::new();
    for character in text.chars() {
        let before = shown.len();
        match character {
            ' '..='~' => shown.push(character),
            _ => shown.extend(character.escape_unicode()),
        }
        if shown.len() > LONGEST - 3 {
            shown.truncate(before);
            shown.push('…');
            break;
        }
    }
    shown
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_go_to_dds_and_come_back() {
        assert_eq!(dds_topic("/camera/front").as_deref(), Some("rt/camera/front"));
        assert_eq!(ros_topic("rt/camera/front"), Some("/camera/front"));
        for type_name in ["sensor_msgs/msg/Imu", "sensor_msgs/Imu"] {
            let dds = dds_type(type_name).unwrap();
            assert_eq!(dds, "sensor_msgs::msg::dds_::Imu_");
            assert_eq!(ros_type(&dds), "sensor_msgs/msg/Imu");
        }
    }

    #[test]
    fn what_is_no_name_is_none() {
        for topic in [
            "",
            "/",
            "camera",
            "/a//b",
            "/a/",
            "/1a",
            "/a b",
            "/a\n",
            &format!("/{}", "a".repeat(300)),
        ] {
            assert_eq!(dds_topic(topic), None, "{topic}");
        }
        for type_name in ["", "Imu", "a/b/c", "sensor_msgs/msg/", "/Imu", "a::b/Imu", "a/msg/I mu"]
        {
            assert_eq!(dds_type(type_name), None, "{type_name}");
        }
        for full in ["", "hello", "/", "/a//b", "/a/b c"] {
            assert_eq!(node(full), None, "{full}");
        }
        assert_eq!(node("/hello"), Some(("/".to_owned(), "hello".to_owned())));
        assert_eq!(node("/gleaner/hello"), Some(("/gleaner".to_owned(), "hello".to_owned())));
    }

    #[test]
    fn services_are_no_topics_and_other_types_stay_as_they_are() {
        assert_eq!(ros_topic("rq/add_two_intsRequest"), None);
        assert_eq!(ros_topic("rtx/a"), None);
        assert_eq!(ros_topic("ros_discovery_info"), None);
        assert_eq!(ros_type("Shape"), "Shape");
        assert_eq!(ros_type("a::msg::dds_::B"), "a::msg::dds_::B");
    }

    #[test]
    fn hostile_names_are_escaped_and_cut() {
        assert_eq!(visible("/imu/data"), "/imu/data");
        assert_eq!(visible("\u{1b}[2J\n"), "\\u{1b}[2J\\u{a}");
        assert_eq!(visible("\u{202e}x"), "\\u{202e}x");
        let long = visible(&"\u{1b}".repeat(10_000));
        assert!(long.len() <= LONGEST && long.ends_with('…'), "{} bytes", long.len());
    }
}

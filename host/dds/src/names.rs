//! Converts names between ROS 2 and DDS, and makes names from the network printable.

use ros2_client::{Name, NodeName};

/// The longest name that is shown, in bytes. ROS 2's own topics may have 255.
const LONGEST: usize = 256;
/// The kinds of types that topics have: goals, results and feedback of actions are `action`, events
/// of services `srv`.
const KINDS: [&str; 3] = ["msg", "srv", "action"];

/// The DDS name of a topic: `rt/camera/front` for `/camera/front`. `None` if it is not an absolute
/// topic name.
pub(super) fn dds_topic(topic: &str) -> Option<String> {
    let name = Name::parse(topic).ok().filter(Name::is_absolute)?;
    let root = NodeName::new("/", "_").ok()?;
    Some(name.to_dds_name("rt", &root, "")).filter(|name| name.len() <= LONGEST)
}

/// The DDS name of a type: `sensor_msgs::msg::dds_::Imu_` for `sensor_msgs/msg/Imu`. `None` if it
/// is not a valid type name.
pub(super) fn dds_type(type_name: &str) -> Option<String> {
    let (package, name) = type_name.split_once('/')?;
    let (kind, name) = name.split_once('/').unwrap_or(("msg", name));
    let is_name = |part: &str| {
        part.starts_with(|c: char| c.is_ascii_alphabetic())
            && part.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
            && part.len() <= LONGEST / 2
    };
    (is_name(package) && KINDS.contains(&kind) && is_name(name))
        .then(|| format!("{package}::{kind}::dds_::{name}_"))
}

/// The ROS 2 name of a topic: `/camera/front` for `rt/camera/front`. `None` for other topics, such
/// as those of services.
pub(super) fn ros_topic(dds_name: &str) -> Option<&str> {
    dds_name.strip_prefix("rt").filter(|name| name.starts_with('/'))
}

/// The ROS 2 name of a type: `sensor_msgs/msg/Imu` for `sensor_msgs::msg::dds_::Imu_`; any other
/// type unchanged.
pub(super) fn ros_type(dds_type: &str) -> String {
    let parts = || {
        let (package, rest) = dds_type.split_once("::")?;
        let (kind, name) = rest.split_once("::dds_::")?;
        let name = name.strip_suffix('_').filter(|_| KINDS.contains(&kind))?;
        Some(format!("{package}/{kind}/{name}"))
    };
    parts().unwrap_or_else(|| dds_type.to_owned())
}

/// Namespace and name of a node: `/gleaner` and `hello` for `/gleaner/hello`. `None` if they are
/// not valid names.
pub(super) fn node(full: &str) -> Option<(String, String)> {
    let (namespace, base) = full.rsplit_once('/')?;
    let name = NodeName::new(if namespace.is_empty() { "/" } else { namespace }, base).ok()?;
    let (namespace, base) = (name.namespace().to_owned(), name.base_name().to_owned());
    (namespace.len() + base.len() < LONGEST && !namespace.contains("//"))
        .then_some((namespace, base))
}

/// Returns `text` with all characters but printable ASCII escaped, truncated to [`LONGEST`] bytes.
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
    fn names_round_trip_through_dds() {
        assert_eq!(dds_topic("/camera/front").as_deref(), Some("rt/camera/front"));
        assert_eq!(ros_topic("rt/camera/front"), Some("/camera/front"));
        for type_name in ["sensor_msgs/msg/Imu", "sensor_msgs/Imu"] {
            let dds = dds_type(type_name).unwrap();
            assert_eq!(dds, "sensor_msgs::msg::dds_::Imu_");
            assert_eq!(ros_type(&dds), "sensor_msgs/msg/Imu");
        }
        let action = dds_type("nav2_msgs/action/Spin_FeedbackMessage").unwrap();
        assert_eq!(action, "nav2_msgs::action::dds_::Spin_FeedbackMessage_");
        assert_eq!(ros_type(&action), "nav2_msgs/action/Spin_FeedbackMessage");
    }

    #[test]
    fn invalid_names_are_refused() {
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
    fn services_are_not_topics_and_other_types_are_unchanged() {
        assert_eq!(ros_topic("rq/add_two_intsRequest"), None);
        assert_eq!(ros_topic("rtx/a"), None);
        assert_eq!(ros_topic("ros_discovery_info"), None);
        assert_eq!(ros_type("Shape"), "Shape");
        assert_eq!(ros_type("a::msg::dds_::B"), "a::msg::dds_::B");
    }

    #[test]
    fn hostile_names_are_escaped_and_truncated() {
        assert_eq!(visible("/imu/data"), "/imu/data");
        assert_eq!(visible("\u{1b}[2J\n"), "\\u{1b}[2J\\u{a}");
        assert_eq!(visible("\u{202e}x"), "\\u{202e}x");
        let long = visible(&"\u{1b}".repeat(10_000));
        assert!(long.len() <= LONGEST && long.ends_with('…'), "{} bytes", long.len());
    }
}

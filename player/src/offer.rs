//! The quality of service that a topic is offered with: what its writers offered when the drive was
//! recorded.

/// What a writer offers.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Offer {
    pub(crate) reliable: bool,
    pub(crate) transient_local: bool,
    /// Samples kept for readers that lag behind or come late.
    pub(crate) depth: u32,
}

/// Samples that a writer keeps at most. Those that offered to keep all get this many: what a drive
/// claims is not to decide how much memory we take.
const MAX_DEPTH: u32 = 1000;

/// The same for types whose messages may be frames of 25 MB.
const MAX_LARGE_DEPTH: u32 = 16;

impl Default for Offer {
    /// What ROS 2 offers by default.
    fn default() -> Offer {
        Offer { reliable: true, transient_local: false, depth: 10 }
    }
}

impl Offer {
    /// What satisfies every reader that any of the recorded writers did. `yaml` is the list that
    /// rosbag2 notes: with words since Jazzy, with the numbers of `rmw` before.
    pub(crate) fn recorded(yaml: Option<&str>) -> Offer {
        let (mut reliable, mut transient_local, mut depth) = (None, false, None);
        for line in yaml.unwrap_or_default().lines() {
            let line = line.trim().trim_start_matches("- ").trim();
            let Some((key, value)) = line.split_once(':') else { continue };
            match (key.trim(), value.trim().trim_matches(['"', '\''])) {
                // What a writer left to the middleware is reliable.
                ("reliability", kind) => {
                    reliable = Some(reliable == Some(true) || !matches!(kind, "best_effort" | "2"));
                }
                ("durability", kind) => transient_local |= matches!(kind, "transient_local" | "1"),
                ("history", "keep_all" | "2") => depth = Some(MAX_DEPTH),
                ("depth", number) => {
                    depth =
                        depth.max(number.parse().ok().map(|depth: u32| depth.clamp(1, MAX_DEPTH)))
                }
                _ => {}
            }
        }
        let default = Offer::default();
        Offer {
            reliable: reliable.unwrap_or(default.reliable),
            transient_local,
            depth: depth.unwrap_or(default.depth),
        }
    }

    /// The same, for a type whose messages are large or not.
    pub(crate) fn of_large(self, is_large: bool) -> Offer {
        Offer { depth: self.depth.min(if is_large { MAX_LARGE_DEPTH } else { MAX_DEPTH }), ..self }
    }
}

/// Whether messages of a type are usually large: then one of them takes milliseconds to write, and
/// others should not wait.
pub(crate) fn is_large(type_name: &str) -> bool {
    let large = ["Image", "CompressedImage", "PointCloud2"];
    let name = type_name
        .strip_prefix("sensor_msgs/")
        .map(|name| name.strip_prefix("msg/").unwrap_or(name));
    name.is_some_and(|name| large.contains(&name))
}

#[cfg(test)]
mod tests {
    use super::*;

    const JAZZY: &str = "- history: keep_last\n  depth: 5\n  reliability: best_effort\n  durability: volatile\n  \
        deadline:\n    sec: 9223372036\n    nsec: 854775807\n  liveliness: automatic\n  avoid_ros_namespace_conventions: false\n";
    const HUMBLE: &str = "- history: 1\n  depth: 7\n  reliability: 1\n  durability: 1\n  deadline:\n    sec: 1\n    nsec: 1\n";

    #[test]
    fn words_and_numbers_are_read() {
        let jazzy = Offer { reliable: false, transient_local: false, depth: 5 };
        assert_eq!(Offer::recorded(Some(JAZZY)), jazzy);
        let humble = Offer { reliable: true, transient_local: true, depth: 7 };
        assert_eq!(Offer::recorded(Some(HUMBLE)), humble);
        assert!(
            !Offer::recorded(Some(&HUMBLE.replace("reliability: 1", "reliability: 2"))).reliable
        );
        assert!(
            !Offer::recorded(Some(&HUMBLE.replace("durability: 1", "durability: 2")))
                .transient_local
        );
    }

    #[test]
    fn of_several_writers_the_strongest_promise_counts() {
        let both = format!("{JAZZY}{HUMBLE}");
        assert_eq!(
            Offer::recorded(Some(&both)),
            Offer { reliable: true, transient_local: true, depth: 7 }
        );
    }

    #[test]
    fn without_a_usable_profile_it_is_what_ros_2_offers() {
        for nothing in [None, Some(""), Some("[]"), Some("garbage")] {
            assert_eq!(
                Offer::recorded(nothing),
                Offer { reliable: true, transient_local: false, depth: 10 }
            );
        }
    }

    #[test]
    fn a_drive_does_not_decide_how_much_is_kept() {
        let absurd = HUMBLE.replace("depth: 7", "depth: 4000000000");
        assert_eq!(Offer::recorded(Some(&absurd)).depth, MAX_DEPTH);
        assert_eq!(
            Offer::recorded(Some(&HUMBLE.replace("history: 1", "history: 2"))).depth,
            MAX_DEPTH
        );
        assert_eq!(Offer::recorded(Some("- depth: -3\n")), Offer::default());
        assert_eq!(Offer::recorded(Some("- depth: 0\n")).depth, 1);
        assert_eq!(Offer::recorded(Some(&absurd)).of_large(true).depth, MAX_LARGE_DEPTH);
    }

    #[test]
    fn images_and_point_clouds_are_large() {
        assert!(is_large("sensor_msgs/msg/Image") && is_large("sensor_msgs/PointCloud2"));
        assert!(!is_large("sensor_msgs/msg/Imu") && !is_large("my/msg/Image"));
    }
}

//! The quality of service that a topic is offered with: that of its writers when the drive was
//! recorded.

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub(crate) struct Offer {
    pub(crate) reliable: bool,
    pub(crate) transient_local: bool,
    /// Samples kept for slow or late readers.
    pub(crate) depth: u32,
}

/// Maximum samples that a writer keeps, also for `keep_all`: a drive must not control the memory of
/// the player.
const MAX_DEPTH: u32 = 1000;

/// [`MAX_DEPTH`] for types whose messages may be frames of 25 MB.
const MAX_LARGE_DEPTH: u32 = 16;

impl Default for Offer {
    /// The default profile of ROS 2.
    fn default() -> Offer {
        Offer { reliable: true, transient_local: false, depth: 10 }
    }
}

impl Offer {
    /// The offer that satisfies every reader that any recorded writer satisfied. `yaml` is the list
    /// that rosbag2 records: with names since Jazzy, with the numbers of `rmw` before.
    pub(crate) fn recorded(yaml: Option<&str>) -> Offer {
        let (mut reliable, mut transient_local, mut depth) = (None, false, None);
        for line in yaml.unwrap_or_default().lines() {
            let line = line.trim().trim_start_matches("- ").trim();
            let Some((key, value)) = line.split_once(':') else { continue };
            match (key.trim(), value.trim().trim_matches(['"', '\''])) {
                // A reliability left to the middleware is reliable.
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

    /// Limits the depth for large or small messages.
    pub(crate) fn capped(self, is_large: bool) -> Offer {
        Offer { depth: self.depth.min(if is_large { MAX_LARGE_DEPTH } else { MAX_DEPTH }), ..self }
    }
}

/// Returns whether messages of a type are usually large: writing one then takes milliseconds, and
/// other topics should not wait for it.
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

    const JAZZY: &str = "- history: keep_last\n  depth: 5\n  reliability: best_effort\n  \
        durability: volatile\n  deadline:\n    sec: 9223372036\n    nsec: 854775807\n  \
        liveliness: automatic\n  avoid_ros_namespace_conventions: false\n";
    const HUMBLE: &str = "- history: 1\n  depth: 7\n  reliability: 1\n  durability: 1\n  \
        deadline:\n    sec: 1\n    nsec: 1\n";

    #[test]
    fn names_and_numbers_are_parsed() {
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
    fn the_strongest_offer_of_several_writers_counts() {
        let both = format!("{JAZZY}{HUMBLE}");
        assert_eq!(
            Offer::recorded(Some(&both)),
            Offer { reliable: true, transient_local: true, depth: 7 }
        );
    }

    #[test]
    fn without_a_usable_profile_the_offer_is_the_default_of_ros_2() {
        for profile in [None, Some(""), Some("[]"), Some("garbage")] {
            assert_eq!(
                Offer::recorded(profile),
                Offer { reliable: true, transient_local: false, depth: 10 }
            );
        }
    }

    #[test]
    fn the_depth_in_a_drive_is_capped() {
        let absurd = HUMBLE.replace("depth: 7", "depth: 4000000000");
        assert_eq!(Offer::recorded(Some(&absurd)).depth, MAX_DEPTH);
        assert_eq!(
            Offer::recorded(Some(&HUMBLE.replace("history: 1", "history: 2"))).depth,
            MAX_DEPTH
        );
        assert_eq!(Offer::recorded(Some("- depth: -3\n")), Offer::default());
        assert_eq!(Offer::recorded(Some("- depth: 0\n")).depth, 1);
        assert_eq!(Offer::recorded(Some(&absurd)).capped(true).depth, MAX_LARGE_DEPTH);
    }

    #[test]
    fn images_and_point_clouds_are_large() {
        assert!(is_large("sensor_msgs/msg/Image") && is_large("sensor_msgs/PointCloud2"));
        assert!(!is_large("sensor_msgs/msg/Imu") && !is_large("my/msg/Image"));
    }
}

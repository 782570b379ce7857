//! Variables by which nodes of ROS 2 choose how they reach each other.

/// Returns the names of those in the environment that nodes may follow and Gleaner does not: it
/// receives by DDS, and discovers publishers by multicast. The values may be secret.
pub fn ignored_variables() -> Vec<String> {
    let is_ignored = |name: &str, value: &str| match name {
        "RMW_IMPLEMENTATION" => value.contains("zenoh"),
        "ROS_DISCOVERY_SERVER" | "ROS_STATIC_PEERS" => !value.is_empty(),
        _ => name.starts_with("ZENOH_"),
    };
    let ignored = std::env::vars_os().filter_map(|(name, value)| {
        let name = name.to_string_lossy();
        is_ignored(&name, &value.to_string_lossy()).then(|| crate::excerpt(&name))
    });
    ignored.collect()
}

//! Checks the network settings that DDS depends on.

use std::fs;
use std::net::Ipv4Addr;
use std::os::fd::AsRawFd;

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::{Exit, ignored_variables};
use gleaner_protocol::ingress::DISCOVERY_GROUP;
use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;
use rustix::process::{PidfdFlags, PidfdGetfdFlags, getpid, pidfd_getfd, pidfd_open};

use super::{Finding, output_of};

const UP: InterfaceFlags = InterfaceFlags::IFF_UP;
const MULTICAST: InterfaceFlags = InterfaceFlags::IFF_MULTICAST;

/// Largest socket buffer that the ingress requests.
const BUFFER_BYTES: u64 = 64 << 20;
/// Memory for the socket filter, with some reserve: see `docs/dds-limits.md`.
const FILTER_BYTES: u64 = 128 << 10;
/// Number of participants on one host that find each other without multicast: RustDDS announces
/// itself by unicast to the first twelve.
const WITHOUT_MULTICAST: usize = 12;

#[derive(Debug, Clone, PartialEq, Eq)]
struct Interface {
    name: String,
    flags: InterfaceFlags,
}

pub(super) fn findings(parts: &InstalledPrograms) -> Vec<Finding> {
    let buffer = fs::read_to_string("/proc/sys/net/core/rmem_max");
    let filters = fs::read_to_string("/proc/sys/net/core/optmem_max");
    let routes = fs::read_to_string("/proc/net/route").unwrap_or_default();
    let localhost_only = std::env::var("ROS_LOCALHOST_ONLY").is_ok_and(|value| value == "1")
        || std::env::var("ROS_AUTOMATIC_DISCOVERY_RANGE")
            .is_ok_and(|range| range.eq_ignore_ascii_case("localhost"));
    vec![
        socket_buffer(buffer.ok().and_then(|text| text.trim().parse().ok())),
        socket_filter(filters.ok().and_then(|text| text.trim().parse().ok()), own_handle()),
        real_time(parts),
        discovery(&interfaces(), &routes, localhost_only),
        domain(std::env::var("ROS_DOMAIN_ID").ok().as_deref()),
        middleware(),
    ]
}

fn socket_buffer(max: Option<u64>) -> Finding {
    const SUBJECT: &str = "socket buffer";
    let help = format!(
        "for images: `sysctl -w net.core.rmem_max={BUFFER_BYTES}`, and the same in /etc/sysctl.d; \
         where that is not possible, `gleaner run --real-time`"
    );
    match max {
        None => Finding::warning(SUBJECT, "unknown limit", help),
        Some(max) if max >= BUFFER_BYTES => {
            Finding::ok(SUBJECT, format!("up to {} MiB", max >> 20))
        }
        Some(max) => {
            let kib = max >> 10;
            Finding::warning(
                SUBJECT,
                format!("up to {kib} KiB: bursts of large messages will be lost"),
                help,
            )
        }
    }
}

/// Duplicates a descriptor of this process, as the ingress does to set the filter.
fn own_handle() -> rustix::io::Result<()> {
    let this = pidfd_open(getpid(), PidfdFlags::empty())?;
    pidfd_getfd(&this, this.as_raw_fd(), PidfdGetfdFlags::empty()).map(drop)
}

fn socket_filter(max: Option<u64>, handle: rustix::io::Result<()>) -> Finding {
    const SUBJECT: &str = "socket filter";
    if let Err(error) = handle {
        let found = format!(
            "the system refuses `pidfd_open` or `pidfd_getfd` ({error}): there is no filter \
             against fragment floods"
        );
        let help = "let the container permit both (Linux 5.6 has them), as with CAP_SYS_PTRACE";
        return Finding::warning(SUBJECT, found, help);
    }
    let help =
        format!("`sysctl -w net.core.optmem_max={FILTER_BYTES}`, and the same in /etc/sysctl.d");
    match max {
        Some(max) if max >= FILTER_BYTES => {
            Finding::ok(SUBJECT, format!("up to {} KiB", max >> 10))
        }
        _ => {
            let found = "too little memory for the filter against fragment floods";
            Finding::warning(SUBJECT, found, help)
        }
    }
}

/// Lets the ingress ask for the priority: limits, capabilities and control groups decide.
fn real_time(parts: &InstalledPrograms) -> Finding {
    const SUBJECT: &str = "real time";
    match is_real_time_permitted(parts) {
        Ok(true) => Finding::ok(SUBJECT, "permitted to this user"),
        // Few need it, so this is no warning.
        Ok(false) => Finding::ok(
            SUBJECT,
            "not permitted to this user; only `gleaner run --real-time` needs it, see \
             docs/live-network.md",
        ),
        Err(why) => Finding::warning(SUBJECT, why, "build it again: cargo build --release"),
    }
}

fn is_real_time_permitted(parts: &InstalledPrograms) -> Result<bool, String> {
    let output = output_of(parts, "gleaner-ingress", "real-time")?;
    if output.status.success() {
        return Ok(true);
    }
    if output.status.code() == Some(Exit::Internal.code().into()) {
        return Ok(false);
    }
    let why = String::from_utf8_lossy(&output.stderr);
    Err(why.trim().lines().last().unwrap_or("gleaner-ingress failed").to_owned())
}

fn discovery(interfaces: &[Interface], routes: &str, localhost_only: bool) -> Finding {
    const SUBJECT: &str = "discovery";
    let usable = |interface: &&Interface| {
        interface.flags.contains(UP | MULTICAST)
            && (!localhost_only || interface.name == "lo")
            && has_multicast_route(routes, &interface.name)
    };
    let names: Vec<&str> =
        interfaces.iter().filter(usable).map(|interface| interface.name.as_str()).collect();
    if !names.is_empty() {
        return Finding::ok(SUBJECT, format!("multicast on {}", names.join(", ")));
    }
    let found = format!(
        "no interface supports multicast: only {WITHOUT_MULTICAST} participants of this machine \
         find each other, and none finds other machines"
    );
    let help = format!(
        "more than {WITHOUT_MULTICAST} participants need it: \
         `ip link set lo multicast on; ip route add 224.0.0.0/4 dev lo`"
    );
    Finding::warning(SUBJECT, found, help)
}

/// Returns whether multicast is routed to this interface, by its own or by the default route.
fn has_multicast_route(routes: &str, interface: &str) -> bool {
    // Columns: interface, destination, gateway, flags, references, use, metric, mask. Addresses are
    // in native byte order.
    routes.lines().skip(1).any(|line| {
        let mut words = line.split_whitespace();
        let (Some(name), Some(destination)) = (words.next(), words.next()) else { return false };
        let mask = words.nth(5);
        let address = |word: Option<&str>| {
            let bits = u32::from_str_radix(word?, 16).ok()?;
            Some(Ipv4Addr::from(bits.to_ne_bytes()))
        };
        let (Some(destination), Some(mask)) = (address(Some(destination)), address(mask)) else {
            return false;
        };
        let group = u32::from(DISCOVERY_GROUP);
        name == interface && group & u32::from(mask) == u32::from(destination)
    })
}

fn domain(id: Option<&str>) -> Finding {
    const SUBJECT: &str = "ROS_DOMAIN_ID";
    match id.map(str::trim) {
        None | Some("") => Finding::ok(SUBJECT, "not set: domain 0"),
        Some(id) => match id.parse::<u16>() {
            Ok(domain) if domain <= 232 => Finding::ok(SUBJECT, format!("domain {domain}")),
            _ => Finding::warning(
                SUBJECT,
                format!("`{}` is not a domain", gleaner_base::visible(id)),
                "set it to 0 to 232",
            ),
        },
    }
}

fn middleware() -> Finding {
    let ignored = ignored_variables().join(", ");
    if ignored.is_empty() {
        return Finding::ok("middleware", "DDS with multicast");
    }
    let help = "let the nodes use DDS with multicast, or a bridge to it";
    Finding::warning("middleware", format!("DDS with multicast; ignored: {ignored}"), help)
}

/// Returns the interfaces in the network namespace of this process, each once.
fn interfaces() -> Vec<Interface> {
    let mut interfaces: Vec<Interface> = Vec::new();
    for address in getifaddrs().into_iter().flatten() {
        if !interfaces.iter().any(|known| known.name == address.interface_name) {
            interfaces.push(Interface { name: address.interface_name, flags: address.flags });
        }
    }
    interfaces
}

#[cfg(test)]
mod tests {
    use super::super::Severity;
    use super::*;

    const HEAD: &str =
        "Iface\tDestination\tGateway\tFlags\tRefCnt\tUse\tMetric\tMask\tMTU\tWindow\tIRTT\n";

    fn interface(name: &str, flags: InterfaceFlags) -> Interface {
        Interface { name: name.to_owned(), flags }
    }

    #[cfg(target_endian = "little")]
    #[test]
    fn more_than_twelve_participants_need_multicast_and_a_route_for_it() {
        let lo = [interface("lo", UP | MULTICAST)];
        let route = format!("{HEAD}lo\t000000E0\t00000000\t0001\t0\t0\t0\t000000F0\t0\t0\t0\n");
        assert_eq!(discovery(&lo, &route, true).state, Severity::Ok);
        assert_eq!(discovery(&lo, HEAD, true).state, Severity::Warning);
        assert_eq!(discovery(&[interface("lo", UP)], &route, true).state, Severity::Warning);
        assert!(discovery(&lo, HEAD, true).help.unwrap().contains("more than 12 participants"));
    }

    #[cfg(target_endian = "little")]
    #[test]
    fn the_default_route_carries_multicast_unless_discovery_is_local() {
        let interfaces = [interface("eth0", UP | MULTICAST), interface("lo", UP)];
        let route = format!("{HEAD}eth0\t00000000\t0100000A\t0003\t0\t0\t0\t00000000\t0\t0\t0\n");
        assert_eq!(discovery(&interfaces, &route, false).detail, "multicast on eth0");
        assert_eq!(discovery(&interfaces, &route, true).state, Severity::Warning);
        let down = [interface("eth0", MULTICAST)];
        assert_eq!(discovery(&down, &route, false).state, Severity::Warning);
    }

    #[test]
    fn a_small_socket_buffer_is_reported_with_help() {
        assert_eq!(socket_buffer(Some(64 << 20)).state, Severity::Ok);
        let small = socket_buffer(Some(212_992));
        assert_eq!(small.detail, "up to 208 KiB: bursts of large messages will be lost");
        assert!(small.help.unwrap().contains("net.core.rmem_max=67108864"));
    }

    #[test]
    fn the_domain_is_parsed_as_in_all_programs() {
        let page = include_str!("../../../tests/domains.txt");
        for line in page.lines().filter(|line| line.starts_with('|')) {
            let (content, expected) = line[1..].split_once('|').unwrap();
            let found = domain(Some(content));
            assert_eq!(found.state == Severity::Ok, expected.trim() != "none", "{line}");
            assert!(
                found.state != Severity::Ok || found.detail.ends_with(&format!("domain{expected}")),
                "{line}"
            );
        }
    }

    #[test]
    fn an_invalid_domain_is_reported() {
        assert_eq!(domain(Some("42")).detail, "domain 42");
        assert_eq!(domain(Some("233")).state, Severity::Warning);
        assert_eq!(domain(Some("x\ny")).detail, "`x\\ny` is not a domain");
    }
}

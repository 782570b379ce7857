//! Measures live topics: losses, latencies and costs, in a private network with `gleaner-player`
//! (Cyclone DDS) as publisher.

mod bare;
mod footprint;
mod rounds;

use std::path::{Path, PathBuf};

use gleaner_protocol::LiveStatus;
use gleaner_tests::live::{RunningProgram, no_player, play, run};
use gleaner_tests::{TempFolder, namespace, root};

use crate::measure::{Figure, Twin};

/// Environment variable of the process in the private network.
const ALONE: &str = "GLEANER_BENCH_ALONE";

/// The system's limit of socket buffers. It applies to all network namespaces, and can be changed
/// in the first one only.
const BUFFER_LIMIT: &str = "/proc/sys/net/core/rmem_max";
const BUFFER_BYTES: u64 = 64 << 20;

/// Remap of the second camera of `bench/lambdas/rig`.
const REAR: &str = "/camera/synthetic/image_raw:=/camera/rear/image_raw";

/// Runs this program again in a private network; `None` in that process.
///
/// Meanwhile the limit of socket buffers is raised, if that is permitted.
pub fn in_private_network() -> Option<Result<bool, String>> {
    if std::env::var_os(ALONE).is_some() {
        return None;
    }
    Some(start_in_private_network())
}

fn start_in_private_network() -> Result<bool, String> {
    if let Some(why) = namespace::unavailable().or(no_player()) {
        return Err(why.to_owned());
    }
    let before = std::fs::read_to_string(BUFFER_LIMIT).unwrap_or_default();
    let is_small = before.trim().parse::<u64>().is_ok_and(|bytes| bytes < BUFFER_BYTES);
    let raised = is_small && std::fs::write(BUFFER_LIMIT, BUFFER_BYTES.to_string()).is_ok();
    let status = namespace::rerun(ALONE, "1").args(std::env::args_os().skip(1)).status();
    if raised {
        // Restored for the other users of this machine.
        let _ = std::fs::write(BUFFER_LIMIT, before.trim());
    }
    status.map(|status| status.success()).map_err(|error| error.to_string())
}

/// All figures.
pub fn figures(quick: bool) -> Vec<Figure> {
    let seconds = |long: u32| if quick { 2 } else { long };
    let mut figures = round_trips(quick);
    const FULL_HD: &str = "1920x1080@30";
    for (name, lambdas, players, long) in [
        ("1080p bgr8 at 30 Hz", &["camera"][..], &[&["--synthetic", FULL_HD][..]][..], 60),
        ("3848x2168 bgr8 at 10 Hz", &["camera"], &[&["--synthetic", "3848x2168@10"]], 30),
        ("IMU at 1 kHz", &["imu"], &[&["--imu", "1000"]], 60),
        (
            "1080p at 30 Hz and an IMU at 1 kHz",
            &["camera", "imu"],
            &[&["--synthetic", FULL_HD, "--imu", "1000"]],
            60,
        ),
        // One lambda with three inputs. A player has one camera, so the second one needs another
        // player.
        (
            "two cameras of 1080p at 30 Hz and an IMU at 1 kHz at once",
            &["rig"],
            &[
                &["--synthetic", FULL_HD, "--imu", "1000"],
                &["--synthetic", FULL_HD, "--remap", REAR],
            ],
            60,
        ),
    ] {
        receive(name, lambdas, players, seconds(long), &mut figures);
    }
    many(16, seconds(20), &mut figures);
    footprint::figures(seconds(10), &mut figures);
    figures
}

/// The times from a sample to its answer.
pub fn round_trips(quick: bool) -> Vec<Figure> {
    let mut figures = Vec::new();
    rounds::figures(if quick { 3 } else { 60 }, &mut figures);
    figures
}

pub(crate) fn lambda(name: &str, kind: Twin) -> PathBuf {
    root().join("bench/lambdas").join(name).join(kind.folder())
}

fn start(lambda: &Path, args: &[&str]) -> (RunningProgram, TempFolder) {
    let out = TempFolder::new();
    let started = run(lambda, out.path(), args);
    started.until_ready();
    (started, out)
}

/// Plays to the end, with a process for each of `players`, then stops the lambdas and returns their
/// final statuses. The statuses of the first lambda meanwhile go to `seen`.
fn play_and_stop(
    started: Vec<(RunningProgram, TempFolder)>,
    players: &[Vec<&str>],
    seen: &mut Vec<LiveStatus>,
) -> Vec<LiveStatus> {
    play_all(&started, players, seen);
    stop(started)
}

fn stop(started: Vec<(RunningProgram, TempFolder)>) -> Vec<LiveStatus> {
    started.iter().for_each(|(started, _)| started.signal("INT"));
    started.into_iter().map(|(started, _out)| started.finish().ended()).collect()
}

/// Plays to the end; the lambdas keep running.
fn play_all(
    started: &[(RunningProgram, TempFolder)],
    players: &[Vec<&str>],
    seen: &mut Vec<LiveStatus>,
) {
    let playing: Vec<_> = players.iter().map(|player| play(player)).collect();
    let mut has_begun = false;
    let mut is_over = false;
    while !is_over {
        let live = started[0].0.until_live("a status", |_| true);
        // Begun if something was received, as everything may be lost, or if all writers are there.
        has_begun |= live.topics.iter().all(|topic| topic.writers > Some(0) || topic.received > 0);
        is_over = has_begun && live.topics.iter().all(|topic| topic.writers == Some(0));
        seen.push(live);
    }
    for played in playing {
        let played = played.finish();
        assert!(played.status.success(), "{}", played.stderr);
    }
}

/// Measures what the empty `lambdas` receive, each in its own process, and their costs.
fn receive(
    name: &str,
    lambdas: &[&str],
    players: &[&[&str]],
    seconds: u32,
    figures: &mut Vec<Figure>,
) {
    let started = lambdas
        .iter()
        .map(|lambda| start(&self::lambda(lambda, Twin::Rust), &["--no-record"]))
        .collect();
    let duration = seconds.to_string();
    let players: Vec<_> = players
        .iter()
        .map(|player| [player, &["--wait", "1", "--duration", &duration][..]].concat())
        .collect();
    let mut seen = Vec::new();
    let ended = play_and_stop(started, &players, &mut seen);
    let topics: usize = ended.iter().map(|live| live.topics.len()).sum();
    for live in &ended {
        let granted = live.network.buffer_granted >= live.network.buffer_requested;
        let buffer = live.network.buffer_granted as f64 / f64::from(1 << 20);
        for topic in &live.topics {
            let of = if topics > 1 { format!("{name}: {}", topic.name) } else { name.to_owned() };
            let refused = topic.no_slot + topic.too_big + topic.malformed;
            figures.push(Figure::without_goal(
                &format!("{of}: received in {seconds} s"),
                "samples",
                &[topic.received as f64],
            ));
            let lost = format!(
                "{of}: lost, with a socket buffer of {buffer:.0} MiB{}",
                if granted { "" } else { " (not granted)" }
            );
            let count = topic.lost.unwrap_or(u64::MAX).saturating_add(refused);
            figures.push(if granted {
                Figure::at_most(&lost, "samples", 0.0, &[count as f64])
            } else {
                Figure::without_goal(&lost, "samples", &[count as f64])
            });
        }
        // Costs of a process are reported once, for all of its topics.
        let of = match &live.topics[..] {
            [topic] if topics > 1 => format!("{name}: {}", topic.name),
            _ => name.to_owned(),
        };
        let cpu = 100.0 * live.cpu_s / live.up_s;
        figures.push(Figure::without_goal(&format!("{of}: share of a core"), "%", &[cpu]));
        if let Some(wake_latency) = live.wake_latency {
            for (what, ns) in [("p50", wake_latency.p50_ns), ("p99", wake_latency.p99_ns)] {
                figures.push(Figure::without_goal(
                    &format!("{of}: wake latency, {what}"),
                    "us",
                    &[ns as f64 / 1e3],
                ));
            }
        }
    }
    // From the first quarter of the time, after warm-up, until the end.
    let rss = |live: &LiveStatus| live.rss_bytes as f64 / f64::from(1 << 20);
    if let (Some(warm), Some(last)) = (seen.get(seen.len() / 4), seen.last()) {
        let growth = 100.0 * (rss(last) / rss(warm) - 1.0);
        figures.push(Figure::without_goal(
            &format!("{name}: resident memory"),
            "MiB",
            &[rss(last)],
        ));
        figures.push(Figure::at_most(
            &format!("{name}: memory growth after a quarter of the time"),
            "%",
            2.0,
            &[growth],
        ));
    }
}

/// Measures `count` runtimes on one machine: whether all find the publisher, and their costs.
fn many(count: usize, seconds: u32, figures: &mut Vec<Figure>) {
    let started: Vec<_> =
        (0..count).map(|_| start(&lambda("imu", Twin::Rust), &["--no-record"])).collect();
    let (count, duration) = (count.to_string(), seconds.to_string());
    let player = vec!["--imu", "100", "--wait", &count, "--duration", &duration];
    play_all(&started, &[player], &mut Vec::new());
    let pss: Vec<f64> = started.iter().map(|(started, _)| footprint::megabytes(started)).collect();
    let ended = stop(started);
    let connected = ended.iter().filter(|live| live.topics[0].received > 0).count();
    let lossless = ended.iter().filter(|live| live.topics[0].lost == Some(0)).count();
    figures.push(Figure::at_least(
        &format!("{count} runtimes: found the publisher"),
        "runtimes",
        ended.len() as f64,
        &[connected as f64],
    ));
    figures.push(Figure::at_least(
        &format!("{count} runtimes: no losses"),
        "runtimes",
        ended.len() as f64,
        &[lossless as f64],
    ));
    let rss: Vec<f64> =
        ended.iter().map(|live| live.rss_bytes as f64 / f64::from(1 << 20)).collect();
    figures.push(Figure::without_goal(
        &format!("{count} runtimes: resident memory of each"),
        "MiB",
        &rss,
    ));
    figures.push(Figure::without_goal(&format!("{count} runtimes: PSS of each"), "MB", &pss));
    let cpu: Vec<f64> = ended.iter().map(|live| 100.0 * live.cpu_s / live.up_s).collect();
    figures.push(Figure::without_goal(
        &format!("{count} runtimes: share of a core of each"),
        "%",
        &cpu,
    ));
}

//! Processes of a run are killed at random while a player sends: each sample is received or counted
//! as lost, and every listed clip is whole and holds or states each sample of its time.
//!
//! A lambda that is never killed runs on through all of it.
//!
//! `GLEANER_CHAOS` sets the number of runs; the default is two, of which one spares the recorder.

use std::collections::BTreeMap;
use std::path::Path;
use std::time::{Duration, Instant, SystemTime};

use gleaner_lambda::{Clip, Decision};
use gleaner_protocol::Report;
use gleaner_test_support::random::XorShift64;
use gleaner_tests::live::{RunningProgram, decisions, descendants, play, run_all, signal, summary};
use gleaner_tests::{LambdaCopy, TempFolder, times, verify_clip};

use super::{clips, wait_for};

/// The lambdas; the last one is never killed.
const LAMBDAS: [(&str, &str); 4] =
    [("rust", "first"), ("python", "second"), ("rust", "third"), ("python", "last")];

/// Number of kills in a run of each process. Each kill doubles the time until it is started again.
struct Kills {
    ingress: usize,
    recorder: usize,
    lambda: usize,
}

#[derive(Debug, Default)]
struct ChaosCounts {
    kills: BTreeMap<&'static str, usize>,
    clips: usize,
    recovered: usize,
    verified: usize,
    unsettled: usize,
    unknown: usize,
}

pub fn killed_at_random() {
    let mut totals = ChaosCounts::default();
    let began = Instant::now();
    // Another sequence in each process, which is printed, so that runs side by side differ.
    let since_1970 = SystemTime::UNIX_EPOCH.elapsed().expect("the clock is set");
    let mut random = XorShift64(since_1970.as_nanos() as u64 | 1);
    for round in 0..times("GLEANER_CHAOS", 2) {
        println!("round {round}: random numbers from {}", random.0);
        let kills = match round % 2 {
            0 => Kills { ingress: 4, recorder: 0, lambda: 2 },
            _ => Kills { ingress: 1, recorder: 2, lambda: 1 },
        };
        run_once(&kills, &mut random, &mut totals);
    }
    println!("in {:.0} s: {totals:?}", began.elapsed().as_secs_f64());
}

fn run_once(kills: &Kills, random: &mut XorShift64, totals: &mut ChaosCounts) {
    let lambdas = LAMBDAS.map(|(language, name)| short_clips(language, name));
    let out = TempFolder::new();
    let settings = LAMBDAS.map(|(_, name)| format!("{name}.brake_mps2=100"));
    let args: Vec<&str> = settings.iter().flat_map(|setting| ["--set", setting]).collect();
    let folders: Vec<&Path> = lambdas.iter().map(LambdaCopy::path).collect();
    let started = run_all(&folders, out.path(), &args);
    started.until_all_ready(LAMBDAS.len());
    let player = play(&["--imu", "100", "--synthetic", "160x120@10", "--wait", "1"]);
    all_receive(&started, false);
    kill_some(&started, &lambdas, kills, random, totals);
    all_receive(&started, true);
    let sent = player.interrupt().sent()["/imu/synthetic"];
    // The last sample is received, too. A lambda that was started again lacks earlier ones.
    started.until_named("the end of the samples", |name, report| match report {
        Report::Live(live) if name == "last" => {
            let topic = &live.topics[0];
            let counted = topic.lost.map(|lost| topic.received + lost);
            counted.is_none_or(|counted| counted >= sent).then_some(())
        }
        _ => None,
    });
    let finished = started.interrupt();
    // A process has failed, or that of a lambda.
    let exit = finished.status.code();
    assert!(matches!(exit, Some(1 | 6)), "{exit:?}: {}", finished.stderr);
    let last = summary(&out.path().join("last"));
    assert_eq!((last.restarts, last.faults), (0, 0), "{}", finished.stderr);
    let topic = &last.topics[0];
    match topic.lost {
        Some(lost) => assert_eq!(topic.received + lost, sent, "{topic:?}"),
        None => totals.unknown += 1,
    }
    let link = last.recorder_link.expect("it records");
    assert_eq!(link.recorders_ended, kills.recorder as u64, "{link:?}");
    // Of a recorder that is killed, the last second is not counted.
    if kills.recorder == 0 {
        let recorder = last.recording.as_ref().expect("a recorder");
        let imu = recorder.topics.iter().find(|topic| topic.topic == "/imu/synthetic");
        let imu = imu.expect("it is recorded");
        match imu.lost {
            Some(lost) => assert_eq!(imu.received + lost, sent, "{imu:?}"),
            None => totals.unknown += 1,
        }
    }
    for (_, name) in LAMBDAS {
        each_wake_once(name, &decisions(&out.path().join(name)));
    }
    let listed = clips(out.path());
    assert!(!listed.is_empty(), "{}", finished.stderr);
    for clip in &listed {
        is_whole(out.path(), clip);
        let of = LAMBDAS.iter().zip(&lambdas);
        for (_, lambda) in
            of.filter(|((_, name), _)| clip.lambdas.iter().any(|it| it.name == *name))
        {
            let file = out.path().join(&clip.file);
            let found = verify_clip(&file, lambda.path());
            // What is missing, or the state of the lambda from before the clip, may leave a wake
            // open; no clip may contradict its lambda.
            match found.exit {
                0 => totals.verified += 1,
                2 => totals.unsettled += 1,
                _ => panic!("{}: {}; {clip:#?}", found.exit, found.stderr),
            }
        }
        totals.clips += 1;
        totals.recovered += usize::from(clip.recovered.is_some());
    }
}

/// A copy of `examples/hello` on the topics of the player, with clips of two seconds.
fn short_clips(language: &str, name: &str) -> LambdaCopy {
    LambdaCopy::changed_and_named(&format!("examples/hello/{language}"), name, |manifest| {
        manifest
            .replace("/camera/front/compressed", "/camera/synthetic/image_raw")
            .replace("/imu/data", "/imu/synthetic")
            .replace("\"/vehicle/speed\"", "")
            .replace("roll = \"5s\"", "roll = \"1s\"")
    })
}

/// Waits until each lambda has been woken. The one that is never killed must have survived the end
/// of an ingress if `has_gap`.
fn all_receive(started: &RunningProgram, has_gap: bool) {
    let mut wakes: BTreeMap<String, u64> = BTreeMap::new();
    let mut woken: BTreeMap<String, bool> = BTreeMap::new();
    started.until_named("wakes of all lambdas", |name, report| {
        if let Report::Live(live) = report {
            let is_attached = live.topics[0].writers == Some(1);
            let has_survived = name != "last" || !has_gap || live.reception_gaps.count > 0;
            let before = wakes.insert(name.clone(), live.wakes);
            let is_woken = before.is_some_and(|before| live.wakes > before);
            if is_attached && has_survived && is_woken {
                woken.insert(name, true);
            }
        }
        (woken.len() == LAMBDAS.len()).then_some(())
    });
}

/// Kills processes, each a random time after the one before.
fn kill_some(
    started: &RunningProgram,
    lambdas: &[LambdaCopy; 4],
    kills: &Kills,
    random: &mut XorShift64,
    totals: &mut ChaosCounts,
) {
    let mut left = vec!["gleaner-ingress"; kills.ingress];
    left.extend(vec!["gleaner-recorder"; kills.recorder]);
    let paths = lambdas.each_ref().map(|lambda| lambda.path().to_string_lossy().into_owned());
    left.extend(paths[..3].iter().flat_map(|path| vec![path.as_str(); kills.lambda]));
    while !left.is_empty() {
        let victim = left.swap_remove(random.below(left.len()));
        std::thread::sleep(Duration::from_millis(random.below(700) as u64));
        // The arguments of other programs name the lambda, too.
        let others: &[&str] = match victim {
            "gleaner-ingress" | "gleaner-recorder" => &[],
            _ => &["gleaner-recorder", "gleaner-shim"],
        };
        let mut pid = None;
        wait_for("a process to kill", || {
            let mut named = descendants(started.pid(), victim);
            let others = others.iter().flat_map(|name| descendants(started.pid(), name));
            let others: Vec<u32> = others.collect();
            // A child that has not executed its program yet has the arguments of its parent.
            let is_of_parent = |pid: &u32| {
                std::fs::read_to_string(format!("/proc/{pid}/comm"))
                    .is_ok_and(|name| name == "gleaner\n")
            };
            named.retain(|pid| !others.contains(pid) && !is_of_parent(pid));
            pid = named.pop();
            pid.is_some()
        });
        signal(pid.expect("it was found"), "KILL");
        let kind = match victim {
            "gleaner-ingress" => "ingress",
            "gleaner-recorder" => "recorder",
            _ => "lambda",
        };
        *totals.kills.entry(kind).or_default() += 1;
    }
}

/// Asserts that no wake is listed twice, or before an earlier one.
fn each_wake_once(name: &str, decisions: &[Decision]) {
    let times: Vec<i64> = decisions.iter().map(|decision| decision.at_ns).collect();
    assert!(times.is_sorted_by(|one, next| one < next), "{name}: {times:?}");
}

/// Asserts that the messages of a listed clip can be read, and that it states those that are
/// missing.
fn is_whole(out: &Path, clip: &Clip) {
    let bytes = std::fs::read(out.join(&clip.file)).expect("a listed clip is there");
    let mut numbers: BTreeMap<String, Vec<u32>> = BTreeMap::new();
    for message in mcap::MessageStream::new(&bytes).expect("an MCAP file") {
        let message = message.expect("a whole chunk");
        numbers.entry(message.channel.topic.clone()).or_default().push(message.sequence);
    }
    for topic in &clip.topics {
        let numbers = numbers.remove(&topic.topic).unwrap_or_default();
        assert_eq!(numbers.len() as u64, topic.messages, "{clip:#?}");
        // A sample may come late.
        let span = numbers.iter().max().zip(numbers.iter().min());
        let span = span.map_or(0, |(last, first)| u64::from(last - first) + 1);
        let missing = span.saturating_sub(topic.messages);
        assert!(
            topic.lost.is_none_or(|lost| lost >= missing),
            "{}: {missing} are missing: {clip:#?}",
            topic.topic
        );
    }
}

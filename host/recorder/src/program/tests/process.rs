//! Tests of the process with the loopback transport: from sockets and samples to clips and reports.

use std::fs::{self, File};
use std::os::fd::{AsFd, OwnedFd};
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::Instant;

use super::running::*;
use crate::program::{RecorderConnections, RecorderOptions, run};
use crate::recorder::tests::support::*;
use gleaner_base::Exit;
use gleaner_lambda::TriggerKind::{Event, Start};
use gleaner_messages::transport::Clock;
use gleaner_protocol::link::{
    ControlClient, LinkError, Loss, RecorderLink, RecorderMessage, RecorderReport,
};

#[test]
fn two_lambdas_record_and_neither_can_act_as_the_other() {
    let scratch = TestDir::new();
    let (mut running, network) = Running::start_with_a(&scratch);
    let clock = running.clock;
    let (first, first_header) = lambda(&scratch, "first", (200, 100));
    let (second, second_header) = lambda(&scratch, "second", (50, 300));
    let sockets = [running.add(&add(&first)).unwrap(), running.add(&add(&second)).unwrap()];
    let [mut one, mut two] = sockets.map(RecorderLink::new);
    // Each link can only act as the lambda of its own socket.
    let refused =
        RecorderLink::new(running.add(&add(&first)).unwrap()).hello(&second_header, TIMEOUT);
    let Err(LinkError::Refused { reason }) = refused else { panic!("{refused:?}") };
    assert!(reason.contains("`second`"), "{reason}");
    one.hello(&first_header, TIMEOUT).unwrap();
    two.hello(&second_header, TIMEOUT).unwrap();
    let sensor = Sensor::start(&network, clock);
    received(&mut running, 300);
    let anchor = clock.now();
    one.wake(&entry(anchor, &[Event]), monotonic(clock)).unwrap();
    two.wake(&entry(anchor, &[]), monotonic(clock)).unwrap();
    let deadline = Instant::now() + TIMEOUT;
    let mut opened = Vec::new();
    while opened.is_empty() && Instant::now() < deadline {
        opened = one.poll().unwrap();
    }
    assert!(matches!(opened[..], [RecorderMessage::Opened { .. }]), "{opened:?}");
    let clip = running.clip();
    assert_eq!(lambda_names(&clip), ["first"]);
    let expected = (anchor - 200 * MS, anchor + 100 * MS, 1);
    assert_eq!((clip.from_ns, clip.to_ns, clip.triggers), expected);
    // Every number from the first to the last, once, and all of that time.
    let numbers: Vec<_> = scratch.messages(&clip).into_iter().map(|(_, _, seq, _)| seq).collect();
    assert!(numbers.len() > 1 && follow_each_other(&numbers), "{numbers:?}");
    assert_eq!(numbers, sensor.numbers(clip.from_ns, clip.to_ns));
    let counts: Vec<_> = clip
        .topics
        .iter()
        .map(|topic| (topic.topic.as_str(), topic.lost, topic.type_name.is_some()))
        .collect();
    assert_eq!((counts[0].0, counts[0].1, counts[0].2), ("/a", Some(0), true));
    assert_eq!((counts[1].0, counts[1].2), ("/b", false), "a topic without a writer");
    assert_eq!(scratch.journal(&clip, "first").1, [anchor]);
    assert_eq!(two.bye(TIMEOUT), one.bye(TIMEOUT));
    // A lambda that was never built.
    let _unbuilt = running.add(&add(&scratch.0.join("third"))).unwrap();
    running.status(|status| status.lambdas == 0 && status.recording.lambdas_refused == 2);
    let (last, ended) = running.stopped();
    assert_eq!(ended, Ok(()));
    assert_eq!((last.recording.clips, last.recording.windows), (1, 1));
    assert_eq!(last.trigger_to_open.unwrap().n, 1);
    drop(sensor);
}

#[test]
fn a_stopped_recording_keeps_its_clips() {
    for how in ["stop", "the parent process's end", "SIGTERM"] {
        let scratch = TestDir::new();
        let network = FakeNetwork::default();
        let mut running = Running::start(&scratch, &network, |_| {});
        let mut link = running.join(&scratch, "first", (100, 60_000));
        // A topic that appears later is found.
        network.add("/a");
        let _sensor = Sensor::start(&network, running.clock);
        received(&mut running, 10);
        running.event(&mut link);
        running.status(|status| status.is_recording);
        match how {
            "stop" => running.starter.control.stop().unwrap(),
            "SIGTERM" => running.stop.store(true, Ordering::Relaxed),
            _ => running.starter.control = ControlClient::pair().unwrap().0,
        }
        let clip = running.clip();
        let stated = "the recording was stopped before the window ended";
        assert!(clip.incomplete.iter().any(|why| why == stated), "{:?}", clip.incomplete);
        assert!(!scratch.messages(&clip).is_empty());
        assert_eq!(running.ended().1, Ok(()), "{how}");
    }
}

#[test]
fn messages_of_a_hostile_lambda_do_not_affect_others() {
    let scratch = TestDir::new();
    let (mut running, network) = Running::start_with_a(&scratch);
    let clock = running.clock;
    let (honest, honest_header) = lambda(&scratch, "honest", (100, 50));
    let (hostile, hostile_header) = lambda(&scratch, "hostile", (0, 0));
    let mut honest = RecorderLink::new(running.add(&add(&honest)).unwrap());
    honest.hello(&honest_header, TIMEOUT).unwrap();
    let mut noisy = RecorderLink::new(running.add(&add(&hostile)).unwrap());
    noisy.hello(&hostile_header, TIMEOUT).unwrap();
    let nonsense = running.add(&add(&scratch.0.join("hostile"))).unwrap();
    rustix::net::send(nonsense.as_fd(), &[255; 4096], rustix::net::SendFlags::NOSIGNAL).unwrap();
    let _sensor = Sensor::start(&network, clock);
    received(&mut running, 200);
    // At other times, and far too often.
    for at in [i64::MAX, i64::MIN + 1, 0, clock.now() + 3600 * S] {
        noisy.wake(&entry(at, &[Start, Event]), 0).unwrap();
    }
    for _ in 0..20_000 {
        noisy.wake(&entry(clock.now(), &[Event]), monotonic(clock)).unwrap();
    }
    noisy.bye(TIMEOUT);
    let status = running.status(|status| status.recording.triggers_over_rate > 10_000);
    assert_eq!((status.recording.wakes_misstamped, status.recording.triggers_misstamped), (4, 8));
    let expected = (status.recording.triggers_over_rate, 0);
    assert_eq!((status.recording.wakes_over_rate, status.recording.ignored), expected);
    let anchor = clock.now();
    honest.wake(&entry(anchor, &[Event]), monotonic(clock)).unwrap();
    let clip = running.until(|report| match report {
        RecorderReport::Clip(clip) if clip.lambdas.iter().any(|lambda| lambda.name == "honest") => {
            Some(*clip)
        }
        _ => None,
    });
    assert_eq!(clip.topics[0].lost, Some(0));
    assert_eq!(clip.topics[0].overwritten, Some(0));
    assert_eq!(running.stopped().1, Ok(()));
}

#[test]
fn the_limits_of_a_vehicle_apply_to_the_manifest_in_the_recorder() {
    let scratch = TestDir::new();
    let network = FakeNetwork::default();
    let mut running = Running::start(&scratch, &network, |_| {});
    let (folder, as_in_manifest) = lambda(&scratch, "first", (10, 10));
    let mut on_vehicle = as_in_manifest.clone();
    on_vehicle.limits.fuel = 10_000;
    let mut announced = add(&folder);
    announced.most.fuel = 10_000;
    // A process with higher limits than the vehicle's is not the one that was announced.
    let refused =
        RecorderLink::new(running.add(&announced).unwrap()).hello(&as_in_manifest, TIMEOUT);
    let limit = "its limit `fuel` is `50000000`; the parent process announced `10000`";
    let Err(LinkError::Refused { reason }) = refused else { panic!("{refused:?}") };
    assert!(reason.contains(limit), "{reason}");
    let mut link = RecorderLink::new(running.add(&announced).unwrap());
    link.hello(&on_vehicle, TIMEOUT).unwrap();
    let (last, ended) = running.stopped();
    assert_eq!((last.recording.lambdas_refused, ended), (1, Ok(())));
}

#[test]
fn a_full_disk_is_reported_and_no_clip_is_begun() {
    let scratch = TestDir::new();
    let network = FakeNetwork::default();
    network.add("/a");
    let mut running = Running::start(&scratch, &network, |options| options.disk_floor = u64::MAX);
    let mut link = running.join(&scratch, "first", (10, 10));
    let _sensor = Sensor::start(&network, running.clock);
    running.status(|status| status.disk_free.is_some());
    running.event(&mut link);
    let triggers = running.until(|report| match report {
        RecorderReport::Loss(Loss::DiskSuppressed { triggers, .. }) => Some(triggers),
        _ => None,
    });
    assert_eq!(triggers, 1);
    // Those that follow are reported in one sum, at the end.
    for count in [2, 3] {
        running.event(&mut link);
        running.status(|status| status.recording.disk_suppressed == count);
    }
    let (last, ended) = running.stopped();
    assert_eq!((last.recording.disk_suppressed, last.recording.clips, ended), (3, 0, Ok(())));
    let losses = fs::read_to_string(scratch.0.join("losses.jsonl")).unwrap();
    let losses: Vec<serde_json::Value> =
        losses.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let triggers: Vec<_> = losses.iter().map(|loss| (&loss["loss"], &loss["triggers"])).collect();
    let of = "disk_suppressed".into();
    assert_eq!(triggers, [(&of, &1.into()), (&of, &2.into())]);
}

/// A clip whose recorder died.
fn unfinished(scratch: &TestDir) {
    let mut recorder = scratch.recorder(|_| {});
    let a = recorder.add_topic(topic("/a")).unwrap();
    let lambda = recorder.add_lambda(member("dead", (500, 500, 0), &[a]));
    drive(&mut recorder, &[a], (0, 3000, 10), &[(2000, lambda, &[Start])]);
}

#[test]
fn a_recorder_is_ready_before_it_recovers_and_reports_what_it_cannot_recover() {
    let scratch = TestDir::new();
    let network = FakeNetwork::default();
    network.add("/a");
    unfinished(&scratch);
    let find = |ending: &str| {
        let files = fs::read_dir(scratch.0.join("clips")).unwrap().map(|file| file.unwrap().path());
        files.filter(|path| path.to_string_lossy().ends_with(ending)).collect::<Vec<_>>()
    };
    let [part] = &find(".mcap.part")[..] else { panic!("no clip was left") };
    let left = fs::read(part).unwrap();
    // In the place of the copy is something that cannot be removed.
    let in_the_way = part.with_extension("part2");
    fs::create_dir(&in_the_way).unwrap();
    let mut running = Running::start(&scratch, &network, |_| {});
    let why = running.until(|report| match report {
        RecorderReport::Loss(Loss::Failed { reason, .. }) => Some(reason),
        _ => None,
    });
    assert!(why.contains("cannot recover the unfinished clip"), "{why}");
    assert!(why.contains(".mcap.part2"), "{why}");
    let mut link = running.join(&scratch, "first", (10, 10));
    let _sensor = Sensor::start(&network, running.clock);
    received(&mut running, 10);
    running.event(&mut link);
    assert!(!scratch.messages(&running.clip()).is_empty());
    let (last, ended) = running.stopped();
    assert_eq!((last.recording.clips, last.recording.failed, ended), (1, 1, Ok(())));
    assert!(fs::read_to_string(scratch.0.join("losses.jsonl")).unwrap().contains("cannot recover"));
    assert_eq!(fs::read(part).unwrap(), left);
    // The obstacle is gone; and a recorder that is stopped at once still has some seconds for
    // recovery.
    fs::remove_dir(&in_the_way).unwrap();
    let mut running = Running::start(&scratch, &network, |options| options.clips_max = Some(1));
    running.starter.control.stop().unwrap();
    let recovered = running.until(|report| match report {
        RecorderReport::Recovered(clip) => Some(clip),
        _ => None,
    });
    assert!(recovered.recovered.is_some() && recovered.lambdas[0].name == "dead");
    let (last, ended) = running.ended();
    assert_eq!((last.recording.clips, last.recording.failed), (0, 0));
    assert_eq!((last.recording.deleted, ended), (1, Ok(())));
    assert_eq!(find(".mcap"), [scratch.0.join(&recovered.file)]);
}

#[test]
fn a_topic_is_recorded_with_the_type_of_the_input_whichever_writer_came_first() {
    let scratch = TestDir::new();
    let network = FakeNetwork::default();
    network.add_other("/a", "aaa/msg/X");
    let mut running = Running::start(&scratch, &network, |_| {});
    let _link = running.join(&scratch, "first", (10, 10));
    network.add("/a");
    let _sensor = Sensor::start(&network, running.clock);
    received(&mut running, 10);
    let status = running.status(|_| true);
    assert_eq!(status.topics[0].type_name.as_deref(), Some("test_msgs/msg/Number"));
}

#[test]
fn one_lambda_too_many_is_refused_with_a_reason_and_the_others_work() {
    let scratch = TestDir::new();
    let network = FakeNetwork::default();
    let mut running =
        Running::start(&scratch, &network, |options| options.preroll_bytes = Some(1 << 20));
    let (folder, header) = lambda(&scratch, "one", (10, 10));
    let sockets: Vec<_> = (0..256).map(|_| running.add(&add(&folder)).unwrap()).collect();
    let mut last = RecorderLink::new(running.add(&add(&folder)).unwrap());
    let refused = last.hello(&header, TIMEOUT).unwrap_err();
    let expected = "the recorder refuses the lambda: it records for at most 256 lambdas at a time";
    assert_eq!(refused.to_string(), expected);
    running.status(|status| (status.lambdas, status.recording.lambdas_refused) == (256, 1));
    let mut links = sockets.into_iter().map(RecorderLink::new);
    links.next_back().unwrap().hello(&header, TIMEOUT).unwrap();
    // When one leaves, there is room for another.
    drop(links.next());
    running.status(|status| status.lambdas < 256);
    RecorderLink::new(running.add(&add(&folder)).unwrap()).hello(&header, TIMEOUT).unwrap();
}

#[test]
fn a_preroll_that_cannot_be_allocated_is_an_error_with_help() {
    for bytes in [u64::MAX, 1 << 60] {
        let scratch = TestDir::new();
        let options = RecorderOptions {
            preroll_bytes: Some(bytes),
            ..options(&scratch.0, Clock::from_time_of_day())
        };
        let (_control, stdin) = ControlClient::pair().unwrap();
        let (_reader, writer) = std::io::pipe().unwrap();
        // The ingress is joined later.
        let (_silent, ingress) = UnixStream::pair().unwrap();
        let reports = File::from(OwnedFd::from(writer));
        let connections = RecorderConnections {
            control: stdin,
            ingress: ingress.into(),
            starter: None,
            signer: None,
        };
        let failure = run(options, connections, reports, Arc::default()).unwrap_err();
        assert_eq!(failure.exit, Exit::Usage);
        let text = failure.to_string();
        assert!(text.contains("cannot allocate") && text.contains("--preroll-memory"), "{text}");
    }
}

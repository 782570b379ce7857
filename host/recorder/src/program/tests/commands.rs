//! Tests of commands over a topic.

use std::time::Instant;

use super::running::*;
use crate::recorder::tests::support::*;
use gleaner_lambda::TriggerKind::{Event, Start};
use gleaner_lambda::{Clip, TriggerKind};
use gleaner_messages::transport::Delivery;
use gleaner_protocol::RecordingCounts;
use gleaner_protocol::link::{CommandStatus, RecorderLink};

const TOPIC: &str = "/gleaner/commands";
/// The writer that `meta` names, in hexadecimal digits.
const SOURCE: &str = "command on /gleaner/commands by 07070707070707070707070707070707";

/// A process that receives commands, with a sensor on `/a`.
struct CommandedRun {
    running: Running,
    network: FakeNetwork,
    _sensor: Sensor,
}

impl CommandedRun {
    fn start(scratch: &TestDir) -> CommandedRun {
        let network = FakeNetwork::default();
        network.add("/a");
        network.add_texts(TOPIC);
        let running =
            Running::start(scratch, &network, |options| options.commands = Some(TOPIC.to_owned()));
        let sensor = Sensor::start(&network, running.clock);
        CommandedRun { running, network, _sensor: sensor }
    }

    fn join(&mut self, scratch: &TestDir, name: &str, rolls_ms: (u32, u32)) -> RecorderLink {
        self.running.join(scratch, name, rolls_ms)
    }

    /// Publishes a command once there is a reader.
    fn publish(&self, text: impl AsRef<[u8]>) -> (i64, Delivery) {
        let deadline = Instant::now() + TIMEOUT;
        loop {
            let at = self.running.clock.now();
            match self.network.publish_text(TOPIC, at, text.as_ref()) {
                Some(delivery) => return (at, delivery),
                None => assert!(Instant::now() < deadline, "there is no reader"),
            }
            std::thread::yield_now();
        }
    }

    fn command_status(&mut self, wanted: impl Fn(&CommandStatus) -> bool) -> CommandStatus {
        let status = self.running.status(|status| status.commands.as_ref().is_some_and(&wanted));
        status.commands.unwrap()
    }

    fn accepted_and_refused(&mut self, accepted: u64, refused: u64) {
        let status =
            self.command_status(|status| status.accepted + status.refused >= accepted + refused);
        assert_eq!((status.accepted, status.refused), (accepted, refused));
    }

    fn end(self) {
        assert_eq!(self.running.stopped().1, Ok(()));
    }
}

fn moments(clip: &Clip) -> Vec<(&str, TriggerKind, &str, Option<&str>)> {
    let moment = |moment: &gleaner_lambda::Moment| moment.source.is_some();
    assert!(clip.moments.iter().any(moment));
    let moments = clip.moments.iter();
    moments.map(|m| (m.lambda.as_str(), m.kind, m.label.as_str(), m.source.as_deref())).collect()
}

#[test]
fn an_event_by_command_records_like_the_lambda_and_is_in_no_journal() {
    let scratch = TestDir::new();
    let mut commanded = CommandedRun::start(&scratch);
    let mut link = commanded.join(&scratch, "first", (5000, 100));
    received(&mut commanded.running, 300);
    // The only lambda needs no name. The stamp of this wake lies in the window.
    let at_wake = commanded.running.clock.now();
    link.wake(&entry(at_wake, &[]), 0).unwrap();
    link.poll().unwrap();
    let (at, _) = commanded.publish(r#"{"command": "event", "label": "odd noise", "score": 0.25}"#);
    let clip = commanded.running.clip();
    assert_eq!((clip.from_ns, clip.to_ns, clip.triggers), (at - 5 * S, at + 100 * MS, 1));
    assert_eq!(moments(&clip), [("first", Event, "odd noise", Some(SOURCE))]);
    assert_eq!((clip.moments[0].score, clip.moments[0].at_ns), (Some(0.25), at));
    assert_eq!(clip.lambdas[0].windows, 1);
    let numbers: Vec<_> = scratch.messages(&clip).into_iter().map(|(_, _, seq, _)| seq).collect();
    assert!(numbers.len() > 50 && follow_each_other(&numbers), "{numbers:?}");
    assert_eq!(scratch.journal(&clip, "first").1, [at_wake], "wakes, and nothing else");
    let metadata = scratch.metadata(&clip);
    let decisions: Vec<_> =
        metadata.iter().filter(|(name, _)| name == "gleaner.decision").collect();
    assert_eq!(decisions.len(), 1);
    assert_eq!(decisions[0].1["source"], SOURCE);
    commanded.accepted_and_refused(1, 0);
    commanded.end();
}

#[test]
fn a_stop_ends_what_a_command_started_and_nothing_else() {
    let scratch = TestDir::new();
    let mut commanded = CommandedRun::start(&scratch);
    let mut first = commanded.join(&scratch, "first", (0, 0));
    let second = commanded.join(&scratch, "second", (0, 0));
    received(&mut commanded.running, 50);
    first.wake(&entry(commanded.running.clock.now(), &[Start]), 0).unwrap();
    commanded.running.status(|status| status.recording.windows == 1);
    // The lambda's own recording is not ended by a command.
    commanded.publish(r#"{"command": "stop", "label": "here", "lambda": "first"}"#);
    commanded.accepted_and_refused(0, 1);
    commanded.publish(r#"{"command": "start", "label": "here", "lambda": "second"}"#);
    commanded.accepted_and_refused(1, 1);
    // Nor does the end of the lambda end what was commanded in its name.
    second.bye(TIMEOUT);
    first.bye(TIMEOUT);
    let status = commanded.running.status(|status| status.lambdas == 0);
    assert!(status.is_recording);
    commanded.publish(r#"{"command": "stop", "label": "here"}"#);
    commanded.accepted_and_refused(1, 2);
    let (stopped, _) =
        commanded.publish(r#"{"command": "stop", "label": "here", "lambda": "second"}"#);
    let clip = commanded.running.clip();
    assert!(clip.to_ns >= stopped, "{clip:?}");
    let source = Some(SOURCE);
    let expected = [
        ("first", Start, "here", None),
        ("second", Start, "here", source),
        ("second", TriggerKind::Stop, "here", source),
    ];
    assert_eq!(moments(&clip), expected);
    let expected = [
        "first ended before its stop trigger",
        "no message of /b was received before the clip ended",
    ];
    assert_eq!(clip.incomplete, expected);
    commanded.accepted_and_refused(2, 2);
    commanded.end();
}

#[test]
fn too_many_too_long_and_invalid_commands_are_counted_and_do_nothing() {
    let scratch = TestDir::new();
    let mut commanded = CommandedRun::start(&scratch);
    let long = format!(r#"{{"command": "event", "label": "x"}}{}"#, " ".repeat(4096));
    assert_eq!(commanded.publish(&long).1, Delivery::TooBig);
    for text in [
        "",
        "{\"command\": \"event\", \"label\": \"\u{1b}[2J\", \"lambda\": \"\u{7}\"}",
        "{\"command\":\"x\"}",
    ] {
        assert_eq!(commanded.publish(text).1, Delivery::Taken);
    }
    commanded.publish([0xff; 100]);
    commanded.accepted_and_refused(0, 5);
    for _ in 0..10_000 {
        commanded.publish(r#"{"command":"event","label":"x"}"#);
    }
    commanded.accepted_and_refused(0, 5 + 10_000);
    let (last, _) = commanded.running.stopped();
    assert_eq!(last.recording, RecordingCounts::default());
}

#[test]
fn commands_beyond_the_rate_limit_are_refused_unread() {
    let scratch = TestDir::new();
    let mut commanded = CommandedRun::start(&scratch);
    let _link = commanded.join(&scratch, "first", (0, 0));
    for _ in 0..10_000 {
        commanded.publish(r#"{"command":"event","label":"x"}"#);
    }
    let status = commanded.command_status(|status| status.accepted + status.refused >= 10_000);
    assert_eq!(status.accepted + status.refused, 10_000);
    // Five at once, and one each second.
    assert!((5..100).contains(&status.accepted), "{status:?}");
    commanded.end();
}

#[test]
fn without_the_option_there_are_no_commands() {
    let scratch = TestDir::new();
    let network = FakeNetwork::default();
    network.add("/a");
    network.add_texts(TOPIC);
    let mut running = Running::start(&scratch, &network, |_| {});
    let _sensor = Sensor::start(&network, running.clock);
    let _link = running.join(&scratch, "first", (0, 0));
    received(&mut running, 50);
    let text = br#"{"command": "event", "label": "x"}"#;
    assert_eq!(network.publish_text(TOPIC, running.clock.now(), text), None);
    assert_eq!(running.status(|_| true).commands, None);
}

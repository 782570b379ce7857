//! Tests of the definitions with which live samples are recorded.

use std::fs;
use std::thread;

use super::running::*;
use crate::recorder::tests::support::*;
use gleaner_messages::Sources;
use gleaner_messages::transport::SampleMeta;

/// The definition on the machine, and that of the nodes, with their hashes by rosbags.
const LOCAL: &str = "float64 value";
const OF_LOCAL: &str = "RIHS01_a283753eae7f22037737af432e40e5f0c2e1cd600aa5856e46cdacd81d578bcd";
const NODES: &str = "int64 value";
const OF_NODES: &str = "RIHS01_376752aeb9e256c4e2313368a5a32645d62041d37777621433ea5e52e280b5ea";

/// Records a sample in each of these layouts, of which writers announce number 1 as `hash`: before
/// the topic is attached, or before the first sample of it. Returns the definition of each.
fn definitions_of(layouts: &[u16], hash: &str, is_early: bool) -> Vec<String> {
    let scratch = TestDir::new();
    let folder = scratch.0.join("msg/test_msgs");
    fs::create_dir_all(&folder).unwrap();
    fs::write(folder.join("Number.msg"), LOCAL).unwrap();
    let network = FakeNetwork::default();
    network.add("/a");
    *network.announced.lock().unwrap() = is_early.then(|| hash.to_owned());
    let messages = Sources::new(&[scratch.0.join("msg")], &[]);
    let mut running = Running::start(&scratch, &network, |options| options.messages = messages);
    let mut link = running.join(&scratch, "first", (60_000, 60_000));
    running.status(|status| status.topics.iter().any(|topic| topic.type_name.is_some()));
    for (layout, seq) in layouts.iter().zip(1_u64..) {
        if *layout == 1 {
            *network.announced.lock().unwrap() = Some(hash.to_owned());
        }
        let meta = SampleMeta { layout: *layout, ..meta(running.clock.now(), seq) };
        network.loopback.publish("/a", &meta, &seq.to_le_bytes()).unwrap();
        received(&mut running, seq);
    }
    running.event(&mut link);
    running.status(|status| status.is_recording);
    running.starter.control.stop().unwrap();
    let clip = running.clip();
    assert_eq!(running.ended().1, Ok(()));
    let bytes = fs::read(scratch.0.join(&clip.file)).unwrap();
    let definition = |message: mcap::McapResult<mcap::Message<'_>>| {
        let schema = message.unwrap().channel.schema.clone().unwrap();
        String::from_utf8_lossy(&schema.data).trim().to_owned()
    };
    mcap::MessageStream::new(&bytes).unwrap().map(definition).collect()
}

#[test]
fn each_live_sample_is_recorded_with_the_definition_of_its_layout_or_with_none() {
    let cases: [(&[u16], &str, bool, &[&str]); 7] = [
        (&[0], "", false, &[LOCAL]),
        (&[1, 1], OF_NODES, true, &[NODES, NODES]),
        (&[1, 1], OF_NODES, false, &[NODES, NODES]),
        (&[1], OF_LOCAL, true, &[LOCAL]),
        (&[1], OF_LOCAL, false, &[LOCAL]),
        // The topic has the definition of the first.
        (&[0, 1], OF_LOCAL, false, &[LOCAL, LOCAL]),
        (&[0, 1], OF_NODES, false, &[LOCAL, ""]),
    ];
    // They mostly wait for reports.
    thread::scope(|scope| {
        for (layouts, hash, is_early, expected) in cases {
            scope.spawn(move || assert_eq!(definitions_of(layouts, hash, is_early), expected));
        }
    });
}

//! Inputs over an ingress, at the limits of a manifest.

use std::fmt::Write;
use std::sync::Arc;
use std::thread::JoinHandle;

use gleaner_host::api::data::Topic;
use gleaner_host::input::open_fed_inputs;
use gleaner_ingress::Ingress;
use gleaner_lambda::manifest::Manifest;
use gleaner_messages::Sources;
use gleaner_messages::transport::loopback::Loopback;
use gleaner_messages::transport::{Guid, SampleMeta};
use gleaner_protocol::ingress::{AddReader, IngressControl, TopicGrant};
use gleaner_samples::Feed;
use gleaner_tests::TempFolder;

use crate::live::{Announced, WrittenLoopback};
use crate::live_layouts::LAYOUT;
use crate::meta;

const TYPE: &str = "test_msgs/msg/Number";
const DEFINITION: &str = "int64 value\n";

/// Inputs of a lambda, and the ingress that fills them.
struct FedInputs {
    topics: Vec<Arc<Topic>>,
    loopback: Loopback,
    feed: Feed,
    control: IngressControl,
    ingress: JoinHandle<()>,
}

impl FedInputs {
    /// Opens `count` inputs with these lines of the manifest.
    fn open(count: u32, lines: &str) -> Self {
        let mut text = "[lambda]\nname = \"many\"\nversion = \"0.1.0\"\nkind = \"wasm\"\n\
                        entry = \"many.wasm\"\n[schedule]\nevent = \"input_0\"\n"
            .to_owned();
        let loopback = Loopback::new();
        let folder = TempFolder::new();
        folder.write("test_msgs/Number.msg", DEFINITION);
        for number in 0..count {
            let (input, topic) = (format!("input_{number}"), topic(number));
            loopback.add_topic(&topic, TYPE, DEFINITION);
            writeln!(text, "[[input]]\nname = {input:?}\ntopic = {topic:?}\ntype = {TYPE:?}")
                .and_then(|()| writeln!(text, "{lines}"))
                .unwrap();
        }
        let manifest = Manifest::parse(&text, "lambda.toml").unwrap();
        let grant = |(id, input): (u32, &gleaner_lambda::manifest::InputSpec)| {
            TopicGrant::for_input(id, input, input.topic.as_str(), id == 0, false)
        };
        let topics = (0..).zip(&manifest.inputs).map(grant).collect();
        // The layout is known from the start, so samples need no wake to be shown.
        let announced = Announced::new(Some(LAYOUT.to_owned()).into());
        let source = WrittenLoopback(loopback.clone(), announced);
        let (mut control, ingress) = Ingress::start_in_thread(Box::new(source));
        let added = AddReader { name: "many".to_owned(), topics, publishes: Vec::new() };
        let mut feed = Feed::connect(control.add_reader(&added).unwrap()).unwrap();
        let sources = Sources::new(&[folder.path().to_owned()], &[]);
        let topics = open_fed_inputs(&manifest, &[], &mut feed, &sources).unwrap();
        Self { topics, loopback, feed, control, ingress }
    }

    fn publish(&self, number: u32, value: i64) {
        let meta = SampleMeta { writer: Guid([7; 16]), ..meta(value, value as u64) };
        let cdr = value.to_le_bytes();
        self.loopback.publish(&topic(number), &meta, &cdr).unwrap();
    }

    fn end(self) {
        drop((self.feed, self.control));
        self.ingress.join().unwrap();
    }
}

fn topic(number: u32) -> String {
    format!("/topic_{number}")
}

#[test]
fn forty_inputs_of_the_default_hold_are_attached() {
    let inputs = FedInputs::open(40, "");
    for number in 0..40 {
        inputs.publish(number, 7);
        assert!(inputs.topics[number as usize].newest().unwrap().is_some(), "input {number}");
    }
    inputs.end();
}

#[test]
fn a_lambda_of_most_inputs_and_the_longest_hold_keeps_all_that_it_may() {
    let inputs = FedInputs::open(256, "hold = 1024");
    assert_eq!(inputs.topics.len(), 256);
    let last = &inputs.topics[255];
    let field = last.field("value").unwrap();
    let mut kept = Vec::new();
    for value in 0..1024 {
        inputs.publish(255, value);
        kept.push(last.newest().unwrap().unwrap());
    }
    // They have left the ring.
    for value in 1024..2048 {
        inputs.publish(255, value);
    }
    for (sample, value) in kept.iter().zip(0..) {
        assert_eq!(sample.number(&field).unwrap(), f64::from(value));
    }
    drop(kept);
    inputs.end();
}

#[test]
fn all_samples_of_the_deepest_input_are_read_at_once() {
    let inputs = FedInputs::open(1, "depth = 65536\nmax_size = \"8 B\"");
    for value in 0..70_000 {
        inputs.publish(0, value);
    }
    let field = inputs.topics[0].field("value").unwrap();
    let column = inputs.topics[0].column(&field, 65_536).unwrap();
    let newest: Vec<f64> = (70_000 - 65_536..70_000).map(f64::from).collect();
    assert_eq!(column.values, newest);
    assert_eq!(inputs.topics[0].column_since(&field, 0).unwrap().values, newest);
    inputs.end();
}

//! The program `gleaner-bench node`: a RustDDS reader in one thread, without Gleaner, which answers
//! as the nodes of `bench/baselines` do. Bare, it only stamps and answers; otherwise it does the
//! arithmetic of the lambda first, with `header.stamp` where a lambda uses the time of reception.

use std::cell::RefCell;
use std::collections::VecDeque;
use std::convert::Infallible;
use std::error::Error;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use bench_imu_spectrum::road_spectrum::{RoadSpectrum, SAMPLES};
use bytes::Bytes;
use clap::Args;
use gleaner_messages::transport::Clock;
use gleaner_messages::{CdrWriter, Endian, FieldPath, HeaderStamp, ImageView, header_stamp};
use gleaner_pixels::{Encoding, View, ops};
use imu_fft::road::Road;
use mio::{Events, Interest, Poll, Token};
use rustdds::policy::{Durability, History, Reliability, ResourceLimits};
use rustdds::{
    DomainParticipantBuilder, QosPolicies, QosPolicyBuilder, RepresentationIdentifier, Topic,
    TopicKind, no_key,
};
use rustix::net::{AddressFamily, SocketType, socket, sockopt};
use rustix::process::{Signal, set_parent_process_death_signal};
use signal_hook::consts::{SIGINT, SIGTERM};

use super::ANSWERS;
use super::workload::{BRAKE_MPS2, DARK_LUMA, IMU, Workload};
use crate::answers::definitions;
use crate::native_rules::{BRAKE_WINDOW_NS, FFT_WINDOW_S, REFRACTORY_NS, braking};

/// Receive buffer of its sockets, as of the ingress.
const BUFFER_BYTES: usize = 64 << 20;

/// Number of samples that it keeps. With more of them, the memory of images would never be reused.
const DEPTH: i32 = 16;

/// As in `examples/imu-fft`.
const IMU_DEPTH: usize = 4096;
const ROUGH: f64 = 0.5;
/// As in `bench/lambdas/imu-spectrum`.
const ROUGH_SPECTRUM: f64 = 0.09;

/// The work of a node.
#[derive(Args, Clone, Copy)]
pub struct NodeOptions {
    /// The workload.
    workload: Workload,
    /// Only stamp and answer each sample.
    #[arg(long)]
    bare: bool,
}

/// Answers until SIGINT or SIGTERM, or until the bench ends.
pub fn run_node(options: &NodeOptions) -> ExitCode {
    let stop = Arc::<AtomicBool>::default();
    for signal in [SIGINT, SIGTERM] {
        let registered = signal_hook::flag::register(signal, Arc::clone(&stop));
        registered.expect("these signals can be handled");
    }
    set_parent_process_death_signal(Some(Signal::TERM)).expect("a signal that exists");
    answer(&stop, *options);
    ExitCode::SUCCESS
}

fn answer(stop: &AtomicBool, options: NodeOptions) {
    let builder = DomainParticipantBuilder::new(0).socket_receive_buffer_size(BUFFER_BYTES);
    let participant = builder.build().expect("a private network can be joined");
    let qos = qos();
    let topic = |name: &str, type_name: &str| -> Topic {
        let name = format!("rt{name}");
        let topic = participant.create_topic(name, type_name.to_owned(), &qos, TopicKind::NoKey);
        topic.expect("a topic can be created")
    };
    let subscriber = participant.create_subscriber(&qos).expect("a subscriber can be created");
    let mut poll = Poll::new().expect("the system supports polling");
    let has_second = options.workload.is_brake_dark() && !options.bare;
    let inputs = has_second.then_some(IMU).into_iter().chain([options.workload.event()]);
    let readers: Vec<_> = inputs
        .map(|input| {
            let topic = topic(input.0, input.1);
            let mut reader = subscriber
                .create_simple_datareader_no_key::<Option<NodeAnswer>, NodeAdapter>(
                    &topic,
                    Some(qos.clone()),
                )
                .expect("a reader can be created");
            poll.registry()
                .register(&mut reader, Token(0), Interest::READABLE)
                .expect("a reader can be polled");
            (reader, input == IMU)
        })
        .collect();
    let answers = topic(ANSWERS, "sensor_msgs::msg::dds_::TimeReference_");
    let publisher = participant.create_publisher(&qos).expect("a publisher can be created");
    let writer =
        publisher.create_datawriter_no_key::<Bytes, NodeAdapter>(&answers, Some(qos.clone()));
    let writer = writer.expect("a writer can be created");
    let lambda = RefCell::new(NodeLambda::new(options));
    let stack = "RustDDS, in one thread";
    let first = serde_json::json!({"ready": true, "stack": stack, "socket_buffer": granted()});
    println!("{first}");
    let mut events = Events::with_capacity(16);
    let (clock, mut message, mut wakes) = (Clock::new(0), CdrWriter::new(), 0);
    while !stop.load(Ordering::Relaxed) {
        // An interrupted poll is no reason to stop.
        let _ = poll.poll(&mut events, Some(Duration::from_millis(100)));
        for (reader, is_imu) in &readers {
            reader.drain_read_notifications();
            let deciding = Deciding { lambda: &lambda, is_imu: *is_imu };
            while let Ok(Some(sample)) = reader.try_take_one_with(deciding) {
                let Some(NodeAnswer { stamp_ns, label }) = sample.into_value() else { continue };
                let now = clock.now();
                message.clear();
                message.time(stamp_ns).string("").time(now);
                message.string(&format!("native:{wakes}:{label}"));
                let _ = writer.write(Bytes::copy_from_slice(message.bytes()), None);
                wakes += 1;
            }
        }
    }
}

/// Returns the receive buffer in bytes that the kernel grants each of its sockets, as the ingress
/// determines it; `None` if it is unknown. The kernel reports twice the size.
fn granted() -> Option<usize> {
    let socket = socket(AddressFamily::INET, SocketType::DGRAM, None).ok()?;
    sockopt::set_socket_recv_buffer_size(&socket, BUFFER_BYTES).ok()?;
    sockopt::socket_recv_buffer_size(&socket).ok().map(|doubled| doubled / 2)
}

fn qos() -> QosPolicies {
    let limits =
        ResourceLimits { max_samples: DEPTH, max_instances: 1, max_samples_per_instance: DEPTH };
    let reliable = Reliability::Reliable { max_blocking_time: rustdds::Duration::from_millis(100) };
    QosPolicyBuilder::new()
        .reliability(reliable)
        .history(History::KeepLast { depth: DEPTH })
        .durability(Durability::Volatile)
        .resource_limits(limits)
        .build()
}

/// The answer to a sample that wakes the node.
struct NodeAnswer {
    stamp_ns: i64,
    /// Label of the trigger; empty without one.
    label: &'static str,
}

/// The rules of a lambda, and what they need of the samples so far.
struct NodeLambda {
    /// All inputs begin with a header.
    stamp: HeaderStamp,
    /// Of the IMU, with its newest values by their stamps.
    field: FieldPath,
    samples: VecDeque<(i64, f64)>,
    rules: NodeRules,
}

enum NodeRules {
    Bare,
    ImuFft(Road),
    ImuSpectrum(RoadSpectrum),
    /// With the stamp of the last trigger.
    BrakeDark(Option<i64>),
}

impl NodeLambda {
    fn new(options: NodeOptions) -> Self {
        let (axis, rules) = match options.workload {
            _ if options.bare => ("z", NodeRules::Bare),
            Workload::Empty | Workload::EmptyAwake | Workload::Detector => ("z", NodeRules::Bare),
            Workload::ImuFft => ("z", NodeRules::ImuFft(Road::new(FFT_WINDOW_S))),
            Workload::ImuSpectrum => {
                let spectrum = RoadSpectrum::new().expect("the length is a power of two");
                ("z", NodeRules::ImuSpectrum(spectrum))
            }
            Workload::Brake720 | Workload::Brake1080 => ("x", NodeRules::BrakeDark(None)),
        };
        let imu = definitions("sensor_msgs/msg/Imu");
        let field = FieldPath::compile(&imu, &format!("linear_acceleration.{axis}"));
        Self {
            stamp: header_stamp(&imu).expect("an IMU has a header"),
            field: field.expect("a field of the type"),
            samples: VecDeque::with_capacity(IMU_DEPTH),
            rules,
        }
    }

    /// Returns the answer to a sample; `None` for one that does not wake the node.
    fn on_sample(
        &mut self,
        is_imu: bool,
        cdr: &[u8],
    ) -> Result<Option<NodeAnswer>, Box<dyn Error>> {
        let stamp_ns = self.stamp.read(cdr, Endian::Little)?;
        if is_imu && !matches!(self.rules, NodeRules::Bare) {
            self.samples.truncate(IMU_DEPTH - 1);
            self.samples.push_front((stamp_ns, self.field.number(cdr, Endian::Little)?));
        }
        let label = match &mut self.rules {
            NodeRules::Bare => "",
            NodeRules::ImuFft(road) => match road.note(stamp_ns)? {
                Some(count) if self.samples.len() >= count => {
                    let (at_ns, values) = oldest_first(self.samples.iter().take(count));
                    let is_rough = road.roughness(&at_ns, &values)?.score > ROUGH;
                    if is_rough { "rough-road" } else { "" }
                }
                _ => "",
            },
            NodeRules::ImuSpectrum(_) if self.samples.len() < SAMPLES => "",
            NodeRules::ImuSpectrum(spectrum) => {
                let (_, values) = oldest_first(self.samples.iter().take(SAMPLES));
                let is_rough = spectrum.score(&values)? > ROUGH_SPECTRUM;
                if is_rough { "rough-road" } else { "" }
            }
            NodeRules::BrakeDark(_) if is_imu => return Ok(None),
            NodeRules::BrakeDark(last_ns) => {
                let is_dark = is_braking(&self.samples, stamp_ns)
                    && last_ns.is_none_or(|last| stamp_ns - last >= REFRACTORY_NS)
                    && mean_luma(cdr)? < DARK_LUMA;
                if is_dark {
                    *last_ns = Some(stamp_ns);
                    "brake-dark"
                } else {
                    ""
                }
            }
        };
        Ok(Some(NodeAnswer { stamp_ns, label }))
    }
}

fn oldest_first<'a>(
    newest_first: impl DoubleEndedIterator<Item = &'a (i64, f64)>,
) -> (Vec<i64>, Vec<f64>) {
    newest_first.rev().copied().unzip()
}

/// Returns whether the window is full, and its mean is that of a car that brakes.
fn is_braking(samples: &VecDeque<(i64, f64)>, now: i64) -> bool {
    let window = samples.iter().filter(|(at_ns, _)| *at_ns > now - BRAKE_WINDOW_NS);
    let (at_ns, values) = oldest_first(window);
    braking(&at_ns, &values, now, BRAKE_MPS2).is_some()
}

/// Returns the mean luma of a `sensor_msgs/msg/Image`, as the host computes it for a lambda.
fn mean_luma(cdr: &[u8]) -> Result<f64, Box<dyn Error>> {
    let ImageView { width, height, encoding, is_bigendian, step, data } =
        ImageView::read(cdr, Endian::Little)?;
    let encoding = Encoding::from_ros(encoding)?;
    let view = View::new(width, height, step, encoding, is_bigendian, data)?;
    Ok(ops::mean_luma(&view, None)?)
}

/// Decides while RustDDS decodes a sample, so that an image is read where it was received.
#[derive(Clone, Copy)]
struct Deciding<'a> {
    lambda: &'a RefCell<NodeLambda>,
    is_imu: bool,
}

impl<'de> no_key::Decode<'de, Option<NodeAnswer>> for Deciding<'_> {
    type Error = Infallible;

    fn decode_bytes(
        self,
        cdr: &'de [u8],
        _: RepresentationIdentifier,
    ) -> Result<Option<NodeAnswer>, Infallible> {
        let answer = self.lambda.borrow_mut().on_sample(self.is_imu, cdr);
        Ok(answer.expect("the player sends whole messages"))
    }
}

struct NodeAdapter;

impl no_key::DeserializerAdapter<Option<NodeAnswer>> for NodeAdapter {
    type Error = Infallible;
    type Decoded = Option<NodeAnswer>;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &[RepresentationIdentifier::CDR_LE]
    }

    fn transform_decoded(answer: Option<NodeAnswer>) -> Option<NodeAnswer> {
        answer
    }
}

impl no_key::SerializerAdapter<Bytes> for NodeAdapter {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(cdr: &Bytes) -> Result<Bytes, Infallible> {
        Ok(cdr.clone())
    }
}

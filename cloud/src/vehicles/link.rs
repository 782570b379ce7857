//! The control channel of a vehicle, from its first frame to its end.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::Bytes;
use futures_util::{SinkExt, StreamExt};
use gleaner_base::{Exit, Failure, RateLimit, excerpt};
use gleaner_fleet::{
    Ack, Body, Desired, Frame, GoAway, Hello, PROBLEMS_MAX, PROTOCOL, Ping, Pong, Records,
    Reported, TAIL_S, TAIL_STREAMS_MAX, Tail, WantedProblem, Welcome, decompress,
};
use gleaner_protocol::vehicle_api::VehicleStatus;
use hyper::upgrade::Upgraded;
use hyper_util::rt::TokioIo;
use tokio::sync::{SemaphorePermit, watch};
use tokio::time::{MissedTickBehavior, interval, sleep, timeout};
use tokio_tungstenite::WebSocketStream;
use tokio_tungstenite::tungstenite::Message;
use zstd::bulk::Decompressor;

use super::batch;
use crate::cloud::Cloud;
use crate::counts::COUNTS;
use crate::error::{CloudError, CloudResult};
use crate::hub::PendingRequests;
use crate::place::blocking;
use crate::store::{Retention, VehicleReport, VehicleTail, now, now_ms};

/// Interval of signs of life, in s; without one for three of them, the connection is dead.
/// Under a load of 10,000 vehicles its end takes 4 s longer, which is to be within 60 s, too.
const PING_S: u32 = 18;
/// Time for the first frame, and for one to a vehicle.
const HELLO: Duration = Duration::from_secs(10);
const SEND: Duration = Duration::from_secs(60);
/// Time after which a vehicle connects again that has sent something wrong, in ms.
const WRONG_MS: u64 = 60_000;
/// Latest time after which one connects again whose connection the cloud itself has failed, in ms.
const INTERNAL_MS: u64 = 10_000;
/// Frames of a vehicle that are written to the disk: more wait.
const WRITES: RateLimit = RateLimit::of(20.0, 100.0);
/// Length of a report or of records, decompressed, that does not count among the frames that are
/// stored at a time: many small ones are committed together.
const SMALL: usize = 16 << 10;
/// Number of labels of a vehicle, and of the bytes of a name or value.
const LABEL_MAX: usize = 256;

type VehicleSocket = WebSocketStream<TokioIo<Upgraded>>;

struct VehicleLink<'c> {
    cloud: &'c Cloud,
    name: &'c str,
    /// SHA-256 of its certificate.
    certificate: &'c str,
    socket: VehicleSocket,
    epoch: u64,
    /// Number of the desired state that was sent last.
    sent: u64,
    writes: RateLimit,
    stored: StoredReport,
}

/// Hashes of what is stored of the last report of a connection: the next one is compared with it.
#[derive(Debug, Default, Clone, Copy)]
struct StoredReport {
    whole: u64,
    states: u64,
}

pub(super) async fn serve(cloud: &Cloud, (name, certificate): (&str, &str), socket: VehicleSocket) {
    let mut link = VehicleLink {
        cloud,
        name,
        certificate,
        socket,
        epoch: 0,
        sent: 0,
        writes: WRITES,
        stored: StoredReport::default(),
    };
    let end = match link.run().await {
        Ok(end) => end,
        Err(error) => {
            tracing::warn!(vehicle = name, reason = error.reason(), "a connection was ended");
            COUNTS.refused_links.add(1);
            // With a database that is back soon, the vehicle should be, too, but not all at once.
            let after_ms = match error.is_internal() {
                true => getrandom::u64().map_or(WRONG_MS, |random| random % INTERNAL_MS),
                false => WRONG_MS,
            };
            Some(GoAway { after_ms, reason: error.reason() })
        }
    };
    if cloud.hub.remove(name, link.epoch)
        && let Err(error) = cloud.store.disconnect(name, link.epoch).await
    {
        tracing::debug!(
            vehicle = name,
            reason = error.reason(),
            "could not store its end; will retry"
        );
    }
    if let Some(end) = end {
        // The vehicle may be gone.
        let _ = link.send(Body::GoAway(end)).await;
        let _ = timeout(SEND, link.socket.send(Message::Close(None))).await;
    }
}

impl<'c> VehicleLink<'c> {
    /// Serves the connection; returns the reason of its end, unless it was the vehicle. Everything
    /// but the wait for the next frame is in a box: an idle connection does not have its room.
    async fn run(&mut self) -> CloudResult<Option<GoAway>> {
        match Box::pin(self.open()).await? {
            Ok(mut orders) => self.serve_frames(&mut orders).await,
            Err(end) => Ok(end),
        }
    }

    /// Exchanges the first frames; returns the orders, or the reason of the end.
    async fn open(
        &mut self,
    ) -> CloudResult<Result<watch::Receiver<PendingRequests>, Option<GoAway>>> {
        let Ok(hello) = timeout(HELLO, self.receive()).await else { return Ok(Err(None)) };
        let hello = match hello? {
            None => return Ok(Err(None)),
            Some(Body::Hello(hello)) if hello.protocol == PROTOCOL => hello,
            Some(Body::Hello(Hello { protocol, .. })) => {
                let message = format!("the channel has version {PROTOCOL}, not {protocol}");
                return Err(wrong(message));
            }
            Some(_) => return Err(wrong("the first frame is not a hello")),
        };
        let begun = self.cloud.store.connect(self.name, self.certificate, &hello).await?;
        let (epoch, cursors) = begun;
        self.epoch = epoch;
        let Some(orders) = self.cloud.hub.add(self.name, self.epoch) else {
            let reason = "there is a newer one".to_owned();
            return Ok(Err(Some(GoAway { after_ms: 0, reason })));
        };
        let welcome = Welcome { epoch, time_ms: now_ms(), ping_s: PING_S, cursors };
        self.cloud.live_streams.connected(self.name);
        self.send(Body::Welcome(welcome)).await?;
        self.send_wanted().await?;
        Ok(Ok(orders))
    }

    async fn serve_frames(
        &mut self,
        orders: &mut watch::Receiver<PendingRequests>,
    ) -> CloudResult<Option<GoAway>> {
        let period = Duration::from_secs(PING_S.into());
        let (mut pings, mut number) = (interval(period), 0);
        let silence = sleep(3 * period);
        tokio::pin!(silence);
        pings.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let (mut sent_changes, mut sent_tail) = (0, Arc::default());
        loop {
            // An order may be older than this loop, or have come while a frame was handled.
            let PendingRequests { changes, generation, tail, end } =
                orders.borrow_and_update().clone();
            if end.is_some() {
                return Ok(end);
            }
            if changes != sent_changes || generation > self.sent {
                sent_changes = changes;
                Box::pin(self.send_wanted()).await?;
            }
            if tail != sent_tail {
                Box::pin(self.send(Body::Tail(lease(&tail)))).await?;
                sent_tail = tail;
            }
            tokio::select! {
                body = self.receive() => {
                    let Some(body) = body? else { return Ok(None) };
                    silence.as_mut().reset(tokio::time::Instant::now() + 3 * period);
                    self.cloud.hub.saw(self.name);
                    Box::pin(self.handle(body)).await?;
                }
                changed = orders.changed() => if changed.is_err() {
                    // It was removed from the hub, which has set the end before.
                    return Ok(orders.borrow().end.clone());
                },
                () = silence.as_mut() => {
                    return Ok(Some(GoAway { after_ms: 0, reason: "no sign of life".into() }));
                }
                _ = pings.tick() => {
                    number += 1;
                    Box::pin(self.send(Body::Ping(Ping { number }))).await?;
                }
            }
        }
    }

    async fn handle(&mut self, body: Body) -> CloudResult<()> {
        match body {
            Body::Ping(Ping { number }) => self.send(Body::Pong(Pong { number })).await,
            Body::Pong(_) => Ok(()),
            Body::Reported(reported) => {
                if self.store_report(reported).await? {
                    self.send_wanted().await?;
                }
                Ok(())
            }
            Body::Records(records) => {
                let ack = self.store_records(records).await?;
                self.send(Body::Ack(ack)).await
            }
            Body::Hello(_)
            | Body::Welcome(_)
            | Body::Desired(_)
            | Body::Ack(_)
            | Body::GoAway(_)
            | Body::Tail(_) => Err(wrong("a frame came that a vehicle does not send")),
        }
    }

    /// Waits until a frame may be stored: one of this vehicle, and one of all.
    async fn may_store(&mut self) -> Option<SemaphorePermit<'c>> {
        while !self.writes.take(1.0, Instant::now()) {
            sleep(Duration::from_millis(100)).await;
        }
        // It is never closed.
        self.cloud.limits.frames.acquire().await.ok()
    }

    /// Stores a report, as far as it has something new; returns whether the desired state changed.
    async fn store_report(&mut self, reported: Reported) -> CloudResult<bool> {
        let frame = self.may_store().await;
        let most = text_max(&reported.status);
        let name = self.name.to_owned();
        let mut report = parsed(most, move || report(&name, reported)).await?;
        let _frame = frame.filter(|_| report.status.len() > SMALL);
        let (before, stored) = (self.stored, StoredReport::of(&report));
        if stored.whole == before.whole {
            return Ok(false);
        }
        report.has_new_states = stored.states != before.states;
        let has_changed = self.cloud.store.report(self.name, self.epoch, report).await?;
        self.stored = stored;
        Ok(has_changed)
    }

    async fn store_records(&mut self, records: Records) -> CloudResult<Ack> {
        let frame = self.may_store().await;
        let most = text_max(&records.lines);
        let batch = parsed(most, move || batch::parse(&records)).await?;
        let bytes = batch.lines.iter().map(|(_, _, line)| line.len()).sum::<usize>();
        let _frame = frame.filter(|_| bytes > SMALL);
        let (store, bounds) = (&self.cloud.store, Retention::DEFAULT);
        let ack = store.append(self.name, self.epoch, batch, bounds).await?;
        self.cloud.hub.arrived(self.name);
        Ok(ack)
    }

    /// Sends the desired state, unless it was sent.
    async fn send_wanted(&mut self) -> CloudResult<()> {
        let wants = self.cloud.store.wants(self.name).await?;
        if wants.generation == self.sent {
            return Ok(());
        }
        self.sent = wants.generation;
        let (generation, keeps) = (wants.generation, wants.keeps);
        let desired = Desired { generation, deployments: wants.deployments.to_vec(), keeps };
        self.send(Body::Desired(desired)).await
    }

    /// Receives the content of a frame; `None` at the end. One without content is of a later
    /// version, and skipped.
    async fn receive(&mut self) -> CloudResult<Option<Body>> {
        loop {
            let bytes = match self.socket.next().await {
                Some(Ok(Message::Binary(bytes))) => bytes,
                Some(Ok(Message::Ping(_) | Message::Pong(_) | Message::Frame(_))) => continue,
                Some(Ok(Message::Text(_))) => return Err(wrong("a frame of text came")),
                Some(Ok(Message::Close(_))) | None => return Ok(None),
                Some(Err(error)) => {
                    tracing::debug!(vehicle = self.name, %error, "a connection has ended");
                    return Ok(None);
                }
            };
            let frame = Frame::decoded(&bytes).map_err(|error| wrong(error.to_string()))?;
            if frame.body.is_some() {
                return Ok(frame.body);
            }
        }
    }

    async fn send(&mut self, body: Body) -> CloudResult<()> {
        let frame = Message::Binary(Bytes::from(Frame::encoded(body)));
        match timeout(SEND, self.socket.send(frame)).await {
            Ok(Ok(())) => Ok(()),
            _ => Err(wrong("a frame cannot be sent")),
        }
    }
}

/// Returns the most bytes that a compressed part of a frame can have once it is decompressed.
fn text_max(compressed: &[u8]) -> usize {
    Decompressor::upper_bound(compressed).unwrap_or(usize::MAX)
}

/// Parses a frame of at most so many bytes: a large one beside the threads that serve connections,
/// which it would keep from others. Of these, as many are parsed at a time as may be stored.
async fn parsed<T: Send + 'static>(
    most: usize,
    parse: impl FnOnce() -> CloudResult<T> + Send + 'static,
) -> CloudResult<T> {
    if most <= SMALL {
        return parse();
    }
    let failed =
        |error| Failure::caused_by(Exit::Internal, "a frame of a vehicle cannot be parsed", &error);
    blocking(move || Ok(parse())).await.map_err(failed)?
}

fn lease(tail: &VehicleTail) -> Tail {
    let streams = tail.streams.iter().take(TAIL_STREAMS_MAX).cloned().collect();
    let seconds = (tail.until - now()).clamp(1, TAIL_S.into());
    Tail { streams, seconds: u32::try_from(seconds).unwrap_or(TAIL_S) }
}

fn report(name: &str, reported: Reported) -> CloudResult<VehicleReport> {
    let json = decompress(&reported.status).map_err(|error| wrong(error.to_string()))?;
    let json = String::from_utf8(json).map_err(|error| wrong(error.to_string()))?;
    let status: VehicleStatus = serde_json::from_str(&json)
        .map_err(|error| wrong(format!("not a valid status: {error}")))?;
    // The age is added to the object. As an array, it would have no names.
    if status.age_s.is_some() || !json.trim_start().starts_with('{') {
        return Err(wrong("a status is an object without an age, which only the cloud knows"));
    }
    let is_long = |text: &String| text.len() > LABEL_MAX;
    let mut labels = status.labels.iter();
    if labels.len() > LABEL_MAX || labels.any(|(name, value)| is_long(name) || is_long(value)) {
        return Err(wrong(format!("a vehicle has at most {LABEL_MAX} labels, each as short")));
    }
    let problems = reported.problems.iter().take(PROBLEMS_MAX);
    let mut problems: Vec<_> = problems.map(|it| it.bounded()).collect();
    let is_itself = status.vehicle == name;
    if !is_itself {
        problems.push(WantedProblem {
            title: format!("it calls itself `{}`", excerpt(&status.vehicle)),
            help: "set its name back in vehicle.toml, or enrol it under the new one".to_owned(),
            ..WantedProblem::default()
        });
    }
    let mut report = VehicleReport::new(reported.generation, problems, status, json);
    // Its vehicle.toml may be empty after a power cut: what its former labels select stays there.
    report.labels = report.labels.filter(|_| is_itself);
    Ok(report)
}

impl StoredReport {
    fn of(report: &VehicleReport) -> Self {
        Self {
            whole: hash(&(report.handled, &report.problems, &report.status)),
            states: hash(&report.states),
        }
    }
}

fn hash(value: &impl Hash) -> u64 {
    let mut hasher = DefaultHasher::new();
    value.hash(&mut hasher);
    // 0 stands for nothing.
    hasher.finish().max(1)
}

fn wrong(message: impl Into<String>) -> CloudError {
    CloudError::usage(message, "use a version of gleaner that fits the one of the cloud")
}

#[cfg(test)]
mod tests {
    use std::thread;

    use gleaner_fleet::compress;
    use serde_json::json;

    use super::*;
    use crate::store::tests::{self, connected};

    #[tokio::test]
    async fn a_large_frame_is_parsed_beside_the_threads_of_connections() {
        let own = thread::current().id();
        for (bytes, is_own) in [(0, true), (SMALL, true), (SMALL + 1, false), (8 << 20, false)] {
            // Of zeros, 8 MiB take a few hundred bytes.
            let most = text_max(&compress(&vec![0; bytes]));
            let other = parsed(most, || Ok(thread::current().id())).await.unwrap();
            assert_eq!(other == own, is_own, "{bytes}");
        }
        assert!(text_max(b"no frame") > SMALL, "its length is unknown");
    }

    #[tokio::test]
    async fn a_vehicle_that_calls_itself_otherwise_keeps_its_labels() {
        let (_folder, store) = tests::store().await;
        let epoch = connected(&store, "car-8").await;
        store.report("car-8", epoch, tests::report(json!({ "a": "b" }), json!([]))).await.unwrap();
        let of_car_7 = tests::report(json!({}), json!([])).status;
        let reported = Reported { status: compress(of_car_7.as_bytes()), ..Reported::default() };
        store.report("car-8", epoch, report("car-8", reported).unwrap()).await.unwrap();
        assert_eq!(store.vehicles("", 1).await.unwrap()[0].labels["a"], "b");
    }
}

//! Hints between replicas: what may have changed. PostgreSQL is the only truth: who receives a hint
//! reads it there. A hint that is lost, late or wrong changes nothing but the time after which a
//! replica looks.
//!
//! Hints travel by NATS. A server that is down, slow or hostile keeps no request waiting: what does
//! not fit into the queue is dropped and counted.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use async_nats::{Client, ConnectOptions, Event, ServerAddr, Subscriber};
use futures_util::StreamExt;
use gleaner_base::{Exit, Failure};
use serde::{Deserialize, Serialize};
use tokio::sync::{Notify, mpsc};
use tokio::task::JoinSet;

/// Maximum number of hints that wait to be sent.
const QUEUE: usize = 1024;
/// Maximum number of names in a hint, and of those that wait to be looked at.
const NAMES_MAX: usize = 256;
const WAITING_MAX: usize = 20_000;
/// Maximum length of a hint, and of a name in it.
const HINT_MAX: usize = 64 << 10;
const NAME_MAX: usize = 200;
/// Longest pause between two attempts to connect.
const RECONNECT_MAX: Duration = Duration::from_secs(2);

/// A thing that may have changed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum Hint {
    /// The connections or the wanted states of these vehicles.
    Vehicles(Vec<String>),
    Records(String),
    /// The leases of streams that people read.
    Tails,
}

#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct HintedChanges {
    pub(crate) changed: BTreeSet<String>,
    pub(crate) with_records: BTreeSet<String>,
    pub(crate) has_tails: bool,
}

/// The hints that were received, until they are looked at.
#[derive(Debug, Default)]
pub(crate) struct ReceivedHints {
    waiting: Mutex<HintedChanges>,
    notify: Notify,
    /// Number of messages that were no hint, or did not fit.
    ignored: AtomicU64,
}

/// The sending side; without a bus, it drops everything.
#[derive(Debug, Default)]
pub(crate) struct Bus {
    queue: Option<mpsc::Sender<Hint>>,
    dropped: AtomicU64,
}

#[derive(Debug, Clone)]
pub(crate) struct BusAddress(ServerAddr);

impl BusAddress {
    /// Parses a URL.
    ///
    /// # Errors
    ///
    /// A failure if it is none of NATS, or has a password, which other users of the machine could
    /// see. It does not repeat the URL.
    pub(crate) fn parse(url: &str) -> Result<Self, Failure> {
        let refused = |message: &str| {
            Failure::new(Exit::Usage, message).with_help(
                "write nats://HOST:PORT or tls://HOST:PORT, with the user in NATS_USER and the \
                 password in NATS_PASSWORD",
            )
        };
        let is_known = url
            .split_once("://")
            .is_some_and(|(scheme, host)| ["nats", "tls"].contains(&scheme) && !host.is_empty());
        let address = url.parse::<ServerAddr>().ok().filter(|_| is_known);
        let address = address.ok_or_else(|| refused("--bus is no address of a NATS server"))?;
        match address.username().is_some() || address.password().is_some() {
            true => Err(refused("--bus has a user or a password")),
            false => Ok(Self(address)),
        }
    }

    /// Connects for as long as the tasks run, again and again if need be.
    ///
    /// # Errors
    ///
    /// A failure if the settings cannot be used. A server that is down is none.
    pub(crate) async fn connect(
        self,
        cloud: &str,
        tasks: &mut JoinSet<()>,
    ) -> Result<(Bus, Arc<ReceivedHints>), Failure> {
        let failed = |error: &dyn std::error::Error| {
            let mut failure = Failure::new(Exit::Usage, "the bus cannot be used");
            failure.causes = vec![error.to_string()];
            failure.with_help("check --bus, NATS_USER and NATS_PASSWORD")
        };
        let text = |name: &str| std::env::var(name).ok().filter(|it| !it.is_empty());
        let mut options = ConnectOptions::new();
        if let (Some(user), Some(password)) = (text("NATS_USER"), text("NATS_PASSWORD")) {
            options = options.user_and_password(user, password);
        }
        let options = options
            .name("gleaner-cloud")
            .no_echo()
            .retry_on_initial_connect()
            .max_reconnects(None)
            .reconnect_delay_callback(|attempts| {
                let pause = Duration::from_millis(50 * u64::try_from(attempts).unwrap_or(0));
                pause.min(RECONNECT_MAX)
            })
            .event_callback(async |event| match event {
                Event::Connected => tracing::info!("connected to the bus"),
                Event::Disconnected => tracing::warn!("the bus is lost: changes arrive later"),
                other => tracing::debug!(%other, "an event of the bus"),
            });
        let client = options.connect(self.0).await.map_err(|error| failed(&error))?;
        let subject = format!("gleaner.{cloud}.hints");
        let hints = client.subscribe(subject.clone()).await.map_err(|error| failed(&error))?;
        let received = Arc::new(ReceivedHints::default());
        let (queue, waiting) = mpsc::channel(QUEUE);
        tasks.spawn(publish(client, subject, waiting));
        tasks.spawn(receive(hints, Arc::clone(&received)));
        Ok((Bus { queue: Some(queue), dropped: AtomicU64::new(0) }, received))
    }
}

impl Bus {
    #[cfg(test)]
    pub(crate) fn of_queue(queue: mpsc::Sender<Hint>) -> Self {
        Self { queue: Some(queue), dropped: AtomicU64::new(0) }
    }

    /// Sends a hint about vehicles.
    pub(crate) fn changed(&self, names: &[String]) {
        for names in names.chunks(NAMES_MAX) {
            self.send(|| Hint::Vehicles(names.to_vec()));
        }
    }

    /// Sends a hint about records.
    pub(crate) fn arrived(&self, name: &str) {
        self.send(|| Hint::Records(name.to_owned()));
    }

    /// Sends a hint about leases of streams.
    pub(crate) fn tails_changed(&self) {
        self.send(|| Hint::Tails);
    }

    fn send(&self, hint: impl FnOnce() -> Hint) {
        let Some(queue) = &self.queue else { return };
        if queue.try_send(hint()).is_err() {
            let dropped = self.dropped.fetch_add(1, Ordering::Relaxed) + 1;
            if dropped.is_power_of_two() {
                tracing::warn!(dropped, "hints were dropped: the bus is slow or down");
            }
        }
    }
}

async fn publish(client: Client, subject: String, mut waiting: mpsc::Receiver<Hint>) {
    while let Some(hint) = waiting.recv().await {
        let payload = serde_json::to_vec(&hint).unwrap_or_default();
        if let Err(error) = client.publish(subject.clone(), payload.into()).await {
            tracing::debug!(%error, "a hint was not sent");
        }
    }
}

async fn receive(mut hints: Subscriber, received: Arc<ReceivedHints>) {
    while let Some(message) = hints.next().await {
        received.add(&message.payload);
    }
}

impl ReceivedHints {
    /// Adds a message, if it is a hint.
    fn add(&self, payload: &[u8]) {
        let hint = match payload.len() <= HINT_MAX {
            true => serde_json::from_slice::<Hint>(payload).ok(),
            false => None,
        };
        let is_added = hint.is_some_and(|hint| {
            let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
            let HintedChanges { changed, with_records, has_tails } = &mut *waiting;
            let (set, names) = match hint {
                Hint::Vehicles(names) => (changed, names),
                Hint::Records(name) => (with_records, vec![name]),
                Hint::Tails => {
                    *has_tails = true;
                    return true;
                }
            };
            let is_fit = names.iter().all(|name| name.len() <= NAME_MAX)
                && set.len() + names.len() <= WAITING_MAX;
            if is_fit {
                set.extend(names);
            }
            is_fit
        });
        if is_added {
            self.notify.notify_one();
            return;
        }
        let ignored = self.ignored.fetch_add(1, Ordering::Relaxed) + 1;
        if ignored.is_power_of_two() {
            tracing::warn!(ignored, "messages of the bus were ignored: they are no hints");
        }
    }

    /// Waits for hints, and takes all that were received.
    pub(crate) async fn next(&self) -> HintedChanges {
        loop {
            self.notify.notified().await;
            let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
            let taken = std::mem::take(&mut *waiting);
            if taken != HintedChanges::default() {
                return taken;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_with_a_password_is_refused() {
        for (url, reason) in [
            ("http://bus:4222", "no address of a NATS server"),
            ("bus", "no address of a NATS server"),
            ("nats://", "no address of a NATS server"),
            ("nats://ann:secret@bus:4222", "has a user or a password"),
        ] {
            let refused = BusAddress::parse(url).unwrap_err();
            assert!(refused.message.contains(reason), "{url}: {refused}");
            assert!(!refused.to_string().contains("secret"));
        }
        assert!(BusAddress::parse("nats://bus:4222").is_ok());
        assert!(BusAddress::parse("tls://bus").is_ok());
    }

    #[tokio::test]
    async fn what_is_no_hint_is_counted_and_ignored() {
        let received = ReceivedHints::default();
        let long = format!("{{\"records\":\"{}\"}}", "x".repeat(NAME_MAX + 1));
        let huge = format!("{{\"records\":\"{}\"}}", "x".repeat(HINT_MAX));
        let wrong = ["", "x", "{}", "{\"users\":[]}", "{\"vehicles\":[1]}", &long, &huge];
        for payload in wrong {
            received.add(payload.as_bytes());
        }
        received.add(&[0xff; 10]);
        assert_eq!(received.ignored.load(Ordering::Relaxed), wrong.len() as u64 + 1);
        received.add(br#"{"vehicles":["car-7","car-8"]}"#);
        received.add(br#"{"records":"car-7"}"#);
        received.add(br#""tails""#);
        let taken = received.next().await;
        assert_eq!(taken.changed.into_iter().collect::<Vec<_>>(), ["car-7", "car-8"]);
        assert_eq!(taken.with_records.into_iter().collect::<Vec<_>>(), ["car-7"]);
        assert!(taken.has_tails);
    }

    #[tokio::test]
    async fn hints_that_nothing_sends_are_dropped() {
        let (queue, _waiting) = mpsc::channel(1);
        let bus = Bus::of_queue(queue);
        let names: Vec<_> = (0..3 * NAMES_MAX).map(|it| it.to_string()).collect();
        bus.changed(&names);
        assert_eq!(bus.dropped.load(Ordering::Relaxed), 2, "of three messages, one has room");
    }
}

//! The connection to NATS, by which hints travel.

use std::sync::Arc;
use std::time::Duration;

use async_nats::{Client, ConnectOptions, Event, ServerAddr, Subscriber};
use futures_util::StreamExt;
use gleaner_base::{Exit, Failure};
use tokio::sync::mpsc;
use tokio::task::JoinSet;

use crate::bus::{Bus, Hint, ReceivedHints};

/// Maximum number of hints that wait to be sent.
const QUEUE: usize = 1024;
/// Longest pause between two attempts to connect.
const RECONNECT_MAX: Duration = Duration::from_secs(2);

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
        let address =
            address.ok_or_else(|| refused("--bus is not the address of a NATS server"))?;
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
                Event::Disconnected => tracing::warn!("lost the bus; changes arrive with a delay"),
                other => tracing::debug!(%other, "bus client event"),
            });
        let client = options.connect(self.0).await.map_err(|error| failed(&error))?;
        let subject = format!("gleaner.{cloud}.hints");
        let hints = client.subscribe(subject.clone()).await.map_err(|error| failed(&error))?;
        let received = Arc::new(ReceivedHints::default());
        let (queue, waiting) = mpsc::channel(QUEUE);
        tasks.spawn(publish(client, subject, waiting));
        tasks.spawn(receive(hints, Arc::clone(&received)));
        Ok((Bus::of_queue(queue), received))
    }
}

async fn publish(client: Client, subject: String, mut waiting: mpsc::Receiver<Hint>) {
    while let Some(hint) = waiting.recv().await {
        let payload = serde_json::to_vec(&hint).unwrap_or_default();
        if let Err(error) = client.publish(subject.clone(), payload.into()).await {
            tracing::debug!(%error, "could not publish a change to the bus");
        }
    }
}

async fn receive(mut hints: Subscriber, received: Arc<ReceivedHints>) {
    while let Some(message) = hints.next().await {
        received.add(&message.payload);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_with_a_password_is_refused() {
        for (url, reason) in [
            ("http://bus:4222", "not the address of a NATS server"),
            ("bus", "not the address of a NATS server"),
            ("nats://", "not the address of a NATS server"),
            ("nats://ann:secret@bus:4222", "has a user or a password"),
        ] {
            let refused = BusAddress::parse(url).unwrap_err();
            assert!(refused.message.contains(reason), "{url}: {refused}");
            assert!(!refused.to_string().contains("secret"));
        }
        assert!(BusAddress::parse("nats://bus:4222").is_ok());
        assert!(BusAddress::parse("tls://bus").is_ok());
    }
}

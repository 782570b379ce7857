//! Keeps a connection to the cloud while the vehicle is enrolled.

use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, visible};
use gleaner_protocol::supervision::EventKind;
use tokio::sync::watch;
use tokio::time::timeout;

use super::LinkState;
use super::http::CloudHttp;
use super::reconcile::{Handled, Reconciler};
use super::session::{CloudSession, SessionEnd};
use super::settings::{CloudSettings, tls};
use crate::api::Api;

/// Longest pause before the first further attempt; it doubles up to the maximum. Each is a random
/// part of it, so that the vehicles of a fleet do not come together.
const PAUSE: Duration = Duration::from_secs(1);
const PAUSE_MAX: Duration = Duration::from_secs(300);
/// Time after which a connection counts as one that stays.
const STAYS: Duration = Duration::from_secs(30);
/// Interval of attempts to get the next certificate.
const RENEWAL_INTERVAL: Duration = Duration::from_secs(3600);
/// Longest life of a connection, in s: the time to the renewal is measured again with the next one.
const RENEWAL_MAX_S: u64 = 30 * 86_400;

pub(crate) struct CloudLink {
    pub(crate) api: Api,
}

impl CloudLink {
    /// Keeps the connection, for as long as the program runs.
    pub(crate) async fn keep(self) {
        let (orders, received) = watch::channel(None);
        let (handled, results) = watch::channel(Handled::default());
        let core = Arc::clone(&self.api.core);
        tokio::spawn(Reconciler { core, orders: received, handled, step: Arc::default() }.run());
        let mut settings = self.api.cloud.settings.subscribe();
        let (mut pause, mut renewed_at) = (PAUSE, None);
        loop {
            let current = settings.borrow_and_update().clone();
            let Some(current) = current else {
                orders.send_replace(None);
                pause = PAUSE;
                if settings.changed().await.is_err() {
                    return;
                }
                continue;
            };
            let started = Instant::now();
            let connected = async {
                let http = self.http(&current)?;
                self.renew_if_due(&http, &current, &mut renewed_at).await;
                let until = self.renewal(&current, renewed_at);
                let (api, handled) = (&self.api, results.clone());
                let session = CloudSession { api, http: &http, orders: &orders, handled, until };
                session.run(settings.clone()).await
            };
            let mut others = settings.clone();
            // Another enrolment does not wait for a cloud that does not answer.
            let ended = tokio::select! {
                ended = connected => ended,
                _ = others.changed() => Ok(SessionEnd::Changed),
            };
            self.api.cloud.has_ended();
            if started.elapsed() >= STAYS {
                pause = PAUSE;
            }
            let wait = match ended {
                Ok(SessionEnd::Changed) => continue,
                Ok(SessionEnd::Away(after, reason)) => {
                    self.api.cloud.set_state(LinkState::Connecting, Some(reason), None);
                    after + part_of(PAUSE)
                }
                Err(_) if settings.has_changed().unwrap_or(false) => continue,
                Err(failure) => {
                    self.note(&failure);
                    let wait = part_of(pause);
                    pause = (pause * 2).min(PAUSE_MAX);
                    wait
                }
            };
            // Another enrolment is used at once.
            let _ = timeout(wait, settings.changed()).await;
        }
    }

    fn http(&self, settings: &CloudSettings) -> Result<CloudHttp, Failure> {
        let identity = Some((&*settings.certificate, &*settings.key));
        let tls = tls(&self.api.core, &settings.authority, identity)?;
        Ok(CloudHttp::new(settings.address.clone(), tls))
    }

    /// Returns the time of the next attempt to get another certificate.
    fn renewal(&self, settings: &CloudSettings, last: Option<Instant>) -> Instant {
        let due_s = settings.renew.saturating_sub(self.api.core.trust(|trust| trust.now()));
        let due = Instant::now() + Duration::from_secs(due_s.min(RENEWAL_MAX_S));
        last.map_or(due, |last| due.max(last + RENEWAL_INTERVAL))
    }

    /// Gets the next certificate, if it is time. The current one is used until it ends.
    async fn renew_if_due(
        &self,
        http: &CloudHttp,
        settings: &CloudSettings,
        at: &mut Option<Instant>,
    ) {
        let is_due = self.api.core.trust(|trust| trust.now()) >= settings.renew;
        if !is_due || at.is_some_and(|at: Instant| at.elapsed() < RENEWAL_INTERVAL) {
            return;
        }
        *at = Some(Instant::now());
        let Api { core, cloud, name, .. } = &self.api;
        let renewed = cloud.renew(core, name, (http, settings)).await;
        if let Err(failure) = renewed {
            let text =
                format!("the certificate for the cloud is not renewed: {}", in_words(&failure));
            self.api.core.event(EventKind::Warning, None, &text);
        }
    }

    /// Notes the end of a connection; a refusal makes an event.
    fn note(&self, failure: &Failure) {
        let state = match failure.exit {
            Exit::Denied => LinkState::Refused,
            _ => LinkState::Connecting,
        };
        let reason = in_words(failure);
        if state == LinkState::Refused && self.api.cloud.lock().state != LinkState::Refused {
            self.api.core.event(EventKind::Warning, None, &reason);
        }
        self.api.cloud.set_state(state, Some(reason), failure.help.clone());
    }
}

/// Returns the failed action and its causes in one line.
fn in_words(failure: &Failure) -> String {
    let parts = std::iter::once(&failure.message).chain(&failure.causes);
    parts.map(|part| visible(part)).collect::<Vec<_>>().join(": ")
}

/// Returns a random part of a pause.
fn part_of(pause: Duration) -> Duration {
    use std::hash::{BuildHasher, Hasher, RandomState};
    let random = RandomState::new().build_hasher().finish();
    pause.mul_f64(random as f64 / u64::MAX as f64)
}

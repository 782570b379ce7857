//! Keeps a connection to the cloud while the vehicle is enrolled.
//!
//! A vehicle on a poor link uses the seconds in which it has one: after a connection over which
//! something was acknowledged, the first attempts come within a second each. The vehicles of a
//! fleet do not come together to a cloud that was away: each pause is a random part of one that
//! doubles.

use std::sync::Arc;
use std::time::{Duration, Instant};

use gleaner_base::text::describe;
use gleaner_base::{Exit, Failure};
use tokio::sync::watch;
use tokio::time::{interval, sleep};

use super::http::CloudHttp;
use super::network::{others_than, sources};
use super::reconcile::{Handled, Reconciler};
use super::session::{CloudSession, SessionEnd};
use super::settings::{CloudSettings, tls};
use super::{Cloud, LinkState};
use crate::orchestrator::Orchestrator;
use crate::spools::{self, SpoolFolders};

/// Longest pause before each of the first attempts; then it doubles up to the maximum.
const PAUSE: Duration = Duration::from_secs(1);
const PAUSE_MAX: Duration = Duration::from_secs(300);
/// Number of the first attempts: in their time, a link that is away for two seconds is back.
const FIRST: u32 = 5;
/// Longest time to reach the cloud at the first attempt; it doubles up to the usual one. The
/// handshake may take longer: a cloud that was away has many to do.
const DIALING: Duration = Duration::from_secs(2);
/// Attempts that count after a connection without progress: the next one comes within 8 s, which is
/// about as often as the cloud lets a vehicle connect for ever.
const AFTER_LOST: u32 = FIRST + 2;
/// Time after which another way to the network brings the next attempt forward.
const EARLY: Duration = Duration::from_secs(10);
/// Interval of counts of the records that wait.
const COUNT_INTERVAL: Duration = Duration::from_secs(2);
const RENEWAL_INTERVAL: Duration = Duration::from_secs(3600);
/// Longest life of a connection, in s: the time to the renewal is measured again with the next one.
const RENEWAL_MAX_S: u64 = 30 * 86_400;

/// Counts an attempt, before which `most` others count at most; returns the longest pause after it.
fn pause(attempts: &mut u32, most: u32, is_refused: bool) -> Duration {
    let before = (*attempts).min(most).max(if is_refused { FIRST } else { 0 });
    *attempts = before.saturating_add(1);
    let doublings = before.saturating_sub(FIRST - 1).min(16);
    (PAUSE * 2_u32.pow(doublings)).min(PAUSE_MAX)
}

#[derive(Clone)]
pub(crate) struct CloudLink {
    pub(crate) core: Arc<Orchestrator>,
    pub(crate) cloud: Cloud,
}

impl CloudLink {
    /// Keeps the connection, for as long as the program runs.
    pub(crate) async fn keep(self) {
        let (orders, received) = watch::channel(None);
        let (handled, results) = watch::channel(Handled::default());
        let core = Arc::clone(&self.core);
        tokio::spawn(Reconciler { core, orders: received, handled, step: Arc::default() }.run());
        let spools = SpoolFolders(self.core.layout.spool());
        tokio::spawn(keep_counted(self.cloud.clone(), spools));
        let mut settings = self.cloud.settings.subscribe();
        let (mut attempts, mut renewed_at) = (0, None);
        loop {
            let current = settings.borrow_and_update().clone();
            let Some(current) = current else {
                orders.send_replace(None);
                attempts = 0;
                if settings.changed().await.is_err() {
                    return;
                }
                continue;
            };
            let (before, mut has_progress) = (sources(), false);
            let connected = async {
                let http = self.http(&current)?;
                self.renew_if_due(&http, &current, &mut renewed_at).await;
                let session = CloudSession {
                    core: &self.core,
                    cloud: &self.cloud,
                    http: &http,
                    orders: &orders,
                    handled: results.clone(),
                    until: self.renewal(&current, renewed_at),
                    dialing: DIALING * 2_u32.pow(attempts.min(4)),
                    has_progress: &mut has_progress,
                };
                session.run(settings.clone()).await
            };
            let mut others = settings.clone();
            // Another enrolment does not wait for a cloud that does not answer.
            let ended = tokio::select! {
                ended = connected => ended,
                _ = others.changed() => Ok(SessionEnd::Changed),
            };
            let was_connected = self.cloud.has_ended();
            let is_changed = settings.has_changed().unwrap_or(false);
            let Some((after, is_refused)) = self.note(ended, is_changed) else { continue };
            let most = match (has_progress, was_connected && !is_refused) {
                (true, _) => 0,
                (false, true) => AFTER_LOST,
                (false, false) => u32::MAX,
            };
            let pause = pause(&mut attempts, most, is_refused);
            let early = async {
                sleep(after + EARLY).await;
                others_than(before).await;
            };
            // Another enrolment is used at once.
            tokio::select! {
                () = sleep(after + part_of(pause)) => {}
                () = early => {}
                _ = settings.changed() => {}
            }
        }
    }

    pub(super) fn http(&self, settings: &CloudSettings) -> Result<CloudHttp, Failure> {
        let identity = Some((&*settings.certificate, &*settings.key));
        let tls = tls(&self.core, &settings.authority, identity)?;
        let mut http = CloudHttp::new(settings.address.clone(), tls);
        http.wait = Arc::clone(&self.cloud.wait);
        Ok(http)
    }

    /// Returns the time of the next attempt to get another certificate.
    fn renewal(&self, settings: &CloudSettings, last: Option<Instant>) -> Instant {
        let due_s = settings.renew.saturating_sub(self.core.trust(|trust| trust.now()));
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
        let is_due = self.core.trust(|trust| trust.now()) >= settings.renew;
        if !is_due || at.is_some_and(|at: Instant| at.elapsed() < RENEWAL_INTERVAL) {
            return;
        }
        *at = Some(Instant::now());
        if let Err(failure) = self.cloud.renew(&self.core, http, settings).await {
            self.core.warn(&format!(
                "the certificate for the cloud is not renewed: {}",
                describe(&failure.message, &failure.causes)
            ));
        }
    }

    /// Notes the end of a connection; a refusal makes an event. Returns the shortest pause after
    /// it, and whether the cloud has refused the vehicle or sent it away; `None` if the enrolment
    /// has changed, and is used at once.
    fn note(
        &self,
        ended: Result<SessionEnd, Failure>,
        is_changed: bool,
    ) -> Option<(Duration, bool)> {
        let failure = match ended {
            Ok(SessionEnd::Changed) => return None,
            Ok(SessionEnd::Away(after, reason)) => {
                self.cloud.set_state(LinkState::Connecting, Some(reason), None);
                return Some((after, true));
            }
            Err(_) if is_changed => return None,
            Err(failure) => failure,
        };
        let is_refused = failure.exit == Exit::Denied;
        let state = if is_refused { LinkState::Refused } else { LinkState::Connecting };
        let reason = describe(&failure.message, &failure.causes);
        if is_refused && self.cloud.lock().state != LinkState::Refused {
            self.core.warn(&reason);
        }
        self.cloud.set_state(state, Some(reason), failure.help);
        Some((Duration::ZERO, is_refused))
    }
}

/// Counts the records that wait in the spools, also while there is no connection.
async fn keep_counted(cloud: Cloud, spools: SpoolFolders) {
    let mut counts = interval(COUNT_INTERVAL);
    loop {
        counts.tick().await;
        let spools = spools.clone();
        let counted = tokio::task::spawn_blocking(move || spools::count(&spools)).await;
        if let Ok(counted) = counted {
            cloud.lock().counts = counted;
        }
    }
}

/// Returns a random part of a pause.
fn part_of(pause: Duration) -> Duration {
    use std::hash::{BuildHasher, Hasher, RandomState};
    let random = RandomState::new().build_hasher().finish();
    pause.mul_f64(random as f64 / u64::MAX as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn pauses_double_until_something_is_acknowledged_and_at_once_after_a_refusal() {
        let mut attempts = 0;
        let mut after = |most, is_refused| pause(&mut attempts, most, is_refused).as_secs();
        let pauses = [(); 8].map(|()| after(u32::MAX, false));
        assert_eq!(pauses, [1, 1, 1, 1, 1, 2, 4, 8]);
        assert_eq!((0..9).map(|_| after(u32::MAX, false)).max(), Some(300));
        assert_eq!([after(AFTER_LOST, false), after(AFTER_LOST, false)], [8, 8]);
        assert_eq!([after(0, false), after(0, true), after(u32::MAX, true)], [1, 2, 4]);
    }
}

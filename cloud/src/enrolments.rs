//! Vehicles are enrolled, get their certificates, and are revoked.

use std::sync::Arc;
use std::time::Duration;

use gleaner_fleet::{EnrolReply, EnrolRequest, Enrolment};
use rustls::ServerConfig;
use tokio::sync::watch;

use crate::authority::Authorities;
use crate::error::CloudResult;
use crate::hub::Hub;
use crate::store::{ChangeAuthor, CloudStore, Issued, now};
use crate::ticks::ticks;

/// Time after which the server's certificate is made again, in s, and the interval of looks: a
/// clock that was set by more has made one with a wrong end.
const CERTIFICATE_S: i64 = 30 * 86_400;
const CERTIFICATE_LOOKS: Duration = Duration::from_secs(60);

pub(crate) struct Enrolments {
    store: Arc<CloudStore>,
    hub: Arc<Hub>,
    authorities: Authorities,
    /// Address for vehicles, as enrolments state it.
    address: String,
}

impl Enrolments {
    pub(crate) fn new(store: &Arc<CloudStore>, hub: &Arc<Hub>, own: (Authorities, String)) -> Self {
        let (store, hub) = (Arc::clone(store), Arc::clone(hub));
        Self { store, hub, authorities: own.0, address: own.1 }
    }

    /// Invites a vehicle; returns the content of its file.
    pub(crate) async fn invite(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        name: &str,
    ) -> CloudResult<Enrolment> {
        let token = self.store.invite_vehicle(author, name).await?;
        Ok(Enrolment {
            gleaner_enrolment: 1,
            address: self.address.clone(),
            vehicle: name.to_owned(),
            authority: self.authorities.server_pem().to_owned(),
            token,
        })
    }

    /// Returns the first certificate of a vehicle; `None` if the enrolment is not valid.
    pub(crate) async fn enrol(&self, request: &EnrolRequest) -> CloudResult<Option<EnrolReply>> {
        let EnrolRequest { vehicle, token, csr } = request;
        let issue = || self.authorities.issue(vehicle, csr);
        Ok(self.store.enrol(vehicle, token, issue).await?.map(reply))
    }

    /// Returns the certificate of a vehicle that comes after the one with this SHA-256.
    pub(crate) async fn renew(
        &self,
        (vehicle, certificate): (&str, &str),
        csr: &str,
    ) -> CloudResult<EnrolReply> {
        let issued = self.authorities.issue(vehicle, csr)?;
        self.store.renew(vehicle, certificate, &issued).await?;
        Ok(reply(issued))
    }

    /// Lets a vehicle follow this cloud although it has followed a newer state.
    pub(crate) async fn agree(&self, actor: &str, name: &str) -> CloudResult<()> {
        self.store.agree(actor, name).await?;
        self.hub.wake(&[name.to_owned()]);
        Ok(())
    }

    pub(crate) async fn revoke(&self, actor: &str, name: &str) -> CloudResult<()> {
        self.store.revoke(actor, name).await?;
        self.hub.end(name, "the vehicle was revoked");
        Ok(())
    }

    /// Makes the server's certificate again and again, for as long as this process runs.
    pub(crate) async fn renew_own(&self, host: &str, tls: &watch::Sender<Arc<ServerConfig>>) {
        let (mut ticks, mut made) = (ticks(CERTIFICATE_LOOKS), now());
        loop {
            ticks.tick().await;
            if (now() - made).abs() < CERTIFICATE_S {
                continue;
            }
            made = now();
            match self.authorities.server_config(host) {
                Ok(config) => drop(tls.send_replace(config)),
                Err(failure) => tracing::error!("{failure}"),
            }
        }
    }
}

fn reply(Issued { certificate, renew, expires, .. }: Issued) -> EnrolReply {
    EnrolReply { certificate, renew, expires }
}

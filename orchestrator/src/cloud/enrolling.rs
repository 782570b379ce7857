//! Certificates of the vehicle: the first one, by the secret of an enrolment, and later ones.

use std::sync::Arc;

use gleaner_base::{Exit, Failure};
use gleaner_fleet::{CERTIFICATE_NAME, EnrolReply, EnrolRequest, Enrolment, RenewRequest};
use rcgen::string::Ia5String;
use rcgen::{CertificateParams, KeyPair, SanType};

use super::Cloud;
use super::http::CloudHttp;
use super::settings::{CloudSettings, tls};
use crate::orchestrator::Orchestrator;

impl Cloud {
    /// Enrols the vehicle: makes a key, and gets the certificate for it. `text` is the enrolment.
    /// After a failure, an earlier one stays.
    pub(crate) async fn enrol(&self, core: &Arc<Orchestrator>, text: &[u8]) -> Result<(), Failure> {
        let enrolment = Enrolment::parse(text).map_err(|error| {
            Failure::caused_by(Exit::Usage, "cannot enrol this vehicle", &error)
                .with_help("`gleaner vehicles enrol NAME --to FILE` writes one")
        })?;
        let own = core.name.to_string();
        if enrolment.vehicle != own {
            let other = gleaner_base::excerpt(&enrolment.vehicle);
            let message =
                format!("the enrolment is for vehicle `{other}`, and this one is `{own}`");
            let help = format!("make one for `{own}`, or change `name` in vehicle.toml");
            return Err(Failure::new(Exit::Usage, message).with_help(help));
        }
        let tls = tls(core, &enrolment.authority, None)?;
        let http = CloudHttp::new(enrolment.address.clone(), tls);
        let (key, csr) = request(&own)?;
        let body = EnrolRequest { vehicle: own, token: enrolment.token, csr };
        let reply: EnrolReply = http.post("/v1/enrol", &body).await?;
        let settings = CloudSettings {
            address: enrolment.address,
            authority: enrolment.authority,
            certificate: reply.certificate,
            key,
            renew: reply.renew,
            expires: reply.expires,
        };
        self.accept(core, settings)
    }

    /// Gets the next certificate, with a new key. After a failure, the current one stays.
    pub(super) async fn renew(
        &self,
        core: &Arc<Orchestrator>,
        http: &CloudHttp,
        settings: &CloudSettings,
    ) -> Result<(), Failure> {
        let (key, csr) = request(&core.name.to_string())?;
        let reply: EnrolReply = http.post("/v1/renew", &RenewRequest { csr }).await?;
        let (EnrolReply { certificate, renew, expires }, settings) = (reply, settings.clone());
        self.accept(core, CloudSettings { certificate, key, renew, expires, ..settings })
    }

    /// Makes new settings count, if they can be used.
    fn accept(&self, core: &Arc<Orchestrator>, settings: CloudSettings) -> Result<(), Failure> {
        tls(core, &settings.authority, Some((&settings.certificate, &settings.key)))?;
        self.set(settings)
    }
}

/// Makes a key; returns it and the request for its certificate, both as PEM.
fn request(name: &str) -> Result<(String, String), Failure> {
    let failed = |error: rcgen::Error| {
        Failure::caused_by(Exit::Internal, "cannot make a key for the cloud", &error)
    };
    let key = KeyPair::generate().map_err(failed)?;
    let name = Ia5String::try_from(format!("{CERTIFICATE_NAME}{name}")).map_err(failed)?;
    let mut params = CertificateParams::default();
    params.subject_alt_names = vec![SanType::URI(name)];
    let csr = params.serialize_request(&key).and_then(|csr| csr.pem()).map_err(failed)?;
    Ok((key.serialize_pem(), csr))
}

//! Messages by which a vehicle gets its certificate.

use serde::{Deserialize, Serialize};

/// Start of the name in the certificate of a vehicle; the name of the vehicle follows.
pub const CERTIFICATE_NAME: &str = "spiffe://gleaner/vehicle/";

/// Longest file with an enrolment.
const ENROLMENT_MAX: usize = 64 << 10;

/// The means to connect for the first time: the content of the file that
/// `gleaner vehicles enrol` writes. It is a secret until it was used.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Enrolment {
    /// Version of this format: 1.
    pub gleaner_enrolment: u32,
    /// Address of the cloud for vehicles: `HOST:PORT`.
    pub address: String,
    /// Name of the vehicle.
    pub vehicle: String,
    /// The certificate of the authority that signed the cloud's, as PEM.
    pub authority: String,
    /// The secret, which works once.
    pub token: String,
}

/// An enrolment that cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("not an enrolment: {reason}")]
pub struct EnrolmentError {
    reason: String,
}

impl Enrolment {
    /// Parses the content of a file.
    ///
    /// # Errors
    ///
    /// [`EnrolmentError`] if it is none, or of another version.
    pub fn parse(text: &[u8]) -> Result<Self, EnrolmentError> {
        let refused = |reason: String| EnrolmentError { reason };
        if text.len() > ENROLMENT_MAX {
            return Err(refused(format!("it has more than {ENROLMENT_MAX} bytes")));
        }
        let parsed: Self =
            serde_json::from_slice(text).map_err(|error| refused(error.to_string()))?;
        match parsed.gleaner_enrolment {
            1 => Ok(parsed),
            other => Err(refused(format!("it has version {other} of the format, not 1"))),
        }
    }
}

/// A request for the first certificate: `POST /v1/enrol` at the address for vehicles.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct EnrolRequest {
    /// Name of the vehicle.
    pub vehicle: String,
    /// The secret of the enrolment.
    pub token: String,
    /// The request for a certificate, as PEM.
    pub csr: String,
}

/// A request for the next certificate: `POST /v1/renew`, with the current one.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RenewRequest {
    /// The request for a certificate, as PEM.
    pub csr: String,
}

/// The answer to both requests.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct EnrolReply {
    /// The certificate, as PEM.
    pub certificate: String,
    /// Time from which the vehicle should request the next one, in s since 1970.
    pub renew: u64,
    /// End of the certificate, in s since 1970.
    pub expires: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_enrolment_is_parsed_and_others_are_refused_with_the_reason() {
        let enrolment = Enrolment {
            gleaner_enrolment: 1,
            address: "127.0.0.1:8443".to_owned(),
            vehicle: "car-7".to_owned(),
            authority: "PEM".to_owned(),
            token: "secret".to_owned(),
        };
        let text = serde_json::to_vec(&enrolment).unwrap();
        assert_eq!(Enrolment::parse(&text), Ok(enrolment.clone()));
        let later = Enrolment { gleaner_enrolment: 2, ..enrolment };
        let refused = Enrolment::parse(&serde_json::to_vec(&later).unwrap()).unwrap_err();
        assert!(refused.to_string().ends_with("version 2 of the format, not 1"), "{refused}");
        assert!(Enrolment::parse(b"{}").is_err());
        assert!(Enrolment::parse(&vec![b' '; ENROLMENT_MAX + 1]).is_err());
    }
}

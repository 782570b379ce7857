//! Checks of a vehicle: pure functions over bytes, a trust root, floors, labels and a time.

use std::collections::BTreeSet;

use gleaner_lambda::manifest::{LambdaName, Sha256};

use crate::envelope::Unverified;
use crate::{Deployment, Floors, Labels, Payload, PublicKey, Refusal, Revision, RootKeys};
use crate::{ScopedKey, TrustRoot};

/// A payload with a valid signature of a key that counts on this vehicle.
#[derive(Debug, Clone, PartialEq)]
pub struct Trusted<P> {
    payload: P,
    digest: Sha256,
    signers: BTreeSet<Sha256>,
}

impl<P> Trusted<P> {
    pub fn payload(&self) -> &P {
        &self.payload
    }

    /// Returns its digest, by which deployments name revisions.
    pub fn digest(&self) -> &Sha256 {
        &self.digest
    }

    /// Returns the ids of the trusted keys that signed it.
    pub fn signers(&self) -> impl Iterator<Item = &Sha256> {
        self.signers.iter()
    }
}

/// The result of checking a deployment that is not refused.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Verdict {
    /// It may run.
    Current,
    /// It was accepted before and may run, but it or the trust root has expired: its deployer
    /// should sign it again. It may also start again: whether it still ran is not part of the
    /// floors.
    Stale(Refusal),
}

/// The state of a vehicle by which it accepts signed data.
#[derive(Debug, Clone, Copy)]
pub struct Verifier<'a> {
    pub root: &'a TrustRoot,
    /// Releases that were accepted before.
    pub floors: &'a Floors,
    /// Labels from the vehicle's own configuration.
    pub labels: &'a Labels,
    /// The time by [`Floors::now`].
    pub now: u64,
    /// Digests of revisions that ran here, or that an accepted deployment has as its fallback: only
    /// these may be the fallback of a new one although a later release was accepted.
    pub known: &'a [Sha256],
}

impl Verifier<'_> {
    /// Verifies the revision in `envelope`: its signature and the scope of the signing key.
    ///
    /// # Errors
    ///
    /// The first reason that is found.
    pub fn revision(&self, envelope: &[u8]) -> Result<Trusted<Revision>, Refusal> {
        let verified = verified::<Revision>(envelope, &self.root.publishers)?;
        self.check_scope(&self.root.publishers, &verified, &verified.payload.name)?;
        Ok(verified)
    }

    /// Verifies the deployment in `envelope`: its signature, and that it selects this vehicle. Its
    /// revision is checked by [`admit`](Self::admit).
    ///
    /// # Errors
    ///
    /// The first reason that is found.
    pub fn deployment(&self, envelope: &[u8]) -> Result<Trusted<Deployment>, Refusal> {
        let verified = verified::<Deployment>(envelope, &self.root.deployers)?;
        if let Some((label, wanted, found)) = self.lacking(&verified.payload.selector) {
            return Err(Refusal::NotSelected { label, wanted, found });
        }
        Ok(verified)
    }

    /// Decides whether `deployment` may run with `revision` and `fallback`.
    ///
    /// The newest accepted deployment of an id stays accepted: neither expiry nor releases of other
    /// deployments stop it. The current trust root must still cover it, its revision and its
    /// fallback with the keys that signed them.
    ///
    /// # Errors
    ///
    /// The first reason that is found.
    pub fn admit(
        &self,
        deployment: &Trusted<Deployment>,
        revision: &Trusted<Revision>,
        fallback: Option<&Trusted<Revision>>,
    ) -> Result<Verdict, Refusal> {
        let wish = &deployment.payload;
        let roles = [
            ("revision", Some(&wish.revision), Some(revision)),
            ("fallback", wish.fallback.as_ref(), fallback),
        ];
        for (role, wanted, found) in roles {
            let found = found.map(|found| found.digest.clone());
            if wanted != found.as_ref() {
                let wanted = wanted.map_or("nothing", Sha256::as_str).to_owned();
                return Err(Refusal::OtherRevision { role, wanted, found });
            }
        }
        let name = &revision.payload.name;
        if let Some(other) = fallback.filter(|other| other.payload.name != *name) {
            let fallback = other.payload.name.clone();
            return Err(Refusal::OtherLambda { revision: name.clone(), fallback });
        }
        let release = revision.payload.release;
        if let Some(other) = fallback.filter(|other| other.digest != revision.digest)
            && other.payload.release >= release
        {
            let fallback = other.payload.release;
            return Err(Refusal::NewerFallback { fallback, revision: release });
        }
        // Again: the root may have changed since the signatures were checked.
        for revision in [Some(revision), fallback].into_iter().flatten() {
            self.check_scope(&self.root.publishers, revision, name)?;
        }
        self.check_scope(&self.root.deployers, deployment, name)?;
        self.check_id(deployment)?;
        let expired = self.expiry(wish);
        if self.floors.has_accepted(deployment) {
            return Ok(expired.map_or(Verdict::Current, Verdict::Stale));
        }
        self.floors.check_new(deployment, revision)?;
        if let Some(fallback) = fallback {
            self.floors.check_fallback(fallback, self.known.contains(&fallback.digest))?;
        }
        expired.map_or(Ok(Verdict::Current), Err)
    }

    /// Returns the reason why the deployment would not be accepted as a new one now: it or the
    /// trust root has expired.
    pub fn expiry(&self, deployment: &Deployment) -> Option<Refusal> {
        self.expired(deployment.expires, Deployment::NAME)
            .or_else(|| self.expired(self.root.expires, TrustRoot::NAME))
    }

    fn expired(&self, expires: u64, what: &'static str) -> Option<Refusal> {
        (self.now >= expires).then_some(Refusal::Expired { what, expires, now: self.now })
    }

    /// Returns the first of `wanted` that this vehicle does not have, with the vehicle's value.
    fn lacking(&self, wanted: &Labels) -> Option<(String, String, Option<String>)> {
        let (name, value, found) = wanted
            .iter()
            .map(|(name, value)| (name, value, self.labels.get(name)))
            .find(|(_, value, found)| *found != Some(*value))?;
        Some((name.to_string(), value.clone(), found.cloned()))
    }

    /// Checks that one of the signers may sign `lambda` for this vehicle.
    fn check_scope<P: Payload>(
        &self,
        keys: &[ScopedKey],
        verified: &Trusted<P>,
        lambda: &LambdaName,
    ) -> Result<(), Refusal> {
        let signers = keys.iter().filter(|scoped| verified.signers.contains(&scoped.key.id()));
        let mut refusal = None;
        for scoped in signers {
            match self.scope_refusal(scoped, lambda) {
                None => return Ok(()),
                found => refusal = refusal.or(found),
            }
        }
        // Without a signer, the root has changed since the signature was checked.
        Err(refusal.unwrap_or_else(|| Refusal::UnknownKey {
            what: P::NAME,
            found: verified.signers.iter().map(Sha256::to_string).collect(),
            trusted: keys.len(),
        }))
    }

    /// Checks that one of the signers may sign deployments of this id: otherwise the key of one
    /// lambda could replace the deployment of another, for good.
    fn check_id(&self, deployment: &Trusted<Deployment>) -> Result<(), Refusal> {
        let id = &deployment.payload.id;
        let mut refusal = None;
        for scoped in &self.root.deployers {
            let key = scoped.key.id();
            if !deployment.signers.contains(&key) {
                continue;
            }
            if scoped.lambdas.iter().any(|pattern| pattern.covers(id.as_str())) {
                return Ok(());
            }
            let allowed = allowed(scoped);
            refusal.get_or_insert(Refusal::ScopeId { key, allowed, id: id.clone() });
        }
        // Without a signer, the check of the lambda's name has failed before.
        refusal.map_or(Ok(()), Err)
    }

    fn scope_refusal(&self, scoped: &ScopedKey, lambda: &LambdaName) -> Option<Refusal> {
        let key = scoped.key.id();
        if !scoped.lambdas.iter().any(|pattern| pattern.covers(lambda.as_str())) {
            let allowed = allowed(scoped);
            return Some(Refusal::Scope { key, allowed, lambda: lambda.clone() });
        }
        let (label, wanted, found) = self.lacking(&scoped.labels)?;
        Some(Refusal::ScopeLabel { key, label, wanted, found })
    }
}

fn allowed(scoped: &ScopedKey) -> String {
    let patterns: Vec<_> = scoped.lambdas.iter().map(|it| format!("`{it}`")).collect();
    format!("[{}]", patterns.join(", "))
}

fn verified<P: Payload>(envelope: &[u8], keys: &[ScopedKey]) -> Result<Trusted<P>, Refusal> {
    let envelope = Unverified::<P>::parse(envelope)?;
    let signers = envelope.signers(keys.iter().map(|scoped| &scoped.key))?;
    Ok(Trusted { payload: envelope.payload()?, digest: envelope.digest(), signers })
}

/// Opens the revision in `envelope` that a verified deployment names by `digest`: no signature is
/// checked again, as the digest covers each byte.
///
/// # Errors
///
/// [`Refusal::OtherRevision`], and those of the format.
pub fn revision_of_digest(envelope: &[u8], digest: &Sha256) -> Result<Revision, Refusal> {
    let (revision, found) = unverified_revision(envelope)?;
    if found == *digest {
        return Ok(revision);
    }
    let (wanted, found) = (digest.to_string(), Some(found));
    Err(Refusal::OtherRevision { role: "revision", wanted, found })
}

/// Opens the deployment in `envelope`, which one of `keys` must have signed. This is for those who
/// sign the next one: a vehicle asks for more.
///
/// # Errors
///
/// The first reason that is found.
pub fn deployment_of_keys(envelope: &[u8], keys: &[PublicKey]) -> Result<Deployment, Refusal> {
    let envelope = Unverified::<Deployment>::parse(envelope)?;
    envelope.signers(keys)?;
    envelope.payload()
}

/// Reads the revision in `envelope`, and its digest. No signature is checked: this is for those who
/// send a revision, not for those who run it.
///
/// # Errors
///
/// Those of the format.
pub fn unverified_revision(envelope: &[u8]) -> Result<(Revision, Sha256), Refusal> {
    let envelope = Unverified::<Revision>::parse(envelope)?;
    Ok((envelope.payload()?, envelope.digest()))
}

/// Reads the deployment in `envelope`, as [`unverified_revision`] does a revision.
///
/// # Errors
///
/// Those of the format.
pub fn unverified_deployment(envelope: &[u8]) -> Result<Deployment, Refusal> {
    Unverified::<Deployment>::parse(envelope)?.payload()
}

/// Opens the trust root that is installed on a vehicle: its own keys must have signed it, and it
/// may not be older than one before. The first one is trusted as installed.
///
/// # Errors
///
/// The first reason that is found.
pub fn first_root(envelope: &[u8], floors: &Floors) -> Result<TrustRoot, Refusal> {
    let envelope = Unverified::<TrustRoot>::parse(envelope)?;
    let root = envelope.payload()?;
    check_threshold(&envelope, &root.root, root.version, "its own keys")?;
    floors.check_root(root.version)?;
    Ok(root)
}

/// Opens the trust root that follows `current`: both sets of root keys must have signed it. An
/// expired `current` does not matter, so that a vehicle that was off for long can catch up.
///
/// # Errors
///
/// The first reason that is found.
pub fn next_root(current: &TrustRoot, envelope: &[u8]) -> Result<TrustRoot, Refusal> {
    let envelope = Unverified::<TrustRoot>::parse(envelope)?;
    // The current keys first: the payload is parsed only if they vouch for it.
    let signers = envelope.signers(&current.root.keys)?;
    let root = envelope.payload()?;
    if Some(root.version) != current.version.checked_add(1) {
        return Err(Refusal::Sequence { current: current.version, found: root.version });
    }
    let (valid, needed) = (signers.len(), current.root.threshold);
    if valid < needed {
        let by = "the current keys";
        return Err(Refusal::Threshold { version: root.version, by, valid, needed });
    }
    check_threshold(&envelope, &root.root, root.version, "its own keys")?;
    Ok(root)
}

fn check_threshold(
    envelope: &Unverified<TrustRoot>,
    RootKeys { threshold, keys }: &RootKeys,
    version: u64,
    by: &'static str,
) -> Result<(), Refusal> {
    let valid = match envelope.signers(keys) {
        Err(Refusal::UnknownKey { .. }) => 0,
        signers => signers?.len(),
    };
    match valid < *threshold {
        true => Err(Refusal::Threshold { version, by, valid, needed: *threshold }),
        false => Ok(()),
    }
}

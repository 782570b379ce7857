//! Trust of the vehicle: its trust root, the floors, the time.

use std::fs;
use std::time::{SystemTime, UNIX_EPOCH};

use gleaner_base::{Exit, Failure};
use gleaner_protocol::vehicle_api::TrustStatus;
use gleaner_trust::{
    Deployment, Floors, Labels, Revision, TrustRoot, Trusted, Verifier, first_root, next_root,
};

use crate::durable::DurableFile;
use crate::layout::VehicleFolders;

#[derive(Debug)]
pub(crate) struct VehicleTrust {
    root: Option<TrustRoot>,
    root_file: DurableFile,
    floors: Floors,
    labels: Labels,
    /// Time at which the program was built, in s since 1970.
    built: u64,
}

impl VehicleTrust {
    /// Loads the trust root. Also returns a warning if it, or one of its copies, is damaged: then
    /// nothing runs until it is installed again, or the other copy counts.
    pub(crate) fn load(
        layout: &VehicleFolders,
        labels: Labels,
        floors: Floors,
    ) -> (Self, Option<String>) {
        let root_file = DurableFile::new(layout.trust());
        let mut trust = Self { root: None, root_file, floors, labels, built: built() };
        let opened = trust.root_file.load::<String>().and_then(|loaded| {
            let root = loaded.value.map(|envelope| first_root(envelope.as_bytes(), &trust.floors));
            let root = root.transpose().map_err(|refusal| {
                Failure::because("the installed trust root is refused", &refusal)
            })?;
            Ok((root, loaded.damage))
        });
        match opened {
            Ok((root, damage)) => {
                if let Some(root) = root {
                    // A kill may have come between the file of the root and the floors.
                    trust.floors.accept_root(&root, trust.built);
                    trust.root = Some(root);
                }
                (trust, damage)
            }
            Err(failure) => {
                let failure = failure.with_help("install it again: `gleaner trust install FILE`");
                (trust, Some(failure.to_string()))
            }
        }
    }

    /// Installs a trust root: the first one, or one that the current root's keys have signed. A
    /// refused one changes nothing.
    pub(crate) fn install(&mut self, envelope: &[u8]) -> Result<(), Failure> {
        let root = match &self.root {
            None => first_root(envelope, &self.floors),
            Some(current) => next_root(current, envelope),
        };
        let root =
            root.map_err(|refusal| Failure::because("the trust root is refused", &refusal))?;
        // Signatures cover text only.
        let text = String::from_utf8_lossy(envelope);
        self.root_file.save(&text)?;
        self.floors.accept_root(&root, self.built);
        self.root = Some(root);
        Ok(())
    }

    /// Moves the trusted time to that of the clock, as far as it counts.
    pub(crate) fn observe_time(&mut self) {
        self.floors.observe(clock(), self.built);
    }

    /// Returns the trusted time, in s since 1970.
    pub(crate) fn now(&self) -> u64 {
        self.floors.now(clock(), self.built)
    }

    /// Returns what was accepted, to persist it.
    pub(crate) fn floors(&self) -> &Floors {
        &self.floors
    }

    /// Sets what was accepted, to that of a state that could not be written. The file of the root
    /// is durable, so the root stays accepted.
    pub(crate) fn reset_floors(&mut self, floors: Floors) {
        self.floors = floors;
        if let Some(root) = &self.root {
            self.floors.accept_root(root, self.built);
        }
    }

    /// Returns the checks of this vehicle, now.
    pub(crate) fn verifier(&self) -> Result<Verifier<'_>, Failure> {
        let Some(root) = &self.root else {
            let message = "this vehicle has no trust root, so it accepts no deployment";
            return Err(Failure::new(Exit::Denied, message)
                .with_help("install one: `gleaner trust install FILE`"));
        };
        Ok(Verifier {
            root,
            floors: &self.floors,
            labels: &self.labels,
            now: self.now(),
            known: &[],
        })
    }

    /// Remembers an accepted deployment. A refused one changes nothing.
    pub(crate) fn accept(
        &mut self,
        deployment: &Trusted<Deployment>,
        revision: &Trusted<Revision>,
    ) -> Result<(), Failure> {
        self.floors
            .accept(deployment, revision, self.built)
            .map_err(|refusal| Failure::because("the deployment is refused", &refusal))
    }

    pub(crate) fn labels(&self) -> &Labels {
        &self.labels
    }

    pub(crate) fn status(&self) -> Option<TrustStatus> {
        let root = self.root.as_ref()?;
        let is_expired = self.now() >= root.expires;
        Some(TrustStatus { version: root.version, expires: root.expires, is_expired })
    }
}

/// Returns the time of the clock, in s since 1970.
fn clock() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

/// Returns the time at which this program was built, that of its file: a clock that shows an
/// earlier time is wrong.
fn built() -> u64 {
    let modified = std::env::current_exe().and_then(fs::metadata).and_then(|it| it.modified());
    modified.ok().and_then(|it| it.duration_since(UNIX_EPOCH).ok()).unwrap_or_default().as_secs()
}

//! What the vehicle trusts: its trust root, the floors, the time.

use std::fs;
use std::io;
use std::path::PathBuf;
use std::time::{SystemTime, UNIX_EPOCH};

use gleaner_base::{Exit, Failure, PlainFile, write_atomically};
use gleaner_protocol::vehicle_api::TrustStatus;
use gleaner_trust::{
    Deployment, Floors, Labels, Payload, Revision, TrustRoot, Trusted, Verifier, first_root,
    next_root,
};

use crate::durable::DurableFile;
use crate::layout::Layout;

/// The trust of a vehicle.
#[derive(Debug)]
pub(crate) struct VehicleTrust {
    root: Option<TrustRoot>,
    root_file: PathBuf,
    floors: Floors,
    floors_file: DurableFile,
    labels: Labels,
    /// Time at which the program was built, in s since 1970.
    built: u64,
}

impl VehicleTrust {
    /// Loads trust root and floors. Also returns a warning about a damaged copy.
    ///
    /// # Errors
    ///
    /// A failure if one of them is damaged.
    pub(crate) fn load(layout: &Layout, labels: Labels) -> Result<(Self, Option<String>), Failure> {
        let floors_file = DurableFile::new(layout.floors());
        let loaded = floors_file.load::<Floors>()?;
        let mut trust = Self {
            root: None,
            root_file: layout.trust(),
            floors: loaded.value.unwrap_or_default(),
            floors_file,
            labels,
            built: built(),
        };
        let read =
            PlainFile::named(&trust.root_file, TrustRoot::MAX).and_then(PlainFile::read_whole);
        let failed = |error: &dyn std::error::Error| {
            let action = format!("cannot use the trust root `{}`", trust.root_file.display());
            Failure::caused_by(Exit::Denied, action, error)
                .with_help("install it again: `gleaner trust install FILE`")
        };
        match read {
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(failed(&error)),
            Ok(envelope) => {
                let root = first_root(&envelope, &trust.floors).map_err(|it| failed(&it))?;
                // A kill may have come between the file of the root and the floors.
                trust.floors.accept_root(&root, trust.built);
                trust.root = Some(root);
            }
        }
        trust.observe_time()?;
        Ok((trust, loaded.damage))
    }

    /// Installs a trust root: the first one, or one that the current root's keys have signed.
    ///
    /// # Errors
    ///
    /// A failure with the reason; nothing has changed.
    pub(crate) fn install(&mut self, envelope: &[u8]) -> Result<(), Failure> {
        let root = match &self.root {
            None => first_root(envelope, &self.floors),
            Some(current) => next_root(current, envelope),
        };
        let root =
            root.map_err(|refusal| Failure::because("the trust root is refused", &refusal))?;
        write_atomically(&self.root_file, envelope).map_err(|error| {
            let action = format!("cannot write `{}`", self.root_file.display());
            Failure::caused_by(Exit::Internal, action, &error)
        })?;
        self.floors.accept_root(&root, self.built);
        self.root = Some(root);
        self.save_floors()
    }

    /// Moves the trusted time to that of the clock, as far as it counts.
    ///
    /// # Errors
    ///
    /// A failure that names the file.
    pub(crate) fn observe_time(&mut self) -> Result<(), Failure> {
        let before = self.floors.clone();
        self.floors.observe(clock(), self.built);
        if self.floors == before { Ok(()) } else { self.save_floors() }
    }

    /// Returns the checks of this vehicle, now.
    ///
    /// # Errors
    ///
    /// A failure without a trust root.
    pub(crate) fn verifier(&self) -> Result<Verifier<'_>, Failure> {
        let Some(root) = &self.root else {
            let message = "this vehicle has no trust root, so it accepts no deployment";
            return Err(Failure::new(Exit::Denied, message)
                .with_help("install one: `gleaner trust install FILE`"));
        };
        let now = self.floors.now(clock(), self.built);
        Ok(Verifier { root, floors: &self.floors, labels: &self.labels, now })
    }

    /// Remembers an accepted deployment, durably.
    ///
    /// # Errors
    ///
    /// A failure with the reason; nothing is remembered then.
    pub(crate) fn accept(
        &mut self,
        deployment: &Trusted<Deployment>,
        revision: &Trusted<Revision>,
    ) -> Result<(), Failure> {
        let before = self.floors.clone();
        self.floors
            .accept(deployment, revision, self.built)
            .map_err(|refusal| Failure::because("the deployment is refused", &refusal))?;
        if self.floors == before {
            return Ok(());
        }
        let saved = self.save_floors();
        if saved.is_err() {
            self.floors = before;
        }
        saved
    }

    pub(crate) fn labels(&self) -> &Labels {
        &self.labels
    }

    pub(crate) fn status(&self) -> Option<TrustStatus> {
        let root = self.root.as_ref()?;
        let is_expired = self.floors.now(clock(), self.built) >= root.expires;
        Some(TrustStatus { version: root.version, expires: root.expires, is_expired })
    }

    fn save_floors(&self) -> Result<(), Failure> {
        self.floors_file.save(&self.floors)
    }
}

/// Returns the time of the clock, in s since 1970.
fn clock() -> u64 {
    SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs()
}

/// Returns the time at which this program was built, that of its file: a clock that shows an earlier
/// time is wrong.
fn built() -> u64 {
    let modified = std::env::current_exe().and_then(fs::metadata).and_then(|it| it.modified());
    modified.ok().and_then(|it| it.duration_since(UNIX_EPOCH).ok()).unwrap_or_default().as_secs()
}

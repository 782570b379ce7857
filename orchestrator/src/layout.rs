//! Files and folders of the orchestrator.

use std::fs::{self, DirBuilder, File, Permissions};
use std::io;
use std::os::unix::fs::{DirBuilderExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};

use gleaner_base::text::list;
use gleaner_base::{Exit, Failure};
use rustix::fs::{FlockOperation, OFlags, flock};

/// The state folder and the run folder.
#[derive(Debug, Clone)]
pub(crate) struct VehicleFolders {
    state: PathBuf,
    run: PathBuf,
}

impl VehicleFolders {
    /// Creates the folders, as far as they do not exist, and makes them private.
    pub(crate) fn create(state: &Path, run: &Path) -> Result<Self, Failure> {
        let layout = Self { state: state.to_owned(), run: run.to_owned() };
        let folders = [
            layout.objects(),
            layout.revisions(),
            layout.spool(),
            layout.records(),
            layout.cache(),
        ];
        // Its own path may lead through links of the administrator. Once it is private, no other
        // user can put one into it.
        DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(state)
            .and_then(|()| File::open(state)?.set_permissions(Permissions::from_mode(0o700)))
            .map_err(|error| cannot_create(state, &error))?;
        layout.refuse_links()?;
        folders.iter().try_for_each(|folder| private(folder))?;
        // Lambdas run without a recorder, whose status then has the reason.
        if let Err(failure) = private(&layout.clips()) {
            tracing::warn!("clips cannot be recorded: {failure}");
        }
        // The folder of a service exists, with its own mode; its group may enter this one, too.
        let created = fs::create_dir(run);
        if created.is_ok() {
            let mode = Permissions::from_mode(0o750);
            fs::set_permissions(run, mode).map_err(|error| cannot_create(run, &error))?;
        } else if !run.is_dir() {
            created.map_err(|error| cannot_create(run, &error))?;
        }
        Ok(layout)
    }

    /// Refuses links in the place of files and folders: another user may have put them there before
    /// the folder was private.
    fn refuse_links(&self) -> Result<(), Failure> {
        let entries = fs::read_dir(&self.state)
            .and_then(Iterator::collect::<io::Result<Vec<_>>>)
            .map_err(|error| cannot_create(&self.state, &error))?;
        let links = entries.iter().filter(|it| it.file_type().is_ok_and(|kind| kind.is_symlink()));
        let links: Vec<_> = links.map(|it| it.path().display().to_string()).collect();
        if links.is_empty() {
            return Ok(());
        }
        let message = format!("the state folder `{}` has links in it", self.state.display());
        let mut failure = Failure::new(Exit::Denied, message);
        failure.causes = vec![format!("{} may lead to files of others", list(&links, "and"))];
        Err(failure.with_help(
            "remove them, or put the files themselves there; for another disk, mount it there, or \
             choose its folder with --state",
        ))
    }

    /// Locks both folders for this process, unless another orchestrator has them.
    pub(crate) fn lock(&self) -> Result<[File; 2], Failure> {
        let lock = |folder: &Path| {
            let file = lock_file(&folder.join("lock"))?;
            match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => Ok(file),
                Err(_) => {
                    let folder = folder.display();
                    let message = format!("another gleaner-orchestrator uses `{folder}`");
                    let help = "stop that one first: `systemctl stop gleaner`, or SIGTERM";
                    Err(Failure::new(Exit::Usage, message).with_help(help))
                }
            }
        };
        Ok([lock(&self.state)?, lock(&self.run)?])
    }

    /// Returns the open lock of the supervisor, and whether no supervisor has it.
    pub(crate) fn supervisor_lock(&self) -> Result<(File, bool), Failure> {
        let file = lock_file(&self.state.join("supervisor.lock"))?;
        let is_free = flock(&file, FlockOperation::NonBlockingLockExclusive).is_ok();
        Ok((file, is_free))
    }

    pub(crate) fn control_socket(&self) -> PathBuf {
        self.run.join(gleaner_protocol::vehicle_api::API_SOCKET)
    }

    pub(crate) fn supervisor_socket(&self) -> PathBuf {
        self.run.join("supervisor.sock")
    }
}

/// Defines methods that return paths in the state folder.
macro_rules! state_paths {
    ($($(#[$doc:meta])* $method:ident => $name:literal,)+) => {
        impl VehicleFolders {
            $($(#[$doc])* pub(crate) fn $method(&self) -> PathBuf { self.state.join($name) })+
        }
    };
}

state_paths! {
    trust => "trust.json",
    state_file => "state.json",
    /// The enrolment at the cloud.
    cloud => "cloud.json",
    /// File of the measurements.
    measured => "measured.json",
    /// The key that signs clips.
    key => "vehicle.pem",
    /// Folder of files that were sent, and belong to no revision yet.
    objects => "objects",
    revisions => "revisions",
    spool => "spool",
    /// Folder of the spools of lambdas.
    lambda_spools => "spool/lambdas",
    records => "records",
    clips => "clips",
    cache => "cache",
}

fn cannot_create(path: &Path, error: &io::Error) -> Failure {
    Failure::caused_by(Exit::Usage, format!("cannot use the folder `{}`", path.display()), error)
        .with_help("choose others with --state and --run, or create it for this user")
}

/// Creates a folder that only this user can enter, unless a link is in its place.
fn private(path: &Path) -> Result<(), Failure> {
    let created = match DirBuilder::new().mode(0o700).create(path) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(error),
        _ => Ok(()),
    };
    let flags = (OFlags::NOFOLLOW | OFlags::DIRECTORY).bits().cast_signed();
    created
        .and_then(|()| File::options().read(true).custom_flags(flags).open(path))
        .and_then(|folder| folder.set_permissions(Permissions::from_mode(0o700)))
        .map_err(|error| cannot_create(path, &error))
}

fn lock_file(path: &Path) -> Result<File, Failure> {
    let mut options = File::options();
    options.read(true).write(true).create(true).truncate(false);
    options.custom_flags(OFlags::NOFOLLOW.bits().cast_signed());
    options.open(path).map_err(|error| cannot_create(path, &error))
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::symlink;

    use super::*;

    fn mode(path: &Path) -> u32 {
        path.metadata().unwrap().permissions().mode() & 0o777
    }

    #[test]
    fn links_in_the_state_folder_are_named_and_their_targets_stay_as_they_are() {
        let scratch = tempfile::tempdir().unwrap();
        let [state, run, precious] = ["state", "run", "precious"].map(|it| scratch.path().join(it));
        for path in [&state, &precious] {
            fs::create_dir(path).unwrap();
            fs::set_permissions(path, Permissions::from_mode(0o755)).unwrap();
        }
        for name in ["clips", "vehicle.pem"] {
            symlink(&precious, state.join(name)).unwrap();
            let failure = VehicleFolders::create(&state, &run).unwrap_err().to_string();
            for part in [name, "has links in it", "help:", "--state"] {
                assert!(failure.contains(part), "{failure}");
            }
            // As if it had been put there in between.
            private(&state.join(name)).unwrap_err();
            fs::remove_file(state.join(name)).unwrap();
        }
        assert_eq!((mode(&precious), fs::read_dir(&precious).unwrap().count()), (0o755, 0));
        // The folder itself may be a link.
        let link = scratch.path().join("link");
        symlink(&state, &link).unwrap();
        VehicleFolders::create(&link, &run).unwrap();
        assert_eq!([mode(&state), mode(&state.join("clips")), mode(&run)], [0o700, 0o700, 0o750]);
    }
}

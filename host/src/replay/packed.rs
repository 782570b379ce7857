//! Unpacks packed drives for a worker, which may not write itself.

use std::ffi::OsString;
use std::path::PathBuf;

use gleaner_base::{Exit, Failure};
use gleaner_drives as replay;
use gleaner_drives::{ContentName, Unpacked, unpack};

use super::job::ReplayJob;
use super::open::DriveError;
use super::options::ReplayOptions;

/// Option of a worker with two values: a packed file, and the path of its unpacked content.
const UNPACKED: &str = "--unpacked";
/// Option of a worker with two values: a packed file whose content is incomplete, and the reason.
const BROKEN: &str = "--unpacked-in-part";

/// Arguments with which a worker receives the contents of packed drives.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct UnpackedArgs {
    #[arg(long, hide = true, num_args = 2, allow_hyphen_values = true)]
    unpacked: Vec<PathBuf>,
    #[arg(long, hide = true, num_args = 2, allow_hyphen_values = true)]
    unpacked_in_part: Vec<OsString>,
}

/// The drives of a job, to unpack the packed ones among them for a worker.
pub struct Packed {
    named: Vec<PathBuf>,
    options: replay::DriveOptions,
}

/// Contents of packed drives, unpacked for a worker to open.
pub struct WorkerContents {
    /// Arguments of the worker that name the contents.
    pub arguments: Vec<OsString>,
    /// Temporary names, removed on drop.
    _names: Vec<ContentName>,
}

impl ReplayJob {
    /// Returns the drives of the job, to unpack the packed ones for a worker.
    pub fn packed(&self) -> Packed {
        let ReplayOptions { drives, unpack_in, .. } = &self.options;
        let options = replay::DriveOptions {
            unpack_in: unpack_in.clone(),
            ..replay::DriveOptions::default()
        };
        Packed { named: drives.named.clone(), options }
    }

    /// Opens the contents that the arguments of this process, a worker, name. The replay then reads
    /// them instead of the packed files.
    ///
    /// # Errors
    ///
    /// A failure with the packed file whose content cannot be opened.
    pub fn use_unpacked(&mut self, args: UnpackedArgs) -> Result<(), Failure> {
        let UnpackedArgs { unpacked, unpacked_in_part } = args;
        let broken = |path: &PathBuf| {
            let mut pairs = unpacked_in_part.chunks_exact(2);
            pairs.find(|pair| pair[0] == *path).map(|pair| pair[1].to_string_lossy().into_owned())
        };
        for pair in unpacked.chunks_exact(2) {
            let [path, name] = pair else { continue };
            let content =
                Unpacked::named(path.clone(), name.clone(), broken(path)).map_err(|error| {
                    Failure::caused_by(
                        Exit::Internal,
                        format!("cannot open the unpacked content of `{}`", path.display()),
                        &error,
                    )
                })?;
            self.options.unpacked.push(content);
        }
        Ok(())
    }
}

impl Packed {
    /// Unpacks the packed files for a worker. This process has unpacked them already, but into
    /// files whose names are removed and cannot be restored: a worker cannot open those.
    pub fn unpack_for_worker(&self) -> Result<WorkerContents, Failure> {
        let (mut arguments, mut names) = (Vec::new(), Vec::new());
        for unpacked in unpack(&self.named, &self.options).map_err(DriveError)? {
            let name = unpacked.name(&self.options).map_err(DriveError)?;
            let (path, broken) = unpacked.parts();
            arguments.extend([UNPACKED.into(), path.into(), name.as_ref().as_os_str().to_owned()]);
            if let Some(why) = broken {
                arguments.extend([BROKEN.into(), path.into(), why.into()]);
            }
            names.push(name);
        }
        Ok(WorkerContents { arguments, _names: names })
    }
}

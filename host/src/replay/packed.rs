//! Packed drives, which a process that may write unpacks for its worker, too.

use std::ffi::OsString;
use std::path::PathBuf;

use gleaner_base::{Exit, Failure};
use gleaner_drives as replay;
use gleaner_drives::{Name, Unpacked, unpack};

use super::open::DriveError;
use super::{Job, Options};

/// The argument of a worker with a packed file and the name of its content.
const UNPACKED: &str = "--unpacked";
/// The argument with a packed file whose content is not whole, and why not.
const BROKEN: &str = "--unpacked-in-part";

/// Contents of packed drives, as a worker is given them.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct UnpackedArgs {
    #[arg(long, hide = true, num_args = 2, allow_hyphen_values = true)]
    unpacked: Vec<PathBuf>,
    #[arg(long, hide = true, num_args = 2, allow_hyphen_values = true)]
    unpacked_in_part: Vec<OsString>,
}

/// Packed drives, where a worker may have to be given their contents.
pub struct Packed {
    named: Vec<PathBuf>,
    options: replay::Options,
}

/// Contents of packed drives that a worker is about to open.
pub struct Lent {
    /// Those of the worker that name them.
    pub arguments: Vec<OsString>,
    /// Names that last as long as this.
    _names: Vec<Name>,
}

impl Job {
    /// The packed files among the drives.
    pub fn packed(&self) -> Packed {
        let Options { drives, unpack_in, .. } = &self.options;
        let options =
            replay::Options { unpack_in: unpack_in.clone(), ..replay::Options::default() };
        Packed { named: drives.named.clone(), options }
    }

    /// Has this process, a worker, read contents that it was given.
    ///
    /// # Errors
    ///
    /// A failure that names the content which cannot be opened.
    pub fn take(&mut self, args: UnpackedArgs) -> Result<(), Failure> {
        let UnpackedArgs { unpacked, unpacked_in_part } = args;
        let broken = |path: &PathBuf| {
            let mut pairs = unpacked_in_part.chunks_exact(2);
            pairs.find(|pair| pair[0] == *path).map(|pair| pair[1].to_string_lossy().into_owned())
        };
        for pair in unpacked.chunks_exact(2) {
            let [path, name] = pair else { continue };
            let named =
                Unpacked::named(path.clone(), name.clone(), broken(path)).map_err(|error| {
                    Failure::caused_by(
                        Exit::Internal,
                        format!("cannot open the content of `{}`", path.display()),
                        &error,
                    )
                })?;
            self.options.unpacked.push(named);
        }
        Ok(())
    }
}

impl Packed {
    /// Unpacks the files again for a worker: the content that this process reads has no name any
    /// more, and cannot be given one.
    ///
    /// # Errors
    ///
    /// A failure that names the file.
    pub fn lend(&self) -> Result<Lent, Failure> {
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
        Ok(Lent { arguments, _names: names })
    }
}

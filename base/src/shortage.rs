use std::error::Error;
use std::io;

use rustix::io::Errno;

/// The errors of a system that lacks something for the moment: open files, memory, processes, room
/// on the disk.
const SHORTAGES: [Errno; 6] =
    [Errno::MFILE, Errno::NFILE, Errno::NOMEM, Errno::AGAIN, Errno::NOSPC, Errno::DQUOT];

/// Returns whether `error`, or one of its sources, is a shortage of this machine: the same may
/// succeed later, whatever the file is.
pub fn is_shortage(error: &(dyn Error + 'static)) -> bool {
    let sources = std::iter::successors(Some(error), |&error| error.source());
    let codes = sources.filter_map(|error| error.downcast_ref::<io::Error>()?.raw_os_error());
    codes.map(Errno::from_raw_os_error).any(|code| SHORTAGES.contains(&code))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    enum Outer {
        #[error("cannot read")]
        Read { source: io::Error },
        #[error(transparent)]
        Inner(Box<Outer>),
    }

    #[test]
    fn a_shortage_is_found_behind_any_error_and_damage_is_none() {
        let of = |code: Errno| Outer::Read { source: io::Error::from(code) };
        for code in SHORTAGES {
            assert!(is_shortage(&of(code)) && is_shortage(&Outer::Inner(Box::new(of(code)))));
        }
        for code in [Errno::IO, Errno::NOENT, Errno::ACCESS, Errno::ISDIR] {
            assert!(!is_shortage(&of(code)), "{code}");
        }
        assert!(!is_shortage(&Outer::Read { source: io::Error::other("it is a link") }));
    }
}

/// The exit code of a Gleaner program.
///
/// Scripts and the orchestrator act on these numbers, so a code never changes its meaning.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Exit {
    /// 0: success.
    Ok = 0,
    /// 1: an internal error, or a failure of the machine (a full disk, no memory).
    Internal = 1,
    /// 2: the command line, a manifest or another input of the user is invalid.
    Usage = 2,
    /// 3: denied by a grant, a signature or a permission.
    Denied = 3,
    /// 4: the desired state was not reached in time, or two results that should be equal differ.
    Differs = 4,
    /// 5: a vehicle, the cloud or another program cannot be reached.
    Unreachable = 5,
    /// 6: the program completed, but a lambda faulted.
    LambdaFaulted = 6,
    /// 7: a drive is damaged; the results up to the damage are kept.
    DriveDamaged = 7,
}

impl Exit {
    pub fn code(self) -> u8 {
        self as u8
    }

    /// Parses a child's exit code; `None` for a code that no Gleaner program uses.
    pub fn from_code(code: i32) -> Option<Exit> {
        Some(match code {
            0 => Exit::Ok,
            1 => Exit::Internal,
            2 => Exit::Usage,
            3 => Exit::Denied,
            4 => Exit::Differs,
            5 => Exit::Unreachable,
            6 => Exit::LambdaFaulted,
            7 => Exit::DriveDamaged,
            _ => return None,
        })
    }
}

impl From<Exit> for std::process::ExitCode {
    fn from(exit: Exit) -> Self {
        exit.code().into()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_code_reads_back_as_itself() {
        for code in 0..=7 {
            assert_eq!(Exit::from_code(code).map(|exit| i32::from(exit.code())), Some(code));
        }
        assert_eq!(Exit::from_code(8), None);
        assert_eq!(Exit::from_code(-1), None);
    }
}

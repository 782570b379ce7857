/// How a Gleaner program ends: its exit code.
///
/// Scripts and the orchestrator act on these numbers, so a code never changes its meaning.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Exit {
    /// 0: everything asked for was done.
    Ok = 0,
    /// 1: Gleaner itself failed, or the machine did (a full disk, no memory).
    Internal = 1,
    /// 2: the command line, a manifest or another input of the user cannot be used as it is.
    Usage = 2,
    /// 3: a grant, a signature or a permission denies it.
    Denied = 3,
    /// 4: the wanted state was not reached in time, or two results that should be equal differ.
    Differs = 4,
    /// 5: a vehicle, the cloud or another program cannot be reached.
    Unreachable = 5,
    /// 6: the program did its work, and a lambda faulted meanwhile.
    LambdaFaulted = 6,
    /// 7: a drive is damaged; the results up to the damage are kept.
    DriveDamaged = 7,
}

impl Exit {
    /// The number that the operating system sees.
    pub fn code(self) -> u8 {
        self as u8
    }

    /// The meaning of a child's exit code, or `None` for a number that no Gleaner program uses.
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

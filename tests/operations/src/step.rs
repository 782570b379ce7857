//! Steps of a program for `driver`: a byte for what to do, then what it takes.

use crate::Operation;

/// A step.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Step {
    /// A call of the host.
    Call(Operation),
    /// Something else.
    Extra(Extra),
}

/// What a program does besides calls: to what it was given, to its memory, and to the WASI that a
/// library calls.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum Extra {
    Reset,
    ForgetTopic,
    ForgetField,
    ForgetSample,
    ForgetFrame,
    EventWithTexts,
    EventWithMany,
    ColumnAtOnce,
    ScratchPutText,
    Print,
    PrintError,
    Allocate,
    Wasi,
    Panic,
    Exit,
}

impl Extra {
    /// All of them.
    pub const ALL: [Self; 15] = [
        Self::Reset,
        Self::ForgetTopic,
        Self::ForgetField,
        Self::ForgetSample,
        Self::ForgetFrame,
        Self::EventWithTexts,
        Self::EventWithMany,
        Self::ColumnAtOnce,
        Self::ScratchPutText,
        Self::Print,
        Self::PrintError,
        Self::Allocate,
        Self::Wasi,
        Self::Panic,
        Self::Exit,
    ];
}

impl Step {
    /// What a byte stands for. Each byte is a step.
    pub fn of(byte: u8) -> Self {
        let number = usize::from(byte) % (Operation::ALL.len() + Extra::ALL.len());
        match Operation::ALL.get(number) {
            Some(operation) => Self::Call(*operation),
            None => Self::Extra(Extra::ALL[number - Operation::ALL.len()]),
        }
    }

    /// The smallest byte that stands for it.
    pub fn byte(self) -> u8 {
        let number = match self {
            Self::Call(operation) => operation as usize,
            Self::Extra(extra) => Operation::ALL.len() + extra as usize,
        };
        u8::try_from(number).expect("there are fewer than 256 steps")
    }

    /// Its bytes, with what it takes.
    pub fn with(self, arguments: &[u8]) -> Vec<u8> {
        [&[self.byte()], arguments].concat()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_step_has_a_byte_of_its_own() {
        let calls = Operation::ALL.iter().map(|operation| Step::Call(*operation));
        let steps: Vec<_> = calls.chain(Extra::ALL.map(Step::Extra)).collect();
        assert!(steps.iter().enumerate().all(|(number, step)| usize::from(step.byte()) == number));
        assert!(steps.iter().all(|step| Step::of(step.byte()) == *step));
    }
}

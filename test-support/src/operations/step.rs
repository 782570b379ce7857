//! Steps of a program for `driver`: a byte for the operation, then its arguments.

use super::Operation;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum DriverStep {
    Call(Operation),
    /// Something else.
    Extra(Extra),
}

/// Steps other than calls: on objects of the lambda, on its memory, and on the WASI that libraries
/// call.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Extra {
    Reset,
    ForgetTopic,
    ForgetField,
    ForgetSample,
    ForgetFrame,
    ForgetTensor,
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
    pub const ALL: [Self; 16] = [
        Self::Reset,
        Self::ForgetTopic,
        Self::ForgetField,
        Self::ForgetSample,
        Self::ForgetFrame,
        Self::ForgetTensor,
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

impl DriverStep {
    /// The step for a byte. Every byte is a step.
    pub fn of(byte: u8) -> Self {
        let number = usize::from(byte) % (Operation::ALL.len() + Extra::ALL.len());
        match Operation::ALL.get(number) {
            Some(operation) => Self::Call(*operation),
            None => Self::Extra(Extra::ALL[number - Operation::ALL.len()]),
        }
    }

    /// The smallest byte for the step.
    pub fn byte(self) -> u8 {
        let number = match self {
            Self::Call(operation) => operation as usize,
            Self::Extra(extra) => Operation::ALL.len() + extra as usize,
        };
        u8::try_from(number).expect("there are fewer than 256 steps")
    }

    /// Its bytes, followed by those of its arguments.
    pub fn with(self, arguments: &[u8]) -> Vec<u8> {
        [&[self.byte()], arguments].concat()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_step_has_its_own_byte() {
        let calls = Operation::ALL.iter().map(|operation| DriverStep::Call(*operation));
        let steps: Vec<_> = calls.chain(Extra::ALL.map(DriverStep::Extra)).collect();
        assert!(steps.iter().enumerate().all(|(number, step)| usize::from(step.byte()) == number));
        assert!(steps.iter().all(|step| DriverStep::of(step.byte()) == *step));
    }
}

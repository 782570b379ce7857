//! Implements `gleaner:lambda/scratch`: named entries within `scratch` in `[limits]`, kept across
//! faults of the lambda.

pub use gleaner_rules::scratch::Entry;
use gleaner_rules::scratch::ScratchError as Refused;

use super::session::current;
pub use crate::bindings::gleaner::lambda::scratch::ScratchError;

type CallResult<T> = Result<T, ScratchError>;

pub(crate) fn put(name: &str, bytes: &[u8]) -> CallResult<()> {
    let session = current();
    session.check_bytes(name.len() + bytes.len());
    session.lock().scratch.put(name, bytes).map_err(refused)
}

pub(crate) fn append(name: &str, bytes: &[u8]) -> CallResult<()> {
    let session = current();
    session.check_bytes(name.len() + bytes.len());
    session.lock().scratch.append(name, bytes).map_err(refused)
}

pub(crate) fn get(name: &str, offset: u64, len: u32) -> CallResult<Vec<u8>> {
    let session = current();
    session.check_bytes(name.len());
    session.lock().scratch.get(name, offset, len.into()).map_err(refused)
}

pub(crate) fn remove(name: &str) -> CallResult<()> {
    let session = current();
    session.check_bytes(name.len());
    session.lock().scratch.remove(name).map_err(refused)
}

pub(crate) fn entries() -> Vec<Entry> {
    current().lock().scratch.entries()
}

pub(crate) fn free() -> u64 {
    current().lock().scratch.free()
}

fn refused(error: Refused) -> ScratchError {
    let message = error.to_string();
    match error {
        Refused::NoRoom { .. } | Refused::TooMany(_) => ScratchError::NoRoom(message),
        Refused::NoSuchEntry(_) => ScratchError::NoSuchEntry(message),
        Refused::WrongName(_) => ScratchError::WrongName(message),
    }
}

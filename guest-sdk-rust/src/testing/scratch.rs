//! `gleaner:lambda/scratch`: what is kept by name, within `scratch` of `[limits]`, beyond faults of
//! the lambda.

pub use gleaner_rules::scratch::Entry;
use gleaner_rules::scratch::ScratchError as Refused;

use super::session::current;
use super::types::refusal;

/// Why something was not kept or not found. Nothing has changed then.
#[derive(Clone, Debug)]
pub enum ScratchError {
    /// It would take more than `scratch` of `[limits]`, or there are 1,024 entries already.
    NoRoom(String),
    /// Nothing has that name.
    NoSuchEntry(String),
    /// A name has 1 to 128 bytes and no control characters.
    WrongName(String),
}

refusal!(ScratchError);

type Answer<T> = Result<T, ScratchError>;

pub(crate) fn put(name: &str, bytes: &[u8]) -> Answer<()> {
    let session = current();
    session.passed(name.len() + bytes.len());
    session.lock().scratch.put(name, bytes).map_err(refused)
}

pub(crate) fn append(name: &str, bytes: &[u8]) -> Answer<()> {
    let session = current();
    session.passed(name.len() + bytes.len());
    session.lock().scratch.append(name, bytes).map_err(refused)
}

pub(crate) fn get(name: &str, offset: u64, len: u32) -> Answer<Vec<u8>> {
    let session = current();
    session.passed(name.len());
    session.lock().scratch.get(name, offset, len.into()).map_err(refused)
}

pub(crate) fn remove(name: &str) -> Answer<()> {
    let session = current();
    session.passed(name.len());
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

//! `gleaner:lambda/scratch`: what is kept by name, within `scratch` of `[limits]`, beyond faults of the lambda.

use std::collections::BTreeMap;

use super::manifest::Limits;
use super::piece;
use super::session::current;
use super::types::refusal;

const NAME_BYTES: usize = 128;
const ENTRIES: usize = 1024;
/// What an entry takes beside its name and its bytes.
const ENTRY_BYTES: u64 = 64;

/// Something that is kept.
#[derive(Clone, Debug)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// Its length.
    pub bytes: u64,
}

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
    session.lock().scratch.keep(name, bytes, true)
}

pub(crate) fn append(name: &str, bytes: &[u8]) -> Answer<()> {
    let session = current();
    session.passed(name.len() + bytes.len());
    session.lock().scratch.keep(name, bytes, false)
}

pub(crate) fn get(name: &str, offset: u64, len: u32) -> Answer<Vec<u8>> {
    let session = current();
    session.passed(name.len());
    let state = session.lock();
    let kept = state.scratch.there(name)?;
    Ok(piece(kept, offset, (len as usize).min(session.limits().call_bytes)).to_vec())
}

pub(crate) fn remove(name: &str) -> Answer<()> {
    let session = current();
    session.passed(name.len());
    session.lock().scratch.remove(name)
}

pub(crate) fn entries() -> Vec<Entry> {
    let session = current();
    let state = session.lock();
    let entries = state.scratch.entries.iter();
    entries.map(|(name, kept)| Entry { name: name.clone(), bytes: kept.len() as u64 }).collect()
}

pub(crate) fn free() -> u64 {
    current().lock().scratch.free()
}

/// Entries by name, and what they take.
pub(super) struct Scratch {
    granted: u64,
    used: u64,
    entries: BTreeMap<String, Vec<u8>>,
}

impl Scratch {
    pub(super) fn new(limits: &Limits) -> Self {
        Self { granted: limits.scratch, used: 0, entries: BTreeMap::new() }
    }

    fn free(&self) -> u64 {
        self.granted - self.used
    }

    fn keep(&mut self, name: &str, bytes: &[u8], in_place: bool) -> Answer<()> {
        if name.is_empty() || name.len() > NAME_BYTES || name.chars().any(char::is_control) {
            let why = "give 1 to 128 bytes without control characters";
            return Err(ScratchError::WrongName(format!("`{}` is no name for scratch; {why}", shown(name))));
        }
        let there = self.entries.get(name).map(|kept| kept.len() as u64);
        if there.is_none() && self.entries.len() >= ENTRIES {
            let why = format!("there is no room for `{name}` beside {ENTRIES} entries");
            return Err(ScratchError::NoRoom(format!("{why}; remove some, or append to one of them")));
        }
        let given_back = if in_place { there.unwrap_or(0) } else { 0 };
        let new = there.map_or(ENTRY_BYTES + name.len() as u64, |_| 0) + bytes.len() as u64;
        if new > self.free() + given_back {
            let (needed, free) = (new.saturating_sub(given_back), self.free());
            return Err(ScratchError::NoRoom(format!(
                "`{name}` needs {needed} bytes of scratch and {free} are free; remove entries, or ask for more by `scratch` in \
                 [limits]"
            )));
        }
        let kept = self.entries.entry(name.to_owned()).or_default();
        if in_place {
            kept.clear();
        }
        kept.extend_from_slice(bytes);
        self.used = self.used + new - given_back;
        Ok(())
    }

    fn there(&self, name: &str) -> Answer<&[u8]> {
        self.entries.get(name).map(Vec::as_slice).ok_or_else(|| no_such_entry(name))
    }

    fn remove(&mut self, name: &str) -> Answer<()> {
        let kept = self.entries.remove(name).ok_or_else(|| no_such_entry(name))?;
        self.used -= ENTRY_BYTES + name.len() as u64 + kept.len() as u64;
        Ok(())
    }
}

fn no_such_entry(name: &str) -> ScratchError {
    let why = "it is empty when the lambda's process starts";
    ScratchError::NoSuchEntry(format!("scratch has no `{}`; {why}", shown(name)))
}

/// A name in a message, which may be none that can be: its control characters written out.
fn shown(name: &str) -> String {
    let plain = |character: char| match character.is_control() {
        true => character.escape_default().to_string(),
        false => character.to_string(),
    };
    name.chars().take(NAME_BYTES).map(plain).collect()
}

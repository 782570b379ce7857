//! `gleaner:lambda/scratch` over [`api::scratch`](crate::api::scratch).

use super::Hosted;
use super::bindings::gleaner::lambda::scratch::{Entry, Host, ScratchError};
use crate::api::scratch;

type Answer<T> = wasmtime::Result<Result<T, ScratchError>>;

/// What an entry of the list costs besides its name.
const ENTRY_BYTES: usize = 64;

impl Host for Hosted {
    fn put(&mut self, name: String, bytes: Vec<u8>) -> Answer<()> {
        self.meter.charge(name.len() + bytes.len())?;
        Ok(self.session.put(&name, &bytes).map_err(refused))
    }

    fn append(&mut self, name: String, bytes: Vec<u8>) -> Answer<()> {
        self.meter.charge(name.len() + bytes.len())?;
        Ok(self.session.append(&name, &bytes).map_err(refused))
    }

    fn get(&mut self, name: String, offset: u64, len: u32) -> Answer<Vec<u8>> {
        let answer = self.session.get(&name, offset, u64::from(len));
        self.meter.charge(name.len() + answer.as_ref().map_or(0, Vec::len))?;
        Ok(answer.map_err(refused))
    }

    fn remove(&mut self, name: String) -> Answer<()> {
        self.meter.charge(name.len())?;
        Ok(self.session.remove(&name).map_err(refused))
    }

    fn entries(&mut self) -> wasmtime::Result<Vec<Entry>> {
        let entries = self.session.entries();
        self.meter.charge(entries.iter().map(|entry| ENTRY_BYTES + entry.name.len()).sum())?;
        Ok(entries.into_iter().map(|scratch::Entry { name, bytes }| Entry { name, bytes }).collect())
    }

    fn free(&mut self) -> wasmtime::Result<u64> {
        self.meter.charge(0)?;
        Ok(self.session.free())
    }
}

fn refused(error: scratch::ScratchError) -> ScratchError {
    let message = error.to_string();
    match error {
        scratch::ScratchError::NoRoom { .. } | scratch::ScratchError::TooMany(_) => ScratchError::NoRoom(message),
        scratch::ScratchError::NoSuchEntry(_) => ScratchError::NoSuchEntry(message),
        scratch::ScratchError::WrongName(_) => ScratchError::WrongName(message),
    }
}

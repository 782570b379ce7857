//! `gleaner:lambda/scratch` over [`api::scratch`](crate::api::scratch).

use super::Hosted;
use super::bindings::gleaner::lambda::scratch::{Entry, Host, ScratchError};
use crate::api::scratch::{self, ScratchErrorKind};

type ScratchResult<T> = wasmtime::Result<Result<T, ScratchError>>;

impl Host for Hosted {
    fn put(&mut self, name: String, bytes: Vec<u8>) -> ScratchResult<()> {
        wit_result(self.session.put(&name, &bytes))
    }

    fn append(&mut self, name: String, bytes: Vec<u8>) -> ScratchResult<()> {
        wit_result(self.session.append(&name, &bytes))
    }

    fn get(&mut self, name: String, offset: u64, len: u32) -> ScratchResult<Vec<u8>> {
        wit_result(self.session.get(&name, offset, u64::from(len)))
    }

    fn remove(&mut self, name: String) -> ScratchResult<()> {
        wit_result(self.session.remove(&name))
    }

    fn entries(&mut self) -> wasmtime::Result<Vec<Entry>> {
        let entries = self.session.entries()?;
        Ok(entries
            .into_iter()
            .map(|scratch::Entry { name, bytes }| Entry { name, bytes })
            .collect())
    }

    fn free(&mut self) -> wasmtime::Result<u64> {
        self.session.fuel().charge_call()?;
        Ok(self.session.free())
    }
}

fn wit_result<T>(result: Result<T, scratch::ScratchError>) -> ScratchResult<T> {
    let error = match result {
        Ok(value) => return Ok(Ok(value)),
        Err(scratch::ScratchError::OutOfFuel(error)) => return Err(error.into()),
        Err(error) => error,
    };
    let message = error.to_string();
    Ok(Err(match error.kind() {
        ScratchErrorKind::NoRoom => ScratchError::NoRoom(message),
        ScratchErrorKind::NoSuchEntry => ScratchError::NoSuchEntry(message),
        ScratchErrorKind::WrongName => ScratchError::WrongName(message),
    }))
}

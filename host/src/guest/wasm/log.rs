//! `gleaner:lambda/log` over [`api::log`](crate::api::log).

use super::Hosted;
use super::bindings::gleaner::lambda::log::{Host, Level};
use crate::api::log;

impl Host for Hosted {
    fn log(&mut self, level: Level, message: String) -> wasmtime::Result<()> {
        let level = match level {
            Level::Error => log::Level::Error,
            Level::Warn => log::Level::Warn,
            Level::Info => log::Level::Info,
            Level::Debug => log::Level::Debug,
            Level::Trace => log::Level::Trace,
        };
        Ok(self.session.log(level, &message)?)
    }
}

//! The fake host before it runs: a manifest, and what a test lays over it.

use std::sync::Arc;

use gleaner_rules::frames::Budget;
use gleaner_rules::names::IMAGE;
use gleaner_rules::schedule::Backlog;
use gleaner_rules::text::quoted;

use super::data::Source;
use super::error::Error;
use super::frame::Images;
use super::manifest::{self, Manifest, When};
use super::message::Message;
use super::run::Run;
use super::schedule::{Input, Schedule};
use super::session::{Handles, Session};
use crate::bindings::ConfigValue;
use crate::{Config, Lambda};

/// A host that is about to load a lambda.
#[derive(Clone, Debug)]
#[must_use = "a host runs nothing before `load`"]
pub struct Host {
    manifest: String,
    set: Vec<(String, ConfigValue)>,
    blanks: Vec<(String, Message)>,
}

impl Host {
    /// A host for the lambda with this `lambda.toml`, usually `include_str!("../lambda.toml")`. It
    /// is read by [`load`](Self::load).
    pub fn from_manifest(text: &str) -> Self {
        Self { manifest: text.to_owned(), set: Vec::new(), blanks: Vec::new() }
    }

    /// Sets a value of `[config]`, as `gleaner replay --set` does: of the type of its default, and
    /// within its range.
    pub fn set(mut self, key: &str, value: impl Into<Setting>) -> Self {
        self.set.push((key.to_owned(), value.into().0));
        self
    }

    /// Says which fields messages of an input have, and what stands there where a message does not
    /// say otherwise.
    ///
    /// Then a lambda that asks `init` for another field is refused there, as on a vehicle, and a
    /// message with another field is an error. Without it, a field counts as missing only once it
    /// is read from a message that has not got it.
    pub fn blank(mut self, input: &str, message: Message) -> Self {
        self.blanks.push((input.to_owned(), message));
        self
    }

    /// Reads the manifest, and runs `init`.
    ///
    /// # Errors
    ///
    /// If the manifest or a setting cannot be used, or `init` fails or panics.
    pub fn load<L: Lambda>(self) -> Result<Run<L>, Error> {
        let manifest = manifest::read(&self.manifest)?;
        let config = Config::from(manifest.config(&self.set)?);
        let handles = Handles::new(&manifest.limits);
        let inputs = self.inputs(&manifest, &handles)?;
        let session = Session::new(manifest.limits, inputs);
        let schedule = match &manifest.schedule {
            When::Period(period_ns) => Schedule::periodic(*period_ns),
            When::Event(name) => {
                let woken_by = session.inputs.iter().find(|source| source.declared.name == *name);
                Schedule::event(
                    Input(Arc::clone(woken_by.expect("the manifest was checked"))),
                    Backlog::Each,
                )
            }
        };
        Run::start(&manifest.name, config, session, schedule)
    }

    fn inputs(
        &self,
        manifest: &Manifest,
        handles: &Arc<Handles>,
    ) -> Result<Vec<Arc<Source>>, Error> {
        let names = || manifest.inputs.iter().map(|input| input.name.as_str());
        if let Some((asked, _)) =
            self.blanks.iter().find(|(asked, _)| names().all(|name| name != asked))
        {
            let help = format!("the manifest has {}", quoted(names()));
            return Err(Error::new(format!("no input `{asked}` for a blank message"), "", help));
        }
        let budget = Budget::new(manifest.limits.frames, manifest.limits.memory);
        let source = |declared: &manifest::Input| {
            let blank = self.blanks.iter().rev().find(|(name, _)| *name == declared.name);
            let blank = blank.map(|(_, message)| {
                let mut message = message.clone();
                if declared.type_name == IMAGE {
                    message.spread_picture();
                }
                message
            });
            let images = Images::new(declared, budget.clone());
            Source::new(declared.clone(), manifest.limits, Arc::clone(handles), images, blank)
        };
        Ok(manifest.inputs.iter().map(source).collect())
    }
}

/// A value for [`Host::set`]; made from `bool`, `i32`, `i64`, `f64` and `&str`.
#[derive(Clone, Debug)]
pub struct Setting(ConfigValue);

impl From<bool> for Setting {
    fn from(value: bool) -> Self {
        Self(ConfigValue::Boolean(value))
    }
}

impl From<i32> for Setting {
    fn from(value: i32) -> Self {
        Self(ConfigValue::Integer(value.into()))
    }
}

impl From<i64> for Setting {
    fn from(value: i64) -> Self {
        Self(ConfigValue::Integer(value))
    }
}

impl From<f64> for Setting {
    fn from(value: f64) -> Self {
        Self(ConfigValue::Real(value))
    }
}

impl From<&str> for Setting {
    fn from(value: &str) -> Self {
        Self(ConfigValue::Text(value.to_owned()))
    }
}

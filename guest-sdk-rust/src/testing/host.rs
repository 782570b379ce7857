//! Configures the fake host: a manifest, and the settings of a test.

use std::sync::Arc;

use gleaner_rules::frames::Budget;
use gleaner_rules::names::IMAGE;
use gleaner_rules::schedule::Backlog;
use gleaner_rules::text::quoted;

use super::data::InputState;
use super::error::Error;
use super::frame::FramePool;
use super::inference::{DeclaredModel, ModelTable};
use super::manifest::{self, Manifest, ScheduleSpec};
use super::message::Message;
use super::model::FakeModel;
use super::run::Run;
use super::schedule::{EventInput, Schedule};
use super::session::{HandleCounter, Session};
use crate::world::ConfigValue;
use crate::{Config, Lambda};

/// A fake host, configured to load a lambda.
#[derive(Clone, Debug)]
#[must_use = "a host has no effect until `load`"]
pub struct Host {
    manifest: String,
    set: Vec<(String, ConfigValue)>,
    blanks: Vec<(String, Message)>,
    models: Vec<(String, FakeModel)>,
}

impl Host {
    /// Creates a host for the lambda with this `lambda.toml`, usually
    /// `include_str!("../lambda.toml")`. [`load`](Self::load) parses it.
    pub fn from_manifest(text: &str) -> Self {
        let (set, blanks, models) = (Vec::new(), Vec::new(), Vec::new());
        Self { manifest: text.to_owned(), set, blanks, models }
    }

    /// Sets a value of `[config]`, as `gleaner replay --set` does. It must have the type of the
    /// default and be within `min` and `max` of the manifest; an integer is accepted for a real
    /// number.
    pub fn set(mut self, key: &str, value: impl Into<Setting>) -> Self {
        self.set.push((key.to_owned(), value.into().0));
        self
    }

    /// Defines the fields of an input's messages, with default values for messages that do not set
    /// them.
    ///
    /// With it, `init` cannot compile any other field, as on a vehicle, and a message with another
    /// field is an error. Without it, a missing field is an error only when the lambda reads it
    /// from a message that does not have it.
    pub fn blank(mut self, input: &str, message: Message) -> Self {
        self.blanks.push((input.to_owned(), message));
        self
    }

    /// Sets the answers of the `[[model]]` of this name; without them it cannot be opened. No model
    /// file is needed.
    pub fn model(mut self, name: &str, answers: FakeModel) -> Self {
        self.models.push((name.to_owned(), answers));
        self
    }

    /// Parses the manifest and runs `init`.
    ///
    /// # Errors
    ///
    /// If the manifest or a setting is invalid, or `init` fails or panics.
    pub fn load<L: Lambda>(self) -> Result<Run<L>, Error> {
        let manifest = manifest::read(&self.manifest)?;
        let config = Config::from(manifest.config(&self.set)?);
        let handles = HandleCounter::new(&manifest.limits);
        let inputs = self.inputs(&manifest, &handles)?;
        let models = ModelTable::new(self.models(&manifest)?, &manifest.limits, handles);
        let session = Session::new(manifest.limits, inputs, models);
        let schedule = match &manifest.schedule {
            ScheduleSpec::Period(period_ns) => Schedule::periodic(*period_ns),
            ScheduleSpec::Event(name) => {
                let woken_by = session.inputs.iter().find(|source| source.declared.name == *name);
                Schedule::event(
                    EventInput(Arc::clone(woken_by.expect("the manifest was checked"))),
                    Backlog::Each,
                )
            }
        };
        Run::start(&manifest.name, config, session, schedule)
    }

    fn inputs(
        &self,
        manifest: &Manifest,
        handles: &Arc<HandleCounter>,
    ) -> Result<Vec<Arc<InputState>>, Error> {
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
                    message.set_image_fields();
                }
                message
            });
            let frame_pool = FramePool::new(declared, budget.clone());
            InputState::new(
                declared.clone(),
                manifest.limits,
                Arc::clone(handles),
                frame_pool,
                blank,
            )
        };
        Ok(manifest.inputs.iter().map(source).collect())
    }

    fn models(&self, manifest: &Manifest) -> Result<Vec<DeclaredModel>, Error> {
        let names = || manifest.models.iter().map(|model| model.name.as_str());
        if let Some((asked, _)) =
            self.models.iter().find(|(asked, _)| names().all(|name| name != asked))
        {
            let help = format!("the manifest has {}", quoted(names()));
            return Err(Error::new(format!("no model `{asked}` for answers"), "", help));
        }
        let declared = |model: &manifest::Model| {
            let answers = self.models.iter().rev().find(|(name, _)| *name == model.name);
            DeclaredModel {
                name: model.name.clone(),
                has_layout: model.has_layout,
                answers: answers.map(|(_, answers)| answers.clone()),
            }
        };
        Ok(manifest.models.iter().map(declared).collect())
    }
}

/// A value for [`Host::set`]; converted from `bool`, `i32`, `i64`, `f64` and `&str`.
#[derive(Clone, Debug)]
pub struct Setting(ConfigValue);

conversions! {
    Setting:
    bool => |value| ConfigValue::Boolean(value),
    i32 => |value| ConfigValue::Integer(value.into()),
    i64 => |value| ConfigValue::Integer(value),
    f64 => |value| ConfigValue::Real(value),
    &str => |value| ConfigValue::Text(value.to_owned()),
}

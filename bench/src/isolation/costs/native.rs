//! The lambdas of the comparison as native functions in the runtime's process.
//!
//! Included: the same arithmetic as in the component, compiled for this processor's baseline, and
//! the same host functions, called directly: rings, fields, frames, triggers. Not included: a
//! component, its memory, fuel, epochs, handles. A defect would end the process.

use std::fmt::Display;
use std::sync::Arc;

use gleaner_host::api::Session;
use gleaner_host::api::data::{DataError, Field, Sample, Topic, Wake};
use gleaner_host::api::trigger::{Attribute, AttributeValue, TriggerError};
use gleaner_host::guest::{Guest, LambdaEngine, WakeOutcome};
use gleaner_lambda::manifest::ConfigValue;
use gleaner_lambda::{Fault, FaultKind};
use gleaner_sdk::kernels::fft::SpectrumError;
use imu_fft::road::{Road, Roughness};

use crate::native_rules::{BRAKE_WINDOW_NS, REFRACTORY_NS, braking};

/// A guest that is a native function.
pub(super) struct NativeGuest {
    session: Session,
    name: String,
    lambda: Option<NativeLambda>,
}

enum NativeLambda {
    ImuFft { imu: Arc<Topic>, vertical: Field, rough: f64, road: Box<Road> },
    BrakeDark { imu: Arc<Topic>, forward: Field, brake_mps2: f64, dark_luma: f64, last_ns: i64 },
}

struct Failed(Fault);

impl NativeGuest {
    /// The native version of the lambda `name`.
    pub(super) fn new(name: &str, session: Session) -> Self {
        Self { session, name: name.to_owned(), lambda: None }
    }

    fn load(&self) -> Result<NativeLambda, Failed> {
        let imu = self.session.input("imu")?;
        let config = self.session.config();
        let real = |key: &str| {
            let found = config.iter().find(|(name, _)| name == key);
            match found {
                Some((_, ConfigValue::Float(value))) => Ok(*value),
                _ => Err(Failed::because(format!("no number `{key}` in the configuration"))),
            }
        };
        Ok(match self.name.as_str() {
            "imu-fft" => NativeLambda::ImuFft {
                vertical: imu.field("linear_acceleration.z")?,
                rough: real("rough")?,
                road: Box::new(Road::new(real("window_s")?)),
                imu,
            },
            "brake-dark" => NativeLambda::BrakeDark {
                forward: imu.field("linear_acceleration.x")?,
                brake_mps2: real("brake_mps2")?,
                dark_luma: real("dark_luma")?,
                last_ns: i64::MIN / 2,
                imu,
            },
            other => return Err(Failed::because(format!("`{other}` has no native version"))),
        })
    }

    fn on_event(&mut self, sample: &Sample) -> Result<(), Failed> {
        let event = |label, score, (key, value): (&str, f64)| {
            let attribute = Attribute { key: key.to_owned(), value: AttributeValue::Real(value) };
            self.session.event(label, score, vec![attribute])
        };
        match &mut self.lambda {
            None => Err(Failed::because("woken before init")),
            Some(NativeLambda::ImuFft { imu, vertical, rough, road }) => {
                let Some(samples) = road.note(sample.stamps().at_ns)? else { return Ok(()) };
                let window = imu.column(vertical, samples)?;
                if window.values.len() < samples {
                    return Ok(());
                }
                let Roughness { score, peak_hz } = road.roughness(&window.at_ns, &window.values)?;
                if score > *rough {
                    event("rough-road", score, ("peak_hz", peak_hz))?;
                }
                Ok(())
            }
            Some(NativeLambda::BrakeDark { imu, forward, brake_mps2, dark_luma, last_ns }) => {
                let now = self.session.now_ns();
                let window = imu.column_since(forward, now - BRAKE_WINDOW_NS)?;
                let is_rested = now - *last_ns >= REFRACTORY_NS;
                let braking = braking(&window.at_ns, &window.values, now, *brake_mps2);
                let Some(mean) = braking.filter(|_| is_rested) else { return Ok(()) };
                let luma = sample.as_frame()?.mean_luma(None)?;
                if luma < *dark_luma {
                    *last_ns = now;
                    event("brake-dark", -mean, ("luma", luma))?;
                }
                Ok(())
            }
        }
    }
}

impl Guest for NativeGuest {
    fn init(&mut self) -> Result<(), Fault> {
        self.lambda = Some(self.load().map_err(|failed| failed.0)?);
        Ok(())
    }

    fn wake(&mut self, wake: Wake) -> WakeOutcome {
        let result = match wake {
            Wake::Event(sample) => self.on_event(&sample),
            Wake::Tick(_) => Ok(()),
        };
        let result = result.map_err(|failed| failed.0);
        WakeOutcome { result, fuel: None, run_ns: None, model_ns: None }
    }

    fn engine(&self) -> LambdaEngine {
        LambdaEngine { name: "native".to_owned(), models: Vec::new() }
    }
}

impl Failed {
    fn because(why: impl Display) -> Self {
        let message = why.to_string();
        Self(Fault { kind: FaultKind::Exception, message, used: None, allowed: None })
    }
}

impl From<DataError> for Failed {
    fn from(error: DataError) -> Self {
        Self::because(error)
    }
}

impl From<TriggerError> for Failed {
    fn from(error: TriggerError) -> Self {
        Self::because(error)
    }
}

impl From<SpectrumError> for Failed {
    fn from(error: SpectrumError) -> Self {
        Self::because(error)
    }
}

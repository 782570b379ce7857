//! The trait that a lambda implements, and its export as a component.

use std::cell::RefCell;

use crate::data::{Sample, Tick};
use crate::world::gleaner::lambda::data::Wake;
use crate::world::{ConfigEntry, Guest};
use crate::{Config, Error, Result};

/// A lambda. The host calls its methods, one at a time.
///
/// An `Err` or a panic is a fault of that wake. The decision contains it, and before the next wake
/// the host calls [`Lambda::init`] of a fresh instance.
pub trait Lambda: Sized + 'static {
    /// Creates the lambda: before the first wake, and again before the next wake after a fault.
    /// Look up inputs and compile fields here.
    ///
    /// # Errors
    ///
    /// An error before the first wake ends the lambda with that message; a later one is a fault of
    /// the wake.
    fn init(config: &Config) -> Result<Self>;

    /// Called for each new sample on the input that `[schedule] event` names.
    ///
    /// # Errors
    ///
    /// An error is a fault of this wake.
    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let _ = sample;
        Err(Error::new("the schedule has an event, but the lambda has no `on_event`"))
    }

    /// Called at the end of each `[schedule] period`.
    ///
    /// # Errors
    ///
    /// An error is a fault of this wake.
    fn on_tick(&mut self, tick: Tick) -> Result<()> {
        let _ = tick;
        Err(Error::new("the schedule has a period, but the lambda has no `on_tick`"))
    }
}

/// Keeps the one lambda of a component between wakes. Used by [`lambda!`](crate::lambda!).
#[doc(hidden)]
pub trait Instance: Lambda {
    /// Calls `run` with the cell that holds the lambda.
    fn with_instance<R>(run: impl FnOnce(&RefCell<Option<Self>>) -> R) -> R;
}

#[doc(hidden)]
pub struct Exported<T>(std::marker::PhantomData<T>);

impl<T: Instance> Guest for Exported<T> {
    fn init(config: Vec<ConfigEntry>) -> std::result::Result<(), String> {
        let lambda = T::init(&Config::from(config)).map_err(|error| error.to_string())?;
        T::with_instance(|instance| instance.replace(Some(lambda)));
        Ok(())
    }

    fn on_wake(wake: Wake) -> std::result::Result<(), String> {
        T::with_instance(|instance| {
            let mut instance = instance.borrow_mut();
            let lambda = instance.as_mut().ok_or("woken before init")?;
            match wake {
                Wake::Event(sample) => lambda.on_event(sample.into()),
                Wake::Tick(tick) => lambda.on_tick(tick),
            }
            .map_err(|error| error.to_string())
        })
    }
}

/// Exports a [`Lambda`] as the lambda of this component. Use it once, at the end of the crate.
#[macro_export]
macro_rules! lambda {
    ($lambda:ty) => {
        impl $crate::Instance for $lambda {
            fn with_instance<R>(run: impl FnOnce(&::std::cell::RefCell<Option<Self>>) -> R) -> R {
                ::std::thread_local! {
                    static LAMBDA: ::std::cell::RefCell<Option<$lambda>> =
                        const { ::std::cell::RefCell::new(None) };
                }
                LAMBDA.with(run)
            }
        }

        const _: () = {
            type Exported = $crate::Exported<$lambda>;
            $crate::world::export_lambda!(Exported);
        };
    };
}

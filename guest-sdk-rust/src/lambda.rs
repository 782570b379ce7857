//! The trait that a lambda implements, and how it becomes a component.

use std::cell::RefCell;

use crate::bindings::gleaner::lambda::data::Wake;
use crate::bindings::{ConfigEntry, Guest};
use crate::data::{Sample, Tick};
use crate::{Config, Error, Result};

/// A lambda. The methods are called by the host, one at a time.
///
/// An `Err` or a panic is a fault of that wake: it stands in the decision, and the lambda starts
/// afresh with [`Lambda::init`] at the next wake.
pub trait Lambda: Sized + 'static {
    /// Makes the lambda. Find inputs and compile fields here: it is called once, and wakes are
    /// many.
    ///
    /// # Errors
    ///
    /// An error ends the start with its message.
    fn init(config: &Config) -> Result<Self>;

    /// A new sample arrived on the input that `[schedule] event` names.
    ///
    /// # Errors
    ///
    /// An error is a fault of this wake.
    fn on_event(&mut self, sample: Sample) -> Result<()> {
        let _ = sample;
        Err(Error::new("the schedule has an event, but the lambda has no `on_event`"))
    }

    /// The period of `[schedule] period` is over.
    ///
    /// # Errors
    ///
    /// An error is a fault of this wake.
    fn on_tick(&mut self, tick: Tick) -> Result<()> {
        let _ = tick;
        Err(Error::new("the schedule has a period, but the lambda has no `on_tick`"))
    }
}

/// Holds the one lambda of a component between wakes. Used by [`lambda!`](crate::lambda!).
#[doc(hidden)]
pub trait Instance: Lambda {
    /// The place where it is held.
    fn held<R>(run: impl FnOnce(&RefCell<Option<Self>>) -> R) -> R;
}

#[doc(hidden)]
pub struct Exported<T>(std::marker::PhantomData<T>);

impl<T: Instance> Guest for Exported<T> {
    fn init(config: Vec<ConfigEntry>) -> std::result::Result<(), String> {
        let lambda = T::init(&Config::from(config)).map_err(|error| error.to_string())?;
        T::held(|held| held.replace(Some(lambda)));
        Ok(())
    }

    fn on_wake(wake: Wake) -> std::result::Result<(), String> {
        T::held(|held| {
            let mut held = held.borrow_mut();
            let lambda = held.as_mut().ok_or("woken before init")?;
            match wake {
                Wake::Event(sample) => lambda.on_event(sample.into()),
                Wake::Tick(tick) => lambda.on_tick(tick),
            }
            .map_err(|error| error.to_string())
        })
    }
}

/// Exports a [`Lambda`] as the component's own. Call it once, at the end of the crate.
#[macro_export]
macro_rules! lambda {
    ($lambda:ty) => {
        impl $crate::Instance for $lambda {
            fn held<R>(run: impl FnOnce(&::std::cell::RefCell<Option<Self>>) -> R) -> R {
                ::std::thread_local! {
                    static LAMBDA: ::std::cell::RefCell<Option<$lambda>> = const { ::std::cell::RefCell::new(None) };
                }
                LAMBDA.with(run)
            }
        }

        const _: () = {
            type Exported = $crate::Exported<$lambda>;
            $crate::bindings::export_lambda!(Exported);
        };
    };
}

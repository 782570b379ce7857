//! What stands natively where wit-bindgen's code stands in a component: the same names, over the
//! fake host beside this file.
//!
//! The SDK is written against both, so a name that is missing in one of them fails a build.

/// The interfaces, as wit-bindgen puts them.
pub(crate) mod gleaner {
    pub(crate) mod lambda {
        pub(crate) use crate::testing::{data, inference, log, scratch, trigger, types};
    }
}

use self::gleaner::lambda::data::Wake;

/// One value of `[config]`, by its name.
#[derive(Clone, Debug)]
pub struct ConfigEntry {
    pub(crate) key: String,
    pub(crate) value: ConfigValue,
}

/// The value itself.
#[derive(Clone, Debug, PartialEq)]
#[allow(missing_docs)]
pub enum ConfigValue {
    Boolean(bool),
    Integer(i64),
    Real(f64),
    Text(String),
}

/// What a component exports.
#[allow(missing_docs, clippy::missing_errors_doc)]
pub trait Guest {
    fn init(config: Vec<ConfigEntry>) -> Result<(), String>;
    fn on_wake(wake: Wake) -> Result<(), String>;
}

/// Natively nobody looks for exports; that they could be made is checked.
#[doc(hidden)]
#[macro_export]
macro_rules! __export_lambda_natively {
    ($exported:ident) => {
        const _: fn() = || {
            fn is_guest<T: $crate::bindings::Guest>() {}
            is_guest::<$exported>();
        };
    };
}
pub use crate::__export_lambda_natively as export_lambda;

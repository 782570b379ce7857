//! Native replacement of the bindings that wit-bindgen generates for a component: the same names,
//! over the fake host in this folder. The data types are those that it generates.
//!
//! The SDK is written against both, so a name that is missing in one of them fails a build.

/// The interfaces, in the modules in which wit-bindgen puts them.
pub(crate) mod gleaner {
    pub(crate) mod lambda {
        pub(crate) use crate::bindings::gleaner::lambda::types;
        pub(crate) use crate::testing::{data, inference, log, scratch, trigger};
    }
}

use self::gleaner::lambda::data::Wake;
pub use crate::bindings::{ConfigEntry, ConfigValue};

/// Functions that a component exports.
#[allow(missing_docs, clippy::missing_errors_doc)]
pub trait Guest {
    fn init(config: Vec<ConfigEntry>) -> Result<(), String>;
    fn on_wake(wake: Wake) -> Result<(), String>;
}

/// Checks that the type can be exported; natively nothing is exported.
#[doc(hidden)]
#[macro_export]
macro_rules! __export_lambda_natively {
    ($exported:ident) => {
        const _: fn() = || {
            fn is_guest<T: $crate::world::Guest>() {}
            is_guest::<$exported>();
        };
    };
}
pub use crate::__export_lambda_natively as export_lambda;

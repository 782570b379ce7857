//! Compiles components with some of the checks that the runtime always has, to measure their cost.

use std::path::Path;

use gleaner_compile::Nans;
use wasmtime::Engine;
use wasmtime::component::Component;

/// Checks that the compiler adds to the code.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct EngineChecks {
    /// Counts fuel.
    pub fuel: bool,
    /// Checks the epoch, by which a deadline ends a call.
    pub epochs: bool,
    /// Makes NaNs canonical.
    pub nans: bool,
}

impl EngineChecks {
    pub const NONE: Self = Self { fuel: false, epochs: false, nans: false };
    pub const FUEL: Self = Self { fuel: true, ..Self::NONE };
    pub const EPOCHS: Self = Self { epochs: true, ..Self::NONE };
    /// Those of the runtime.
    pub const DEFAULT: Self = Self { fuel: true, epochs: true, nans: false };
    pub const NANS: Self = Self { nans: true, ..Self::DEFAULT };

    /// Compiles the component at `path`, on an engine of its own.
    ///
    /// # Panics
    ///
    /// If there is none.
    pub fn compile(self, path: &Path) -> Component {
        let mut config = gleaner_compile::settings(Nans::Native);
        config
            .consume_fuel(self.fuel)
            .epoch_interruption(self.epochs)
            .cranelift_nan_canonicalization(self.nans);
        let engine = Engine::new(&config).expect("an engine");
        Component::from_file(&engine, path).expect("a component; run: cargo xtask bench")
    }
}

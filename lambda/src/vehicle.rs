//! `vehicle.toml`: limits for all lambdas on a vehicle. It is parsed as a manifest is, with the
//! same error messages.

use std::path::Path;

use crate::manifest::{self, Limits, ManifestError};

/// The validated configuration of a vehicle.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Vehicle {
    /// `[limits]`: upper bounds of the limits of each lambda. Limits that the file does not name
    /// are at the maximum of manifests.
    pub limits: Limits,
}

impl Vehicle {
    /// Parses the configuration in `text`. `file` is its name in messages, usually `vehicle.toml`.
    ///
    /// # Errors
    ///
    /// The first problem that is found, with its line: an unknown key, or a value outside of the
    /// range of manifests.
    pub fn parse(text: &str, file: impl AsRef<Path>) -> Result<Vehicle, ManifestError> {
        let file = file.as_ref().display().to_string();
        Ok(Vehicle { limits: manifest::vehicle_limits(text, &file)? })
    }

    /// Loads the configuration from the file `path`.
    ///
    /// # Errors
    ///
    /// As [`parse`](Self::parse), and if it cannot be read, is too long, or is not UTF-8.
    pub fn load(path: impl AsRef<Path>) -> Result<Vehicle, ManifestError> {
        let path = path.as_ref();
        Vehicle::parse(&manifest::read_text(path)?, path)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_base::Explain;

    #[test]
    fn limits_that_a_vehicle_does_not_name_are_at_their_maximum() {
        let vehicle =
            Vehicle::parse("[limits]\nfuel = 10_000_000\nmemory = \"32 MiB\"", "vehicle.toml")
                .unwrap();
        assert_eq!(
            (vehicle.limits.fuel, vehicle.limits.memory),
            (10_000_000, gleaner_base::ByteSize::mib(32))
        );
        assert_eq!(vehicle.limits.deadline, Limits::MAX.deadline);
        assert_eq!(Vehicle::parse("", "vehicle.toml").unwrap().limits, Limits::MAX);
    }

    #[test]
    fn unknown_keys_and_values_out_of_range_are_refused_with_their_line() {
        for (text, problem, help) in [
            (
                "\n[limits]\nfule = 1",
                "vehicle.toml, line 3: unknown key `fule` in [limits]",
                "did you mean `fuel`?",
            ),
            (
                "[limit]",
                "vehicle.toml, line 1: unknown key `limit` at the top level",
                "did you mean `limits`?",
            ),
            (
                "[limits]\nframes = 0",
                "vehicle.toml, line 2: `limits.frames` is 0, below the minimum of 1",
                "give a value from 1 to 4096",
            ),
        ] {
            let error = Vehicle::parse(text, "vehicle.toml").unwrap_err();
            assert_eq!(
                (error.to_string().as_str(), error.help().as_deref()),
                (problem, Some(help))
            );
        }
    }

    #[test]
    fn a_missing_vehicle_file_has_help_of_its_own() {
        let error = Vehicle::load("no/such/vehicle.toml").unwrap_err();
        assert_eq!(error.to_string(), "cannot read `no/such/vehicle.toml`");
        assert_eq!(
            error.help().as_deref(),
            Some("name the vehicle's configuration file; see docs/limits.md")
        );
    }
}

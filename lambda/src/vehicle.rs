//! `vehicle.toml`: what the owner of a vehicle says about all lambdas on it. Read as a manifest is,
//! and refused in the same words.

use std::path::Path;

use crate::manifest::{self, Limits, ManifestError};

/// The configuration of a vehicle, checked.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub struct Vehicle {
    /// `[limits]`: the most that a lambda gets here. What the file does not name is at the maximum
    /// that any lambda may ask for.
    pub limits: Limits,
}

impl Vehicle {
    /// The configuration that `text` holds. `file` is its name in messages, usually `vehicle.toml`.
    ///
    /// # Errors
    ///
    /// The first problem that is found, with its line: an unknown key, or a value that no lambda
    /// could ask for.
    pub fn parse(text: &str, file: impl AsRef<Path>) -> Result<Vehicle, ManifestError> {
        let file = file.as_ref().display().to_string();
        Ok(Vehicle { limits: manifest::vehicle_limits(text, &file)? })
    }

    /// The configuration in the file `path`.
    ///
    /// # Errors
    ///
    /// As [`parse`](Self::parse), and if it cannot be read, is too long, or is no UTF-8.
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
    fn what_a_vehicle_does_not_name_is_at_its_maximum() {
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
    fn what_nobody_knows_or_could_ask_for_is_refused_with_its_line() {
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
    fn a_file_that_is_not_there_is_no_manifest_that_is_not_there() {
        let error = Vehicle::load("no/such/vehicle.toml").unwrap_err();
        assert_eq!(error.to_string(), "cannot read `no/such/vehicle.toml`");
        assert_eq!(error.help().as_deref(), Some("name the configuration of a vehicle"));
    }
}

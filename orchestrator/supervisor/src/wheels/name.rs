//! Names of wheels, whose tags state the interpreters that they fit.

use std::str::FromStr;

use crate::wheels::error::WheelTags;
use crate::wheels::{Interpreter, WheelError};

/// The file name of a wheel.
///
/// Source: the binary distribution format (PEP 427), compatibility tags (PEP 425), and manylinux
/// (PEP 600), whose older names have fixed versions of glibc.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WheelName {
    file: String,
    distribution: String,
    /// Sets of tags, joined by dots: of Python, ABI and platform.
    tags: [String; 3],
}

/// Older names of platforms, with the version of glibc that they need.
const OLDER: [(&str, (u32, u32)); 3] =
    [("manylinux1", (2, 5)), ("manylinux2010", (2, 12)), ("manylinux2014", (2, 17))];

impl FromStr for WheelName {
    type Err = WheelError;

    fn from_str(file: &str) -> Result<Self, WheelError> {
        let parts: Vec<_> = file.strip_suffix(".whl").unwrap_or("").split('-').collect();
        let is_plain = |part: &&str| {
            !part.is_empty()
                && part.chars().all(|c| c.is_ascii_alphanumeric() || "._+!".contains(c))
        };
        if !(5..=6).contains(&parts.len()) || !parts.iter().all(is_plain) {
            return Err(WheelError::Name { name: gleaner_base::excerpt(file) });
        }
        let [.., python, abi, platform] = &parts[..] else { unreachable!("it has five parts") };
        let pieces: Vec<_> = parts[0].split(['.', '_']).filter(|it| !it.is_empty()).collect();
        Ok(Self {
            file: file.to_owned(),
            distribution: pieces.join("-").to_ascii_lowercase(),
            tags: [python, abi, platform].map(|it| (*it).to_owned()),
        })
    }
}

impl WheelName {
    pub fn as_str(&self) -> &str {
        &self.file
    }

    /// Returns the normalised name of its package, for example `ruamel-yaml`.
    pub fn distribution(&self) -> &str {
        &self.distribution
    }

    /// Checks that `interpreter` can use it.
    pub(super) fn check_fits(&self, interpreter: &Interpreter) -> Result<(), WheelError> {
        let [pythons, abis, platforms] = self.tags.each_ref().map(|set| set.split('.'));
        let fits = pythons.flat_map(|python| abis.clone().map(move |abi| (python, abi))).any(
            |(python, abi)| {
                fits_version(python, abi, interpreter)
                    && platforms.clone().any(|it| fits_platform(it, abi, interpreter))
            },
        );
        if fits {
            return Ok(());
        }
        let (wheel, accepted) = (self.tags.join("-"), interpreter.accepted());
        Err(WheelError::Unfit {
            wheel: self.file.clone(),
            interpreter: Box::new(interpreter.clone()),
            source: WheelTags { wheel, accepted },
        })
    }
}

fn fits_version(python: &str, abi: &str, interpreter: &Interpreter) -> bool {
    let (major, minor) = interpreter.version;
    // Of `cp311` and `py3`: the minor version follows the one digit of the major one.
    let version = |prefix: &str| {
        let digits = python.strip_prefix(prefix)?;
        let (of_major, of_minor) = digits.split_at_checked(1)?;
        let of_minor = if of_minor.is_empty() { None } else { Some(of_minor.parse().ok()?) };
        Some((of_major.parse::<u32>().ok()?, of_minor))
    };
    let is_at_most = |found: Option<u32>| found.is_none_or(|found| found <= minor);
    match (abi, version("cp"), version("py")) {
        ("none", Some(found), _) => found == (major, Some(minor)),
        ("none", _, Some((of_major, of_minor))) => of_major == major && is_at_most(of_minor),
        ("abi3", Some((of_major, Some(of_minor))), _) => {
            of_major == major && is_at_most(Some(of_minor)) && !interpreter.is_free_threaded()
        }
        (abi, Some(found), _) => found == (major, Some(minor)) && abi == interpreter.abi(),
        _ => false,
    }
}

fn fits_platform(platform: &str, abi: &str, interpreter: &Interpreter) -> bool {
    if platform == "any" {
        return abi == "none";
    }
    let Some(name) =
        platform.strip_suffix(&*interpreter.machine).and_then(|it| it.strip_suffix('_'))
    else {
        return false;
    };
    if name == "linux" {
        return true;
    }
    let older = OLDER.iter().find(|(older, _)| *older == name).map(|(_, glibc)| *glibc);
    let newer = || {
        let (major, minor) = name.strip_prefix("manylinux_")?.split_once('_')?;
        Some((major.parse().ok()?, minor.parse().ok()?))
    };
    let needed = older.or_else(newer);
    needed.is_some_and(|needed| interpreter.glibc.is_some_and(|glibc| needed <= glibc))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn interpreter(minor: u32, flags: &str, glibc: Option<(u32, u32)>) -> Interpreter {
        Interpreter {
            program: "/usr/bin/python3".into(),
            version: (3, minor),
            flags: flags.to_owned(),
            machine: "x86_64".to_owned(),
            glibc,
        }
    }

    #[test]
    fn a_wheel_fits_by_version_abi_and_platform() {
        let python = interpreter(11, "", Some((2, 36)));
        // As the package `packaging` answers for this interpreter.
        for (tags, fits) in [
            ("py3-none-any", true),
            ("py2.py3-none-any", true),
            ("py39-none-any", true),
            ("py311-none-any", true),
            ("py312-none-any", false),
            ("py2-none-any", false),
            ("cp311-none-any", true),
            ("cp310-none-any", false),
            ("cp311-cp311-manylinux_2_17_x86_64.manylinux2014_x86_64", true),
            ("cp311-cp311-manylinux_2_36_x86_64", true),
            ("cp311-cp311-manylinux_2_37_x86_64", false),
            ("cp311-cp311-manylinux_2_17_aarch64", false),
            ("cp311-cp311-linux_x86_64", true),
            ("cp311-cp311-manylinux1_x86_64", true),
            ("cp311-cp311-manylinux2010_x86_64", true),
            ("cp311-cp311-musllinux_1_1_x86_64", false),
            ("cp311-cp311-macosx_11_0_arm64", false),
            ("cp311-cp311-win_amd64", false),
            ("cp310-cp310-manylinux2014_x86_64", false),
            ("cp313-cp313-manylinux2014_x86_64", false),
            ("cp36-abi3-manylinux2014_x86_64", true),
            ("cp312-abi3-manylinux2014_x86_64", false),
            ("py3-none-manylinux2014_x86_64", true),
            ("pp310-pypy310_pp73-manylinux2014_x86_64", false),
            ("cp-none-any", false),
            ("py-none-any", false),
            ("cp399999999999-none-any", false),
            ("py3.-none-any", true),
            ("cp311-cp311-manylinux_2_x86_64", false),
            ("cp311-cp311-manylinux_99999999999_0_x86_64", false),
            ("cp311-cp311-_x86_64", false),
        ] {
            let name: WheelName = format!("Some.thing_x-1.0+local-{tags}.whl").parse().unwrap();
            assert_eq!(name.distribution(), "some-thing-x");
            assert_eq!(name.check_fits(&python).is_ok(), fits, "{tags}");
        }
    }

    #[test]
    fn a_free_threaded_interpreter_takes_only_wheels_for_it() {
        let python = interpreter(13, "t", Some((2, 36)));
        for (tags, fits) in [
            ("cp313-cp313t-manylinux2014_x86_64", true),
            ("cp313-cp313-manylinux2014_x86_64", false),
            ("cp39-abi3-manylinux2014_x86_64", false),
            ("py3-none-any", true),
        ] {
            let name: WheelName = format!("x-1-2build-{tags}.whl").parse().unwrap();
            assert_eq!(name.check_fits(&python).is_ok(), fits, "{tags}");
        }
    }

    #[test]
    fn a_refusal_names_the_wheel_its_tags_the_interpreter_and_the_way_out() {
        let name: WheelName = "numpy-2.1.0-cp311-cp311-manylinux2014_aarch64.whl".parse().unwrap();
        let error = name.check_fits(&interpreter(13, "", Some((2, 41)))).unwrap_err();
        let text = gleaner_base::Failure::from(error).to_string();
        for part in [
            "wheel `numpy-2.1.0-cp311-cp311-manylinux2014_aarch64.whl` does not fit Python 3.13",
            "`/usr/bin/python3`",
            "its tags are cp311-cp311-manylinux2014_aarch64",
            "cp313",
            "manylinux_2_41_x86_64",
            "--python-version 3.13 --python-platform manylinux_2_41_x86_64",
        ] {
            assert!(text.contains(part), "{text}");
        }
        // Without glibc, only wheels for any platform fit.
        assert!(name.check_fits(&interpreter(11, "", None)).is_err());
    }

    #[test]
    fn a_name_that_is_no_wheels_is_refused() {
        for name in
            ["", "x.whl", "x-1-py3-none.whl", "x-1-py3-none-any.zip", "../x-1-py3-none-any.whl"]
        {
            assert!(name.parse::<WheelName>().is_err(), "{name}");
        }
        let capitals = "x-1-py3-none-any.WHL".parse::<WheelName>().unwrap_err();
        let text = gleaner_base::Failure::from(capitals).to_string();
        for part in ["`x-1-py3-none-any.WHL` is not the name", "-PLATFORM.whl`"] {
            assert!(text.contains(part), "{text}");
        }
    }
}

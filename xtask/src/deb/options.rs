//! Options of `cargo xtask deb` and `cargo xtask dist`.

use std::ffi::OsString;
use std::path::PathBuf;

use gleaner_base::{Exit, Failure};

use crate::architecture::Architecture;

/// Options of both commands, of which each takes some.
#[derive(Debug, PartialEq, Eq)]
pub(crate) struct PackageOptions {
    pub(crate) architecture: Architecture,
    pub(crate) out: Option<PathBuf>,
    pub(crate) programs: Option<PathBuf>,
    pub(crate) install: bool,
    pub(crate) test: bool,
}

impl PackageOptions {
    pub(crate) fn parse(arguments: &[OsString], usage: &str) -> Result<Self, Failure> {
        let refuse = |message: &str, help: &str| Failure::new(Exit::Usage, message).with_help(help);
        let unknown = || refuse("the command does not take these arguments", usage);
        let architecture = Architecture::of_this_machine();
        let mut options =
            Self { architecture, out: None, programs: None, install: false, test: false };
        let mut arguments = arguments.iter();
        while let Some(argument) = arguments.next() {
            let option = argument.to_str().filter(|it| usage.contains(&format!("[{it}")));
            let mut value = || arguments.next().ok_or_else(unknown);
            match option {
                Some("--install") => options.install = true,
                Some("--test") => options.test = true,
                Some("--out") => options.out = Some(value()?.into()),
                Some("--programs") => options.programs = Some(value()?.into()),
                Some(option @ ("--arch" | "--target")) => {
                    let name = value()?;
                    let of =
                        if option == "--arch" { Architecture::name } else { Architecture::machine };
                    let known = Architecture::ALL.into_iter().find(|it| name == of(*it));
                    options.architecture = known.ok_or_else(unknown)?;
                }
                _ => return Err(unknown()),
            }
        }
        let is_foreign = !options.architecture.is_of_this_machine();
        // There is a cross compiler for ARM only.
        if is_foreign && options.architecture != Architecture::Arm64 && options.programs.is_none() {
            let help = "build them elsewhere, and name their folder with --programs DIR";
            return Err(refuse("this machine builds no programs for x86-64", help));
        }
        if is_foreign && options.test {
            let message = "a package of another architecture cannot be tested on this machine";
            return Err(refuse(message, usage));
        }
        Ok(options)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DEB: &str = "[--arch ARCH] [--programs DIR] [--test]";
    const DIST: &str = "[--target ARCH] [--out DIR] [--programs DIR] [--install]";

    #[test]
    fn each_command_takes_its_options() {
        let parse = |line: &str, usage| {
            let arguments: Vec<_> = line.split_whitespace().map(OsString::from).collect();
            PackageOptions::parse(&arguments, usage).ok()
        };
        let own = parse("", DEB).unwrap();
        assert_eq!(own.architecture, Architecture::of_this_machine());
        assert_eq!((own.programs, own.test), (None, false));
        let built = parse("--arch arm64 --programs built", DEB);
        assert_eq!(built, parse("--target aarch64 --programs built", DIST));
        let built = built.unwrap();
        assert_eq!(built.architecture, Architecture::Arm64);
        assert_eq!(built.programs, Some("built".into()));
        let options = parse("--target aarch64 --out here --install", DIST).unwrap();
        assert_eq!((options.out, options.install), (Some("here".into()), true));
        for wrong in ["--arch", "--arch mips", "--programs", "amd64", "--install", "--out x"] {
            assert_eq!(parse(wrong, DEB), None, "{wrong}");
        }
        for wrong in ["--target", "--target arm64", "--out", "aarch64", "--test"] {
            assert_eq!(parse(wrong, DIST), None, "{wrong}");
        }
    }
}

//! Fetches the wheels that the requirements.txt of a Python lambda locks.
//!
//! `pip` does that, as it resolves platforms, indexes and credentials. It gets only what
//! `requirements` has read, runs no code of a wheel and builds nothing, and is not that of the
//! lambda's own environment, whose code is untrusted. Each wheel is then checked as a vehicle will
//! check it. Wheels of the former build are used again if requirements and target are the same.

use std::fs::{self, File};
use std::io::{self, ErrorKind};
use std::path::Path;

use gleaner_base::programs::InstalledPrograms;
use gleaner_base::text::shell_word;
use gleaner_base::{PlainFile, hex};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::{BuildDir, REQUIREMENTS, SOURCE_MAX};
use gleaner_supervisor::wheels::WHEELS;
use sha2::{Digest, Sha256};

use super::error::{BuildError, failed};
use super::folder::PartialBuild;
use super::{pip, requirements};
use crate::args::BuildArgs;

/// Oldest minor version of glibc of which wheels are considered, and names of older ones.
const GLIBC_OLDEST: u32 = 17;
const OLDER_PLATFORMS: [&str; 5] =
    ["manylinux2014", "manylinux2010", "manylinux1", "manylinux_2_12", "manylinux_2_5"];

/// Adds the wheels of a lambda, if it has a requirements.txt, to a build. A copy of that file shows
/// what they were fetched for.
pub(super) fn add(args: &BuildArgs, partial: &mut PartialBuild) -> Result<(), BuildError> {
    let path = args.lambda.join(REQUIREMENTS);
    let read = PlainFile::inside(&args.lambda, Path::new(REQUIREMENTS), SOURCE_MAX);
    let text = match read.and_then(PlainFile::read_whole) {
        Err(error) if error.kind() == ErrorKind::NotFound => return Ok(()),
        read => read.map_err(failed("read", &path))?,
    };
    let text = requirements::parse(&text);
    let text = text.map_err(|it| BuildError::Requirement { path: path.clone(), it })?;
    let python = InstalledPrograms::find()
        .and_then(|it| it.python(None))
        .map_err(BuildError::InstalledPrograms)?;
    let platforms = args.python_platform.as_deref().map_or(Ok(Vec::new()), platforms)?;
    let [version, platform] = [&args.python_version, &args.python_platform]
        .map(|it| it.clone().unwrap_or_else(|| format!("that of {}", python.display())));
    let target = gleaner_base::visible(&format!("# version: {version}, platform: {platform}"));
    let lock = format!("{target}\n{text}").into_bytes();

    let folder = partial.path().join(WHEELS);
    let former = BuildDir::of(&args.lambda);
    fs::create_dir(&folder).map_err(failed("create", &folder))?;
    if !reuse(&former, &lock, &folder).is_ok_and(|is_complete| is_complete) {
        fs::remove_dir_all(&folder).map_err(failed("remove", &folder))?;
        fs::create_dir(&folder).map_err(failed("create", &folder))?;
        let mut options: Vec<_> = platforms.iter().flat_map(|it| ["--platform", it]).collect();
        options.extend(args.python_version.iter().flat_map(|it| ["--python-version", it]));
        pip::download(&python, &text, &options, &folder, args.sandboxed)?;
    }
    check(&folder, text.as_bytes(), &path, partial)?;
    let copy = folder.join(REQUIREMENTS);
    fs::write(&copy, &lock).map_err(failed("write", &copy))?;
    partial.count(lock.len() as u64)
}

/// Returns a note if this machine has no environment for a lambda with wheels; else an empty text.
pub(super) fn note(dir: &Path, build: &BuildDir) -> String {
    let has_wheels = build.path().join(WHEELS).is_dir();
    if !has_wheels || dir.join(".venv").exists() {
        return String::new();
    }
    let [venv, pip] = [".venv", ".venv/bin/pip"].map(|it| shell_word(&dir.join(it)));
    // Not that of the author, which pip would read in its own way.
    let lock = shell_word(&build.path().join(WHEELS).join(REQUIREMENTS));
    format!(
        "note: the wheels are for vehicles; for `gleaner replay` and `gleaner run` here: python3 \
         -m venv {venv} && {pip} install --require-hashes -r {lock}\n"
    )
}

/// Copies the wheels of the `former` build to `folder` if that was made for the same `lock`.
/// Returns false if it was not, or if one was changed since.
fn reuse(former: &BuildDir, lock: &[u8], folder: &Path) -> io::Result<bool> {
    let path = Path::new(WHEELS).join(REQUIREMENTS);
    if PlainFile::inside(former.path(), &path, SOURCE_MAX)?.read_whole()? != lock {
        return Ok(false);
    }
    for wheel in gleaner_supervisor::wheels::wheels_of(former).map_err(io::Error::other)? {
        let path = folder.join(wheel.file_name().unwrap_or_default());
        PlainFile::inside(former.path(), &wheel, FILE_MAX)?.copy_to(&mut File::create(&path)?)?;
        if !is_locked(lock, &sha256(PlainFile::result(&path, FILE_MAX)?)?) {
            return Ok(false);
        }
    }
    Ok(true)
}

fn sha256(file: PlainFile) -> io::Result<String> {
    let mut sha256 = Sha256::new();
    io::copy(&mut file.into_file(), &mut sha256)?;
    Ok(hex(&sha256.finalize()))
}

/// Returns whether the requirements in `text` list this digest.
fn is_locked(text: &[u8], sha256: &str) -> bool {
    String::from_utf8_lossy(text).contains(&format!("sha256:{sha256}"))
}

/// Checks the wheels in `folder`: each has a hash of the requirements, and can be unpacked.
fn check(
    folder: &Path,
    text: &[u8],
    requirements: &Path,
    partial: &mut PartialBuild,
) -> Result<(), BuildError> {
    let mut has_numpy = false;
    for entry in fs::read_dir(folder).map_err(failed("list", folder))? {
        let path = entry.map_err(failed("list", folder))?.path();
        let file = PlainFile::result(&path, FILE_MAX).map_err(failed("read", &path))?;
        partial.count(file.length())?;
        let sha256 = sha256(file).map_err(failed("read", &path))?;
        if !is_locked(text, &sha256) {
            let wheel = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
            return Err(BuildError::Unlocked { wheel, sha256, path: requirements.to_owned() });
        }
        let name = gleaner_supervisor::wheels::check(&path).map_err(BuildError::Wheel)?;
        has_numpy |= name.distribution() == "numpy";
    }
    match has_numpy {
        true => Ok(()),
        false => Err(BuildError::NoNumpy { path: requirements.to_owned() }),
    }
}

/// Returns all platforms whose wheels run on `newest`, such as `manylinux_2_28_aarch64`, the newest
/// first. pip takes each name literally.
fn platforms(newest: &str) -> Result<Vec<String>, BuildError> {
    let parse = || {
        let (minor, machine) = newest.strip_prefix("manylinux_2_")?.split_once('_')?;
        let is_word = machine.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
        let minor = minor.parse().ok().filter(|minor| (GLIBC_OLDEST..1000).contains(minor));
        minor.zip(Some(machine).filter(|it| !it.is_empty() && is_word))
    };
    let (minor, machine): (u32, _) =
        parse().ok_or_else(|| BuildError::Platform { text: gleaner_base::excerpt(newest) })?;
    let newer = (GLIBC_OLDEST..=minor).rev().map(|minor| format!("manylinux_2_{minor}_{machine}"));
    let older = OLDER_PLATFORMS.iter().map(|older| format!("{older}_{machine}"));
    Ok(newer.chain(older).chain([format!("linux_{machine}")]).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_platform_includes_all_older_ones_with_their_former_names() {
        let all = platforms("manylinux_2_28_aarch64").unwrap();
        assert_eq!((&*all[0], &*all[11]), ("manylinux_2_28_aarch64", "manylinux_2_17_aarch64"));
        assert!(all.contains(&"manylinux2014_aarch64".to_owned()), "{all:?}");
        assert_eq!(all.len(), 18);
        for text in ["", "linux_x86_64", "manylinux_2_x_arm", "manylinux_2_28_", "manylinux_2_9_x"]
        {
            assert!(platforms(text).is_err(), "{text}");
        }
    }
}

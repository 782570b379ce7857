//! Downloads the file of a clip.
//!
//! Names come from the cloud and are checked: `DIR/VEHICLE/NAME.mcap` cannot lead out of `DIR`.
//! Until a file is whole and has the right SHA-256 it is `NAME.mcap.part`, and goes on there. It is
//! locked meanwhile: another download of it waits, and then finds the whole file.

use std::fs::{self, File};
use std::io::{self, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use gleaner_base::{Exit, Failure, safe_file};
use gleaner_fleet::AnnouncedFile;
use gleaner_fleet::clips::FleetClip;
use rustix::fs::{CWD, FlockOperation, RenameFlags, flock, renameat_with};

use super::export::TABLE;
use crate::vehicle::VehicleClient;

pub(super) struct ClipTarget<'c> {
    clip: &'c FleetClip,
    sha256: &'c str,
    file: PathBuf,
}

impl<'c> ClipTarget<'c> {
    pub(super) fn of(folder: &Path, clip: &'c FleetClip) -> Result<Self, Failure> {
        let sha256 = clip.facts.sha256.as_deref().ok_or_else(|| {
            Failure::new(Exit::Internal, format!("the cloud has no SHA-256 of clip `{}`", clip.id))
        })?;
        // The parts of an id have no separators, and do not begin with a dot.
        let vehicle = match clip.id.vehicle() {
            // No name of a vehicle has the last character.
            TABLE => format!("{TABLE}~"),
            vehicle => vehicle.to_owned(),
        };
        let file = folder.join(vehicle).join(format!("{}.mcap", clip.id.name()));
        Ok(Self { clip, sha256, file })
    }

    /// Returns the path of the file, once it is there: downloaded, or from an earlier time.
    pub(super) fn fetch(&self, client: &VehicleClient) -> Result<PathBuf, Failure> {
        let shown = self.file.display();
        let failed = |error: io::Error| {
            Failure::caused_by(Exit::Usage, format!("cannot write `{shown}`"), &error)
                .with_help("choose another folder with --to DIR, or make room")
        };
        let folder = self.file.parent().unwrap_or(Path::new("."));
        safe_file::folder(folder).map_err(failed)?;
        if self.is_there()? {
            return Ok(self.file.clone());
        }
        let part = self.file.with_extension("mcap.part");
        let mut file = locked(&part).map_err(failed)?;
        if self.is_there()? {
            fs::remove_file(&part).map_err(failed)?;
            return Ok(self.file.clone());
        }
        let mut from = file.metadata().map_err(failed)?.len();
        if from > self.clip.facts.bytes {
            file.set_len(0).map_err(failed)?;
            from = 0;
        }
        let (mut left, mut is_longer) = (self.clip.facts.bytes - from, false);
        if left > 0 {
            let path = format!("/v1/clips/{}/file", self.clip.id);
            let done = client.download(&path, from, |piece| {
                left = left.checked_sub(piece.len() as u64).ok_or_else(|| {
                    is_longer = true;
                    self.refused("it is longer")
                })?;
                file.write_all(piece).map_err(failed)
            });
            if is_longer {
                fs::remove_file(&part).map_err(failed)?;
            }
            done?;
        }
        file.sync_all().map_err(failed)?;
        if let Err(reason) = self.compare(&part).map_err(failed)? {
            fs::remove_file(&part).map_err(failed)?;
            return Err(self.refused(&reason));
        }
        // An existing file is never replaced.
        renameat_with(CWD, &part, CWD, &self.file, RenameFlags::NOREPLACE)
            .map_err(|error| failed(error.into()))?;
        Ok(self.file.clone())
    }

    /// Returns whether the whole file is there, by another download or from an earlier time.
    fn is_there(&self) -> Result<bool, Failure> {
        if self.file.symlink_metadata().is_err() {
            return Ok(false);
        }
        let shown = self.file.display();
        let compared = self.compare(&self.file).map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("cannot read `{shown}`"), &error)
        })?;
        compared.map(|()| true).map_err(|reason| {
            let message = format!("`{shown}` exists, and is another file");
            Failure { causes: vec![reason], ..Failure::new(Exit::Usage, message) }
                .with_help("choose another folder with --to DIR")
        })
    }

    fn refused(&self, reason: &str) -> Failure {
        let message = format!("the cloud sent another file than clip `{}`", self.clip.id);
        Failure { causes: vec![reason.to_owned()], ..Failure::new(Exit::Denied, message) }
            .with_help("run this again")
    }

    fn compare(&self, path: &Path) -> io::Result<Result<(), String>> {
        let announced = AnnouncedFile::new(self.clip.facts.bytes);
        announced.compare(self.sha256, safe_file::read(path)?)
    }
}

/// Opens a file for appending, and waits until no other download has it.
fn locked(path: &Path) -> io::Result<File> {
    loop {
        let file = safe_file::append(path)?;
        flock(&file, FlockOperation::LockExclusive)?;
        // The other one has renamed or removed the file that was opened.
        let opened = file.metadata()?;
        let is_same =
            |named: fs::Metadata| (named.dev(), named.ino()) == (opened.dev(), opened.ino());
        if path.symlink_metadata().is_ok_and(is_same) {
            return Ok(file);
        }
    }
}

#[cfg(test)]
mod tests;

//! Downloads a file of a revision from the cloud.
//!
//! Until it is whole and has the right digest, it is `SHA256.partial`. One that breaks off goes on
//! there: after a pause, with the next connection, or after a restart. What it has is never
//! trusted: the whole file is compared at the end, as it is on the disk.

use std::io;
use std::path::PathBuf;
use std::time::Duration;

use futures_util::StreamExt;
use gleaner_base::{ByteSize, Exit, Failure, safe_file};
use gleaner_fleet::AnnouncedFile;
use gleaner_lambda::manifest::Sha256;
use tokio::fs::File;
use tokio::io::AsyncWriteExt;
use tokio::time::sleep;

use super::http::CloudHttp;

/// Number of attempts, each of which goes on where the one before broke off. Later ones follow with
/// the next look at what the cloud wants.
const ATTEMPTS: u32 = 5;
/// Pause after the first attempt; it doubles.
const PAUSE: Duration = Duration::from_secs(1);

pub(super) struct Download<'d> {
    pub(super) http: &'d CloudHttp,
    pub(super) sha256: &'d Sha256,
    /// Its length, as it was signed.
    pub(super) length: u64,
    pub(super) target: PathBuf,
}

/// The end of an attempt that did not bring the whole file.
enum Broken {
    /// The next attempt may go on.
    Off(Failure),
    /// There is no use in another attempt now.
    Final(Failure),
}

impl Download<'_> {
    /// Downloads the file, unless the cloud cannot be reached, sends another file or breaks off too
    /// often, or the file cannot be written.
    pub(super) async fn run(&self) -> Result<(), Failure> {
        self.run_with(PAUSE).await
    }

    async fn run_with(&self, mut pause: Duration) -> Result<(), Failure> {
        for _ in 1..ATTEMPTS {
            match self.attempt().await {
                Ok(()) => return Ok(()),
                Err(Broken::Final(failure)) => return Err(failure),
                Err(Broken::Off(failure)) => {
                    tracing::debug!("a download broke off: {failure}");
                    sleep(pause).await;
                    pause *= 2;
                }
            }
        }
        self.attempt().await.map_err(|broken| match broken {
            Broken::Final(failure) => failure,
            Broken::Off(mut failure) => {
                let partial = self.target.with_extension("partial");
                let here = partial.metadata().map_or(0, |file| file.len());
                let (here, all) = (ByteSize::new(here), ByteSize::new(self.length));
                failure.causes.push(format!("{here} of {all} are here; it goes on there"));
                failure
            }
        })
    }

    async fn attempt(&self) -> Result<(), Broken> {
        let failed = |error: io::Error| Broken::Final(self.failed(&error));
        let partial = self.target.with_extension("partial");
        let opened = safe_file::append(&partial).and_then(|file| {
            // Of another vehicle's disk, or damaged.
            let length = file.metadata()?.len();
            let from = if length > self.length { 0 } else { length };
            file.set_len(from)?;
            Ok((file, from))
        });
        let (file, began) = opened.map_err(failed)?;
        let (mut file, mut length) = (File::from_std(file), began);
        if began < self.length || self.length == 0 {
            length = self.receive(&mut file, began).await?;
        }
        if length > self.length {
            drop(file);
            std::fs::remove_file(&partial).map_err(failed)?;
            let why = format!("it is longer than {} bytes", self.length);
            return Err(Broken::Final(self.refused(why)));
        }
        // The last write goes on in the background, and only this returns its error.
        file.flush().await.map_err(failed)?;
        file.sync_all().await.map_err(failed)?;
        drop(file);
        if length < self.length {
            let error = io::Error::from(io::ErrorKind::UnexpectedEof);
            return Err(Broken::Off(self.http.unreachable("a download broke off", &error)));
        }
        let (sha256, target) = (self.sha256.clone(), self.target.clone());
        let compared = tokio::task::spawn_blocking(move || {
            let announced = AnnouncedFile::new(length);
            let compared = announced.compare(sha256.as_str(), safe_file::read(&partial)?)?;
            match &compared {
                Ok(()) => std::fs::rename(&partial, target)?,
                Err(_) => std::fs::remove_file(&partial)?,
            }
            Ok(compared)
        });
        match compared.await.map_err(io::Error::other).and_then(|it| it).map_err(failed)? {
            Ok(()) => Ok(()),
            // The part of an earlier attempt may be the damaged one.
            Err(why) if began > 0 => Err(Broken::Off(self.refused(why))),
            Err(why) => Err(Broken::Final(self.refused(why))),
        }
    }

    /// Receives what is missing of the file, of which `from` bytes are here. Returns the bytes that
    /// are here then; of a file that is too long, the first piece above its length is not written.
    async fn receive(&self, file: &mut File, mut from: u64) -> Result<u64, Broken> {
        let failed = |error: io::Error| Broken::Final(self.failed(&error));
        let path = format!("/v1/objects/{}", self.sha256);
        let pieces = self.http.pieces(&path, from, self.length).await;
        let (mut pieces, is_whole) = pieces.map_err(Broken::Final)?;
        if is_whole {
            file.set_len(0).await.map_err(failed)?;
            from = 0;
        }
        while let Some(piece) = pieces.next().await {
            let piece = match piece {
                Ok(piece) => piece,
                Err(error) => {
                    file.flush().await.map_err(failed)?;
                    let what = "a download broke off";
                    return Err(Broken::Off(self.http.unreachable(what, &error)));
                }
            };
            from += piece.len() as u64;
            if from > self.length {
                break;
            }
            file.write_all(&piece).await.map_err(failed)?;
        }
        Ok(from)
    }

    fn failed(&self, error: &io::Error) -> Failure {
        let action = format!("cannot receive the file {}", self.sha256);
        Failure::caused_by(Exit::Internal, action, error)
    }

    fn refused(&self, why: String) -> Failure {
        let message = format!("the file {} is refused", self.sha256);
        let mut failure = Failure::new(Exit::Denied, message);
        failure.causes = vec![why];
        failure
    }
}

#[cfg(test)]
mod tests;

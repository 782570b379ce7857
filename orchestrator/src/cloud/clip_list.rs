//! Reads the list of clips that the recorder writes, and the files in it.
//!
//! Lists and files come from another program: lines are bounded, names have no path in them, and
//! links are refused.

use std::collections::VecDeque;
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

use gleaner_base::{ByteSize, NotPlain, PlainFile, hex, safe_file};
use gleaner_fleet::clips::{
    CLIP_FACTS_MAX, CLIP_MAX, CLIP_REPORT_MAX, CLIPS_IN_REPORT, ClipFacts, ClipMoment, ClipName,
    ClipReport, RecordedLambda, THUMBNAIL_MAX,
};
use gleaner_lambda::Clip;
use gleaner_lambda::manifest::Sha256 as Digest;
use gleaner_trust::{sha256, unverified_deployment, unverified_revision};
use sha2::{Digest as _, Sha256};

use crate::orchestrator::Orchestrator;

/// Longest line of the list, as the recorder writes it.
const LINE_MAX: u64 = 16 << 20;
/// Bytes of clips that are read for one report, so that it does not wait for many long ones.
const READ_MAX: u64 = 256 << 20;
/// Bytes that are read per second: the recorder needs the disk.
const READ_RATE: f64 = 64e6;
/// Length of the pieces in which a clip is read.
const PIECE: usize = 1 << 20;

/// The folder of the recorder.
#[derive(Debug, Clone)]
pub(super) struct ClipFolder(pub(super) PathBuf);

/// A build that the vehicle has, with the deployment that it belongs to.
#[derive(Debug)]
pub(super) struct KnownBuild {
    /// SHA-256 over its files, as clips have it.
    digest: String,
    revision: String,
    deployment: String,
}

/// The newest results of reads of clips: SHA-256 or cause. They outlive connections: a clip that
/// takes longer to read than any of these lasts would never be announced otherwise.
pub(super) type ClipReads = VecDeque<(FileIdentity, Result<String, String>)>;

/// Name, length, time of the last change in s and ns, and inode.
type FileIdentity = (ClipName, u64, i64, i64, u64);

/// A position in the list: the number of bytes before it, and the last line of these.
struct ListPosition {
    offset: u64,
    line: u64,
    sha256: String,
}

impl ListPosition {
    fn parse(text: &str) -> Option<Self> {
        let mut parts = text.split('-');
        let offset = parts.next()?.parse().ok()?;
        let line = parts.next()?.parse().ok().filter(|line| (1..=LINE_MAX).contains(line))?;
        let sha256 = parts.next()?.to_owned();
        (line <= offset && parts.next().is_none()).then_some(Self { offset, line, sha256 })
    }

    /// Returns whether the list still has the line.
    fn is_in(&self, list: &mut File) -> io::Result<bool> {
        list.seek(SeekFrom::Start(self.offset - self.line))?;
        let mut line = Vec::new();
        list.take(self.line).read_to_end(&mut line)?;
        Ok(line.len() as u64 == self.line && sha256(&line).as_str() == self.sha256)
    }
}

impl ClipFolder {
    fn list(&self) -> PathBuf {
        self.0.join("clips.jsonl")
    }

    /// Returns the length of the list, by which its growth is noticed.
    pub(super) fn length(&self) -> u64 {
        fs::symlink_metadata(self.list()).map_or(0, |found| found.len())
    }

    /// Reads the clips after the position that the cloud has, or at the begin of the list if it is
    /// of another one, or only the one with a name; `None` if there are none. One that cannot be
    /// read has the cause in its facts.
    pub(super) fn clips(
        &self,
        cursor: Option<&str>,
        only: Option<&ClipName>,
        builds: &[KnownBuild],
        reads: &mut ClipReads,
    ) -> io::Result<Option<ClipReport>> {
        let most = if only.is_some() { 1 } else { CLIPS_IN_REPORT };
        let mut list = match safe_file::read(&self.list()) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            list => list?,
        };
        let position = cursor.and_then(ListPosition::parse);
        let mut offset = match position {
            Some(position) if position.is_in(&mut list)? => position.offset,
            _ => 0,
        };
        list.seek(SeekFrom::Start(offset))?;
        let mut lines = BufReader::new(list);
        let mut report = ClipReport::default();
        let (mut read, mut length) = (0, 0);
        while report.clips.len() < most && read < READ_MAX {
            let mut line = Vec::new();
            lines.by_ref().take(LINE_MAX).read_until(b'\n', &mut line)?;
            // The recorder still writes it, or a power cut tore it.
            if !line.ends_with(b"\n") && (line.len() as u64) < LINE_MAX {
                break;
            }
            let clip = serde_json::from_slice::<Clip>(&line).ok();
            let clip = clip.and_then(|clip| Some((name(&clip.file, ".mcap")?, clip)));
            match clip {
                Some((name, _)) if only.is_some_and(|only| *only != name) => {}
                Some((name, clip)) => {
                    let facts = self.facts(name, clip, builds, reads);
                    let bytes = facts.length();
                    if !report.clips.is_empty() && length + bytes > CLIP_REPORT_MAX - CLIP_FACTS_MAX
                    {
                        break;
                    }
                    length += bytes;
                    read += facts.bytes;
                    report.clips.push(facts);
                }
                None => tracing::warn!(offset, "skipped malformed line in clips.jsonl"),
            }
            offset += line.len() as u64;
            report.cursor = Some(format!("{offset}-{}-{}", line.len(), sha256(&line)));
        }
        if only.is_some() {
            report.cursor = None;
        }
        Ok((report != ClipReport::default()).then_some(report))
    }

    fn facts(
        &self,
        name: ClipName,
        clip: Clip,
        builds: &[KnownBuild],
        reads: &mut ClipReads,
    ) -> ClipFacts {
        let mut bytes = clip.bytes.min(CLIP_MAX);
        let read = self.open(&name).and_then(|file| {
            bytes = file.metadata()?.len();
            known_digest(reads, &name, file)
        });
        let (digest, unreadable) = match read {
            Ok(digest) => (Some(digest), None),
            Err(error) if is_gone(&error) => (None, None),
            // A bad block of one file must not keep the others from the cloud.
            Err(error) => (None, Some(error.to_string())),
        };
        let has_image =
            clip.thumbnail.and_then(|path| self::name(&path, ".jpg")) == Some(name.clone());
        let image = if has_image { self.thumbnail(&name).ok() } else { None };
        let lambda = |it: gleaner_lambda::ClipLambda| {
            let build = builds.iter().find(|build| build.digest == it.digest);
            RecordedLambda {
                name: it.name,
                version: it.version,
                digest: it.digest,
                deployment: build.map(|build| build.deployment.clone()),
                revision: build.map(|build| build.revision.clone()),
            }
        };
        let moment = |it: gleaner_lambda::Moment| ClipMoment {
            lambda: it.lambda,
            kind: serde_json::to_value(it.kind)
                .ok()
                .and_then(|kind| kind.as_str().map(str::to_owned))
                .unwrap_or_default(),
            label: it.label,
            score: it.score,
            attributes: it.attributes,
            at_ns: it.at_ns,
            source: it.source,
        };
        let mut facts = ClipFacts {
            name,
            from_ns: clip.from_ns.min(clip.to_ns),
            to_ns: clip.to_ns,
            bytes,
            sha256: digest,
            thumbnail: image.map(|image| sha256(&image).to_string()),
            lambdas: clip.lambdas.into_iter().map(lambda).collect(),
            triggers: clip.triggers,
            moments: clip.moments.into_iter().map(moment).collect(),
            incomplete: clip.incomplete,
            is_recovered: clip.recovered.is_some(),
            unreadable,
        };
        facts.shorten();
        facts
    }

    fn path(&self, name: &ClipName, suffix: &str) -> io::Result<PathBuf> {
        let folder = self.0.join("clips");
        match fs::symlink_metadata(&folder)?.is_dir() {
            true => Ok(folder.join(format!("{name}{suffix}"))),
            false => Err(io::Error::other(NotPlain::NoFile)),
        }
    }

    fn open(&self, name: &ClipName) -> io::Result<File> {
        let path = self.path(name, ".mcap")?;
        #[cfg(test)]
        if path.with_extension("bad").exists() {
            // Reads fail, as they do at a bad block.
            return File::options().write(true).open(path);
        }
        #[cfg(test)]
        while path.with_extension("slow").exists() {
            sleep(Duration::from_millis(1));
        }
        Ok(PlainFile::result(&path, ByteSize::new(CLIP_MAX))?.into_file())
    }

    /// Reads at most `most` bytes of a clip, which has `bytes`, from the byte `begin` on.
    ///
    /// # Errors
    ///
    /// Those of the file system, and one that [`is_gone`] accepts if the file does not have the
    /// expected length any more.
    pub(super) fn piece(
        &self,
        name: &ClipName,
        bytes: u64,
        (begin, most): (u64, u64),
    ) -> io::Result<Vec<u8>> {
        let mut file = self.open(name)?;
        let found = file.metadata()?.len();
        let length = ClipFacts::piece_length(bytes, begin).filter(|_| found == bytes);
        let length = length.ok_or(io::ErrorKind::UnexpectedEof)?.min(most);
        file.seek(SeekFrom::Start(begin))?;
        let mut content = vec![0; length as usize];
        file.read_exact(&mut content)?;
        Ok(content)
    }

    /// Reads the thumbnail of a clip.
    pub(super) fn thumbnail(&self, name: &ClipName) -> io::Result<Vec<u8>> {
        PlainFile::result(&self.path(name, ".jpg")?, ByteSize::new(THUMBNAIL_MAX))?.read_whole()
    }
}

/// Returns the number of bytes before a position in the list.
pub(super) fn offset(cursor: &str) -> Option<u64> {
    ListPosition::parse(cursor).map(|position| position.offset)
}

/// Returns whether an error means that the file is not there any more, or is another one.
pub(super) fn is_gone(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::UnexpectedEof)
        || NotPlain::of(error).is_some()
}

/// Returns the name in `clips/NAME` with this suffix, and nothing else.
fn name(path: &Path, suffix: &str) -> Option<ClipName> {
    path.to_str()?.strip_prefix("clips/")?.strip_suffix(suffix)?.parse().ok()
}

/// Returns the SHA-256 of a file, which is read unless the result is known.
fn known_digest(reads: &mut ClipReads, name: &ClipName, file: File) -> io::Result<String> {
    let found = file.metadata()?;
    let (bytes, inode) = (found.len(), found.ino());
    let identity = (name.clone(), bytes, found.mtime(), found.mtime_nsec(), inode);
    if let Some((_, result)) = reads.iter().find(|(known, _)| *known == identity) {
        return result.clone().map_err(io::Error::other);
    }
    let result = digest(file.take(bytes)).map_err(|error| error.to_string());
    // Those of a report that was not acknowledged stay.
    reads.truncate(2 * CLIPS_IN_REPORT);
    reads.push_front((identity, result.clone()));
    result.map_err(io::Error::other)
}

/// Reads a file slowly; returns its SHA-256.
fn digest(mut file: impl Read) -> io::Result<String> {
    let (mut sha256, mut piece) = (Sha256::new(), vec![0; PIECE]);
    let (begin, mut bytes) = (Instant::now(), 0.0);
    loop {
        let read = file.read(&mut piece)?;
        if read == 0 {
            return Ok(hex(&sha256.finalize()));
        }
        sha256.update(&piece[..read]);
        bytes += read as f64;
        let due = Duration::from_secs_f64(bytes / READ_RATE);
        sleep(due.saturating_sub(begin.elapsed()));
    }
}

pub(super) fn known_builds(core: &Orchestrator) -> Vec<KnownBuild> {
    let deployments = core.lock().state.deployments.clone();
    let mut known = Vec::new();
    for (id, deployed) in deployments {
        let named = unverified_deployment(deployed.envelope.as_bytes()).ok();
        let named =
            named.into_iter().flat_map(|it| std::iter::once(it.revision).chain(it.fallback));
        for revision in named.chain(deployed.history) {
            let digest = core.store.envelope(&revision).ok().and_then(|text| build_digest(&text));
            known.extend(digest.map(|digest| KnownBuild {
                digest,
                revision: revision.to_string(),
                deployment: id.to_string(),
            }));
        }
    }
    known
}

/// Returns the SHA-256 over the files of a revision, as the recorder computes it over a build.
fn build_digest(envelope: &[u8]) -> Option<String> {
    let (revision, _) = unverified_revision(envelope).ok()?;
    let mut files: Vec<(&Path, &Digest)> =
        revision.files.iter().map(|it| (it.path.as_path(), &it.sha256)).collect();
    files.sort();
    let lines = files.iter().map(|(path, sha256)| format!("{sha256}  {}\n", path.display()));
    Some(sha256(lines.collect::<String>().as_bytes()).to_string())
}

#[cfg(test)]
mod tests;

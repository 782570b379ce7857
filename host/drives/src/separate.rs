//! Decides which files are one drive: those of one recording, and those of several recorders of one
//! vehicle.

use std::collections::HashSet;
use std::path::{Path, PathBuf};

use crate::error::ReplayError;
use crate::track::Track;

/// Time in ns by which files of one recording may overlap: a recorder that goes on in another file
/// may write some messages late.
const OVERLAP_MAX: u64 = 1_000_000_000;

/// Time in ns that may pass between two files of one recording.
const PAUSE_MAX: u64 = 5_000_000_000;

/// Returns the drives that files are, in the order of their first files. `recordings` has the path
/// of each recording: a file, or a directory.
///
/// Two recordings are one drive if they overlap in time and have no topic in common, or if one goes
/// on where the other ends, by its time, or by its number and its time. A whole recording without
/// messages is part of the first drive.
///
/// # Errors
///
/// [`ReplayError::Overlap`] if two recordings have the same topic at the same time: their samples
/// would be mixed.
pub fn drives_of(
    tracks: &[Track],
    recordings: &[PathBuf],
) -> Result<Vec<Vec<PathBuf>>, ReplayError> {
    let mut drives = Drives((0..recordings.len()).collect());
    let topics: Vec<HashSet<&str>> = tracks.iter().map(|track| track.topics().collect()).collect();
    let with_times = tracks.iter().position(|track| track.times().is_some()).unwrap_or(0);
    let mut is_empty = vec![false; recordings.len()];
    for (b, track) in tracks.iter().enumerate() {
        if track.times().is_none() && !track.is_damaged() {
            is_empty[track.recording()] = true;
            drives.join(track.recording(), tracks[with_times].recording());
        }
        for (a, other) in tracks[..b].iter().enumerate() {
            let shared = || topics[a].iter().find(|topic| topics[b].contains(*topic));
            match Relation::of(other, track) {
                _ if track.recording() == other.recording() => {}
                Relation::Apart => {}
                Relation::NextFile => drives.join(track.recording(), other.recording()),
                Relation::Overlap { goes_on } => match shared() {
                    Some(topic) if !goes_on => {
                        let [first, second] =
                            [other, track].map(|of| of.path_and_contents().0.to_owned());
                        let topic = (*topic).to_owned();
                        return Err(ReplayError::Overlap { topic, first, second });
                    }
                    _ => drives.join(track.recording(), other.recording()),
                },
            }
        }
    }
    Ok(drives.paths(recordings, &is_empty))
}

enum Relation {
    Apart,
    /// One has the next number of the other, and begins soon after its end.
    NextFile,
    Overlap {
        /// Set if the overlap is short, and neither lies within the other.
        goes_on: bool,
    },
}

impl Relation {
    fn of(a: &Track, b: &Track) -> Self {
        let Some(((a_from, a_to), (b_from, b_to))) = a.times().zip(b.times()) else {
            return Self::Apart;
        };
        let [(first, from, to), (second, next_from, next_to)] = match a_from <= b_from {
            true => [(a, a_from, a_to), (b, b_from, b_to)],
            false => [(b, b_from, b_to), (a, a_from, a_to)],
        };
        // If the end of the first is unknown, nothing is known to overlap.
        if !first.is_end_unknown() && next_from <= to {
            let common = to.min(next_to) - next_from;
            let is_within = next_to <= to && !second.is_end_unknown();
            let goes_on = common == 0 || common <= OVERLAP_MAX && !is_within && from < next_from;
            return Self::Overlap { goes_on };
        }
        let pause = if first.is_end_unknown() { 0 } else { next_from - to };
        let is_next = pause <= PAUSE_MAX && is_next_file(first, second);
        if is_next { Self::NextFile } else { Self::Apart }
    }
}

/// Returns whether two files of a folder differ in a number at the end of their names, by 1.
fn is_next_file(first: &Track, second: &Track) -> bool {
    let [first, second] = [first, second].map(|track| track.path_and_contents().0);
    let Some(((a, n), (b, m))) = numbered(first).zip(numbered(second)) else { return false };
    let folder = |path: &Path| std::fs::canonicalize(path).ok()?.parent().map(Path::to_owned);
    a == b && m.checked_sub(1) == Some(n) && folder(first) == folder(second)
}

/// Splits the file name `drive_12.mcap` into `drive_` and 12.
fn numbered(path: &Path) -> Option<(&str, u64)> {
    let file = path.file_name()?.to_str()?;
    let stem = [".mcap", ".db3"].iter().find_map(|end| file.rfind(end)).map(|end| &file[..end])?;
    let name = stem.trim_end_matches(|letter: char| letter.is_ascii_digit());
    Some((name, stem[name.len()..].parse().ok()?))
}

/// Recordings, each with the first recording of its drive.
struct Drives(Vec<usize>);

impl Drives {
    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.0[a], self.0[b]);
        if a == b {
            return;
        }
        let (first, joined) = (a.min(b), a.max(b));
        self.0.iter_mut().filter(|drive| **drive == joined).for_each(|drive| *drive = first);
    }

    /// Returns the paths of each drive, those of empty recordings last.
    fn paths(self, recordings: &[PathBuf], is_empty: &[bool]) -> Vec<Vec<PathBuf>> {
        let of = |drive: usize| {
            let members = (0..recordings.len()).filter(|member| self.0[*member] == drive);
            let (last, first): (Vec<_>, Vec<_>) = members.partition(|member| is_empty[*member]);
            let all = first.into_iter().chain(last);
            all.map(|member| recordings[member].clone()).collect::<Vec<_>>()
        };
        (0..recordings.len()).map(of).filter(|paths| !paths.is_empty()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_ends_with_the_number_of_its_file() {
        for (path, expected) in [
            ("x_1.mcap/drive_12.mcap", Some(("drive_", 12))),
            ("2024.01_0.db3.zstd", Some(("2024.01_", 0))),
            ("drive.mcap", None),
            ("drive_1.txt", None),
        ] {
            assert_eq!(numbered(Path::new(path)), expected, "{path}");
        }
    }

    #[test]
    fn drives_come_in_the_order_of_their_first_recordings() {
        let paths = ["a", "b", "c", "d"].map(PathBuf::from);
        let mut drives = Drives((0..4).collect());
        drives.join(3, 1);
        drives.join(2, 3);
        let [a, b, c, d] = paths.clone();
        let empty = [false, true, false, false];
        assert_eq!(drives.paths(&paths, &empty), [vec![a], vec![c, d, b]]);
    }
}

//! The decision of a wake that the last process of a run did not live to write. After any other, the next process writes it.

use std::io::{self, Read, Seek, SeekFrom, Write};
use std::path::Path;

use gleaner_protocol::{Decision, Exit, ExitRecord, Failure, Manifest, own_file};

/// Adds it to the decisions in `out`, by the record of how the process ended. None if the process left nothing undecided.
///
/// # Errors
///
/// A failure that names the file.
pub(super) fn add(manifest: &Manifest, out: &Path) -> Result<Option<Decision>, Failure> {
    let record = ExitRecord::read(&out.join(ExitRecord::FILE)).ok();
    let Some(decision) = record.and_then(|record| record.undecided(manifest)) else { return Ok(None) };
    let path = out.join("decisions.jsonl");
    append(&path, &decision)
        .map_err(|error| Failure::caused_by(Exit::Internal, format!("cannot write `{}`", path.display()), &error))?;
    Ok(Some(decision))
}

fn append(path: &Path, decision: &Decision) -> io::Result<()> {
    let mut line = serde_json::to_vec(decision).expect("a decision is plain data");
    line.push(b'\n');
    let mut file = own_file::write(path)?;
    let mut last = [b'\n'];
    if file.seek(SeekFrom::End(0))? > 0 {
        file.seek(SeekFrom::End(-1))?;
        file.read_exact(&mut last)?;
    }
    // The process may have ended in the middle of a line.
    if last != [b'\n'] {
        line.insert(0, b'\n');
    }
    file.write_all(&line)
}

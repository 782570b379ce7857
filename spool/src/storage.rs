//! The file operations that a spool needs, so that tests can let each of them fail.

use std::io;

use crate::SpoolNote;

/// The folder of one stream. Segments are named by their first sequence number. Each operation
/// fails with the errors of the file system.
pub trait SpoolStorage {
    /// An open segment.
    type File: SegmentFile;

    /// Lists first sequence number and length in bytes of all segments, in ascending order.
    ///
    /// # Errors
    ///
    /// Those of the file system, and anything that is not a plain file under the name of a segment.
    fn list(&self) -> io::Result<Vec<(u64, u64)>>;

    /// Lists the first sequence numbers of all segments, in ascending order, for readers. Unlike
    /// [`list`](Self::list), it need not look at each file.
    fn names(&self) -> io::Result<Vec<u64>> {
        Ok(self.list()?.into_iter().map(|(first, _)| first).collect())
    }

    /// Creates the file of the next segment, in place of one that was not published.
    fn create(&self) -> io::Result<Self::File>;

    /// Gives the created file the name of segment `first`, in place of any of that name.
    fn publish(&self, first: u64) -> io::Result<()>;

    /// Opens a segment for reading.
    ///
    /// # Errors
    ///
    /// Those of the file system, and a file that is not plain.
    fn open(&self, first: u64) -> io::Result<Self::File>;

    /// Removes a segment.
    fn remove(&self, first: u64) -> io::Result<()>;

    /// Makes the names of segments durable.
    fn sync_names(&self) -> io::Result<()>;

    /// Returns the first number that the consumer of the stream may still need, of the last
    /// [`release`](Self::release); 0 without one.
    fn released(&self) -> io::Result<u64> {
        Ok(0)
    }

    /// Notes that the consumer has stored all records below `before` elsewhere. A power cut may
    /// take the note.
    fn release(&self, _before: u64) -> io::Result<()> {
        Ok(())
    }

    /// Returns the last [`note`](Self::note) of a writer; `None` without one.
    fn noted(&self) -> io::Result<Option<SpoolNote>> {
        Ok(None)
    }

    /// Writes a note in place of the last one, so that only the first one needs room.
    fn note(&self, _note: &SpoolNote) -> io::Result<()> {
        Ok(())
    }
}

/// An open segment. Each operation fails with the errors of the file system.
pub trait SegmentFile {
    /// Returns the length in bytes.
    fn length(&self) -> io::Result<u64>;

    /// Returns whether the file still has a name: it was neither removed nor replaced.
    fn is_linked(&self) -> io::Result<bool>;

    /// Reads at `offset` as [`std::os::unix::fs::FileExt::read_at`] does; 0 bytes are the end.
    fn read_at(&self, into: &mut [u8], offset: u64) -> io::Result<usize>;

    /// Writes all `bytes` at the end. After an error, a part of them may be in the file.
    fn append(&mut self, bytes: &[u8]) -> io::Result<()>;

    /// Makes content and length durable (`fdatasync`).
    ///
    /// # Errors
    ///
    /// Those of the file system. After one, the content is unknown, and a second call that succeeds
    /// proves nothing: the kernel may have dropped what it could not write.
    fn sync(&self) -> io::Result<()>;
}

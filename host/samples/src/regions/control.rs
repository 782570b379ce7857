//! The control page of a reader, mapped by the reader and the writer.
#![allow(unsafe_code)]

use std::fs::File;
use std::io;
use std::os::fd::{AsFd, BorrowedFd};
use std::ptr::NonNull;
use std::sync::Arc;

use gleaner_buffers::shared::{ControlMemory, ControlPage};
use rustix::fs::{MemfdFlags, SealFlags, fcntl_get_seals, memfd_create};
use rustix::mm::ProtFlags;

use crate::regions::topic::{FileMapping, seal};

/// Seals of a control page: its size stays.
const CONTROL_SEALS: SealFlags = SealFlags::SHRINK.union(SealFlags::GROW).union(SealFlags::SEAL);

/// A mapped control page; clones share the mapping.
#[derive(Clone)]
pub struct ControlRegion(Arc<FileMapping>);

impl ControlRegion {
    /// Creates a page without hazards, and the file to pass to its reader. The kernel adds memory
    /// for the words that are granted, when the writer and the reader attach them.
    ///
    /// # Errors
    ///
    /// The kernel's error, such as out of memory.
    pub fn create() -> io::Result<(Self, File)> {
        let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
        let file = File::from(memfd_create("gleaner-control", flags)?);
        file.set_len(size_of::<ControlPage>() as u64)?;
        seal(&file, CONTROL_SEALS)?;
        Ok((Self::map(file.as_fd())?, file))
    }

    /// Maps the page that another process created.
    ///
    /// # Errors
    ///
    /// [`io::ErrorKind::InvalidData`] if the file has another size or is not sealed; otherwise the
    /// kernel's error.
    pub fn open(file: impl AsFd) -> io::Result<Self> {
        let is_page = rustix::fs::fstat(&file)?.st_size == size_of::<ControlPage>() as i64;
        if !is_page || !fcntl_get_seals(&file)?.contains(CONTROL_SEALS) {
            return Err(io::Error::new(io::ErrorKind::InvalidData, "this is not a control page"));
        }
        Self::map(file.as_fd())
    }

    fn map(file: BorrowedFd<'_>) -> io::Result<Self> {
        let access = ProtFlags::READ | ProtFlags::WRITE;
        let len = size_of::<ControlPage>();
        let mapping = FileMapping::shared(&file, len, access)?;
        // A forked process that drops a sample would clear a hazard of this one.
        mapping.keep_from_children()?;
        Ok(Self(Arc::new(mapping)))
    }
}

// SAFETY: the mapping has the size of a control page, is aligned to a page of memory, and lives as
// long as the value; its file cannot shrink. Its fields are atomics.
unsafe impl ControlMemory for ControlRegion {
    fn page(&self) -> NonNull<ControlPage> {
        self.0.base().cast()
    }
}

#[cfg(test)]
mod tests {
    use gleaner_buffers::shared::{
        HAZARDS, PinLimits, SharedLayout, SharedReader, SharedWriter, in_process,
    };

    use super::*;
    use crate::regions::TopicRegion;

    #[test]
    fn a_page_uses_memory_only_for_words_that_are_granted() {
        let layout = SharedLayout { depth: 1, slots: 4, slot_bytes: 8 };
        let (page, file) = ControlRegion::create().unwrap();
        let present = || rustix::fs::fstat(&file).unwrap().st_blocks * 512;
        assert_eq!(present(), 0);
        for (topics, first_word) in (1..).zip([0, HAZARDS as u32 - 2]) {
            let (memory, reading) = in_process(layout).unwrap();
            let limits = PinLimits { first_word, windows: 0, window: 0, singles: 2 };
            let mut writer = SharedWriter::new(memory);
            writer.attach(page.clone(), limits).unwrap();
            assert_eq!(present(), topics * 4096);
            // SAFETY: the page is attached with these limits, and nothing else stores to it.
            let reader = unsafe { SharedReader::new(&reading, page.clone(), limits) }.unwrap();
            writer.draft(8).unwrap().fill(7);
            writer.publish(&Default::default()).unwrap();
            assert_eq!(*reader.get(0).unwrap().unwrap(), [7; 8]);
        }
        assert_eq!(present(), 2 * 4096);
    }

    #[test]
    fn a_file_that_is_not_a_sealed_page_is_refused() {
        let (_, page) = ControlRegion::create().unwrap();
        assert!(ControlRegion::open(&page).is_ok());
        let unsealed = File::from(memfd_create("test", MemfdFlags::ALLOW_SEALING).unwrap());
        unsealed.set_len(size_of::<ControlPage>() as u64).unwrap();
        let (_, larger) = TopicRegion::create("test", 2 * size_of::<ControlPage>(), 0).unwrap();
        for file in [unsealed.as_fd(), larger.as_fd()] {
            let refused = ControlRegion::open(file).err().unwrap();
            assert_eq!(refused.to_string(), "this is not a control page");
        }
    }
}

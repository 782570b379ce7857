//! The memory of a topic: mapped once for writing, then sealed.
#![allow(unsafe_code)]

use std::ffi::c_void;
use std::fs::File;
use std::io;
use std::os::fd::AsFd;
use std::ptr::{self, NonNull};

use gleaner_buffers::Region;
use gleaner_buffers::shared::ReadRegion;
use rustix::fs::{
    FallocateFlags, MemfdFlags, SealFlags, fallocate, fcntl_add_seals, fcntl_get_seals,
    memfd_create,
};
use rustix::io::Errno;
use rustix::mm::{Advice, MapFlags, ProtFlags, madvise, mmap, munmap};

/// Seals of a topic's file: its size stays, and no further mapping can write it.
const TOPIC_SEALS: SealFlags =
    SealFlags::SHRINK.union(SealFlags::GROW).union(SealFlags::FUTURE_WRITE).union(SealFlags::SEAL);

/// A mapping of a whole file, unmapped when it is dropped.
pub(crate) struct FileMapping {
    base: NonNull<u8>,
    len: usize,
}

impl FileMapping {
    /// Maps the first `len` bytes of `file`, shared with other processes.
    pub(crate) fn shared(file: &impl AsFd, len: usize, access: ProtFlags) -> io::Result<Self> {
        // SAFETY: a null hint lets the kernel choose addresses that nothing else uses.
        let base = unsafe { mmap(ptr::null_mut(), len, access, MapFlags::SHARED, file, 0) }?;
        let base = NonNull::new(base.cast()).ok_or(io::ErrorKind::OutOfMemory)?;
        Ok(Self { base, len })
    }

    /// Keeps the mapping out of forked processes.
    pub(crate) fn keep_from_children(&self) -> io::Result<()> {
        // SAFETY: the bytes are those of this mapping; the advice changes nothing in this process.
        Ok(unsafe { madvise(self.address(), self.len, Advice::LinuxDontFork) }?)
    }

    /// Makes the pages of the first `len` bytes of a writable mapping present.
    ///
    /// `MAP_POPULATE` would not report that memory ran out; then the first access would end the
    /// process.
    fn populate(&self, file: &File, len: usize) -> io::Result<()> {
        if len == 0 {
            return Ok(());
        }
        // SAFETY: the bytes are those of this mapping, and the advice keeps their content.
        match unsafe { madvise(self.address(), len, Advice::LinuxPopulateWrite) } {
            Err(Errno::INVAL) => {}
            done => return Ok(done?),
        }
        // Before Linux 5.14: the allocation reports an error, and then each page is touched.
        fallocate(file, FallocateFlags::empty(), 0, len as u64)?;
        for page in (0..len).step_by(rustix::param::page_size()) {
            // SAFETY: `page` is below the size of the mapping, which is new, all zeros, and not
            // shared yet.
            unsafe { self.base.add(page).write_volatile(0) };
        }
        Ok(())
    }

    pub(crate) fn base(&self) -> NonNull<u8> {
        self.base
    }

    pub(crate) fn len(&self) -> usize {
        self.len
    }

    fn address(&self) -> *mut c_void {
        self.base.as_ptr().cast()
    }
}

impl Drop for FileMapping {
    fn drop(&mut self) {
        // SAFETY: `shared` mapped exactly these bytes, and their owner drops the mapping last. It
        // fails only for arguments that no mapping has.
        let _ = unsafe { munmap(self.address(), self.len) };
    }
}

// SAFETY: bytes have no thread; the types that own a mapping control access to it.
unsafe impl Send for FileMapping {}
// SAFETY: as above; a shared mapping exposes only its address and length.
unsafe impl Sync for FileMapping {}

/// The memory of a topic, for its writer.
pub struct TopicRegion(FileMapping);

impl TopicRegion {
    /// Creates zeroed memory of `len` bytes, and seals it; also returns the file to pass to
    /// readers. The pages of the first `present` bytes are present; the kernel adds each of the
    /// others when it is first written to. `name` appears in `/proc/PID/maps`.
    ///
    /// Children of this process do not inherit the mapping.
    ///
    /// # Errors
    ///
    /// [`io::ErrorKind::Unsupported`] if the kernel cannot seal it; otherwise the kernel's error,
    /// such as out of memory.
    pub fn create(name: &str, len: usize, present: usize) -> io::Result<(Self, File)> {
        let flags = MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING;
        let file = File::from(memfd_create(name, flags)?);
        file.set_len(len as u64)?;
        let access = ProtFlags::READ | ProtFlags::WRITE;
        let mapping = FileMapping::shared(&file, len, access)?;
        mapping.keep_from_children()?;
        mapping.populate(&file, present.min(len))?;
        seal(&file, TOPIC_SEALS)?;
        Ok((Self(mapping), file))
    }
}

/// Seals `file`, and checks that the seals hold.
pub(crate) fn seal(file: &File, seals: SealFlags) -> io::Result<()> {
    let unsupported = || {
        io::Error::new(io::ErrorKind::Unsupported, "this kernel cannot seal memory: use Linux 5.1")
    };
    match fcntl_add_seals(file, seals) {
        Err(Errno::INVAL) => return Err(unsupported()),
        sealed => sealed?,
    }
    if fcntl_get_seals(file)?.contains(seals) { Ok(()) } else { Err(unsupported()) }
}

// SAFETY: the mapping is owned, stays where it is until drop, and is initialised by the kernel. No
// other process can write it, as its file is sealed; readers in other processes only read.
unsafe impl Region for TopicRegion {
    fn base(&self) -> NonNull<u8> {
        self.0.base()
    }

    fn len(&self) -> usize {
        self.0.len()
    }
}

/// The memory of a topic, for a reader.
pub struct MappedTopic(FileMapping);

impl MappedTopic {
    /// Maps the file of a [`TopicRegion`] of `len` bytes.
    ///
    /// # Errors
    ///
    /// [`io::ErrorKind::InvalidData`] if the file has another size or is not sealed; otherwise the
    /// kernel's error.
    pub fn open(file: impl AsFd, len: usize) -> io::Result<Self> {
        let wrong = |why| io::Error::new(io::ErrorKind::InvalidData, why);
        if u64::try_from(rustix::fs::fstat(&file)?.st_size) != Ok(len as u64) {
            return Err(wrong("the memory of the topic has another size"));
        }
        // A file that can shrink would end this process by SIGBUS.
        if !fcntl_get_seals(&file)?.contains(TOPIC_SEALS) {
            return Err(wrong("the memory of the topic is not sealed"));
        }
        FileMapping::shared(&file, len, ProtFlags::READ).map(Self)
    }
}

// SAFETY: the mapping is owned, stays where it is until drop, and cannot shrink, as its file is
// sealed.
unsafe impl ReadRegion for MappedTopic {
    fn base(&self) -> NonNull<u8> {
        self.0.base()
    }

    fn len(&self) -> usize {
        self.0.len()
    }
}

#[cfg(test)]
mod tests {
    use rustix::fs::ftruncate;
    use rustix::io::pwrite;
    use rustix::mm::{MprotectFlags, mprotect};

    use super::*;

    const LEN: usize = 3 * 4096;

    #[test]
    fn a_sealed_topic_cannot_be_changed_through_its_file() {
        let (_region, file) = TopicRegion::create("test", LEN, 0).unwrap();
        let file = &file;
        let writable = FileMapping::shared(&file, LEN, ProtFlags::READ | ProtFlags::WRITE);
        assert_eq!(writable.err().unwrap().raw_os_error(), Some(Errno::PERM.raw_os_error()));
        assert_eq!(pwrite(file, b"x", 0), Err(Errno::PERM));
        assert_eq!(ftruncate(file, 0), Err(Errno::PERM));
        assert_eq!(ftruncate(file, 2 * LEN as u64), Err(Errno::PERM));
        let hole = FallocateFlags::PUNCH_HOLE | FallocateFlags::KEEP_SIZE;
        assert_eq!(fallocate(file, hole, 0, 4096), Err(Errno::PERM));
        assert_eq!(fallocate(file, FallocateFlags::empty(), 0, 2 * LEN as u64), Err(Errno::PERM));
        assert_eq!(fcntl_add_seals(file, SealFlags::WRITE), Err(Errno::PERM));
    }

    fn present(file: &File) -> i64 {
        rustix::fs::fstat(file).unwrap().st_blocks * 512
    }

    #[test]
    fn only_the_first_pages_are_present_at_the_start() {
        let (region, file) = TopicRegion::create("test", 1 << 30, 10_000).unwrap();
        assert_eq!(present(&file), 3 * 4096);
        // SAFETY: the region is that large, and this thread is the only one.
        unsafe { Region::base(&region).add(1 << 20).write(7) };
        assert_eq!(present(&file), 4 * 4096);
        let (_, whole) = TopicRegion::create("test", LEN, usize::MAX).unwrap();
        assert_eq!(present(&whole), LEN as i64);
    }

    #[test]
    fn a_reader_cannot_make_its_mapping_writable() {
        let (_, file) = TopicRegion::create("test", LEN, 0).unwrap();
        let mapped = MappedTopic::open(&file, LEN).unwrap();
        // SAFETY: the bytes are those of the mapping, and the call is refused.
        let refused = unsafe {
            mprotect(mapped.0.address(), LEN, MprotectFlags::READ | MprotectFlags::WRITE)
        };
        assert_eq!(refused, Err(Errno::ACCESS));
    }

    #[test]
    fn a_reader_sees_what_the_writer_wrote() {
        let (region, file) = TopicRegion::create("test", LEN, 0).unwrap();
        let mapped = MappedTopic::open(&file, LEN).unwrap();
        // SAFETY: both mappings have `LEN` bytes, and this thread is the only one.
        unsafe {
            Region::base(&region).as_ptr().add(5000).write(7);
            assert_eq!(ReadRegion::base(&mapped).as_ptr().add(5000).read_volatile(), 7);
        }
    }

    #[test]
    fn a_file_of_another_size_or_without_seals_is_refused() {
        let (_, file) = TopicRegion::create("test", LEN, 0).unwrap();
        let refused = MappedTopic::open(&file, LEN + 4096).err().unwrap();
        assert_eq!(refused.to_string(), "the memory of the topic has another size");
        let file = File::from(memfd_create("test", MemfdFlags::ALLOW_SEALING).unwrap());
        file.set_len(LEN as u64).unwrap();
        let refused = MappedTopic::open(&file, LEN).err().unwrap();
        assert_eq!(refused.to_string(), "the memory of the topic is not sealed");
    }
}

//! Pre-faulted slots, counted leases on them, and rings that show the newest of them.
//!
//! A [`Pool`] cuts a [`Region`] into slots of one size. [`Pool::draft`] returns a free slot as a
//! [`Draft`], which one owner fills; sealing turns it into a [`Lease`], which many may read and
//! none may change. A ring over a pool ([`ring`]) numbers the samples of its one [`RingWriter`] 0,
//! 1, 2, ... and shows the newest `depth` of them to any number of [`RingReader`]s on any thread.
//!
//! In [`shared`], one process writes such rings and others read them in place;
//! [`RingReader::shared`] reads them like a ring over a pool.
//!
//! A sample that a reader holds keeps its bytes until the last lease on it is dropped, even after
//! it has left the ring, and after the ring and the pool are gone. Every sample that a ring loses
//! is counted by cause ([`RingCounts`]).
//!
//! ```
//! use gleaner_buffers::{HeapRegion, Pool, ring};
//!
//! let (slots, slot_bytes) = (4, 1024);
//! let bytes = Pool::<u64>::bytes_needed(slots, slot_bytes).ok_or("too large")?;
//! let pool = Pool::new(HeapRegion::zeroed(bytes)?, slots, slot_bytes)?;
//! let (mut writer, reader) = ring(pool, 2)?;
//!
//! let mut draft = writer.draft(5)?;
//! draft.copy_from_slice(b"hello");
//! writer.publish(draft, 1_700_000_000)?;
//!
//! let sample = reader.newest().ok_or("empty")?;
//! assert_eq!((&*sample, *sample.meta()), (&b"hello"[..], 1_700_000_000));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # How large a pool must be
//!
//! A ring of depth `d` whose readers hold at most `p` leases never refuses a draft, and never gives
//! up a sample early, if it has `d + 1 + p` slots to itself. A reader inside a call counts as one
//! lease. With fewer slots the writer takes back the oldest sample without a lease; that may be
//! the newest one, so that a reader can find the ring empty for as long as the draft takes to fill.
//!
//! # Progress
//!
//! Nothing blocks, and nothing is allocated after construction, except that a caller's `Vec` may
//! grow. Publishing and evicting are wait-free. Drafting is lock-free: it repeats a step only if
//! another thread drafted from the same 64 slots in the meantime, so it is wait-free too where one
//! ring has the pool to itself. Finding a sample is lock-free: a pin is repeated only if another
//! thread pinned or dropped the same sample in the meantime, and [`RingReader::newest`] starts over
//! only if a sample was published in the meantime. In shared memory the writer never waits either;
//! the readers of one process take turns for the few instructions that set a hazard.
//!
//! The atomics are loom's under `--cfg loom` (`tests/loom`), and std's otherwise.

mod error;
mod free;
mod lease;
mod pool;
mod region;
mod ring;
mod ring_reader;
pub mod shared;
mod sync;

pub use error::{DraftError, PoolError};
pub use lease::{Draft, Lease};
pub use pool::{HEADROOM, Pool};
pub use region::{HeapRegion, Region};
pub use ring::{ForeignDraft, RingCounts, RingWriter, ring};
pub use ring_reader::RingReader;

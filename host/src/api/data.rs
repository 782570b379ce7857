//! Samples, fields and frames, as a lambda reads them.
//!
//! Every number that a lambda passes is clamped here, and nothing is allocated in proportion to it
//! beyond the clamps below.

use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use gleaner_buffers::{Lease, RingCounts, RingReader};
use gleaner_messages::{CdrError, Definitions, FieldPath, HeaderStamp, header_stamp};
use gleaner_rules::clamps::{self, WrongField};
pub use gleaner_rules::clamps::{PATH_BYTES, SAMPLES_PER_CALL, TEXTS_PER_FIELD};
use gleaner_transport::SampleMeta;

pub use super::call::{Due, PerCall};
use super::curves::{Curves, Pen};
pub use super::error::{DataError, DataErrorKind};
use super::field::FIELD_BYTES;
pub use super::field::Field;
use super::frame::Images;
use super::fuel::Fuel;
pub use super::fuel::OutOfFuel;
pub use super::sample::Sample;
use super::trace::{Arrivals, Looked};
pub use super::values::{Column, Counts, Identity, Stamps, Tick};

/// Samples of a column between two looks at the time, and bytes of those that are walked over.
const SAMPLES_PER_LOOK: usize = 1024;
const BYTES_PER_LOOK: usize = 1 << 20;

/// A count that nobody knows.
const UNKNOWN: u64 = u64::MAX;

/// The ring of one input, as its lambda sees it.
pub struct Topic {
    input: String,
    pub(super) topic: String,
    pub(super) type_name: String,
    reader: RingReader<SampleMeta>,
    /// How many samples the lambda sees; the ring may be deeper.
    depth: usize,
    /// None if nobody has any: the lambda then reads bytes, but no fields.
    definitions: Option<Arc<Definitions>>,
    pub(super) header: Option<HeaderStamp>,
    pub(super) images: Images,
    pub(super) per_call: PerCall,
    skipped: AtomicU64,
    /// Samples at this position in the ring and beyond came after the wake began: the lambda does
    /// not see them.
    until: AtomicU64,
    /// The newest that it sees, held while it runs: however many arrive meanwhile, this one stays.
    newest: Mutex<Option<Lease<SampleMeta>>>,
    /// Lost before they reached this process, and whether anybody knows.
    lost: AtomicU64,
    pub(super) arrivals: Arc<Arrivals>,
    pub(super) looked: Looked,
    /// Reused between column reads, so that they allocate nothing but their result.
    scratch: Mutex<Vec<Lease<SampleMeta>>>,
    /// Where what is read is drawn, if anybody asked for that.
    curves: OnceLock<Arc<Curves>>,
}

impl Topic {
    /// The topic behind input `input`, whose samples arrive through `reader` and are summed up in
    /// `arrivals`.
    pub fn new(
        input: &str,
        topic: &str,
        type_name: &str,
        (reader, depth): (RingReader<SampleMeta>, usize),
        arrivals: Arc<Arrivals>,
        definitions: Option<Arc<Definitions>>,
        (images, per_call): (Images, PerCall),
    ) -> Arc<Self> {
        Arc::new(Self {
            input: input.to_owned(),
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            header: definitions.as_deref().and_then(header_stamp),
            reader,
            depth,
            newest: Mutex::default(),
            definitions,
            images,
            per_call,
            skipped: AtomicU64::new(0),
            until: AtomicU64::new(u64::MAX),
            lost: AtomicU64::new(UNKNOWN),
            arrivals,
            looked: Looked::default(),
            scratch: Mutex::default(),
            curves: OnceLock::new(),
        })
    }

    /// The input's name.
    pub fn name(&self) -> &str {
        &self.input
    }

    /// The ROS topic, as the manifest gives it.
    pub fn ros_topic(&self) -> &str {
        &self.topic
    }

    /// The ROS type, such as `sensor_msgs/msg/Imu`.
    pub fn type_name(&self) -> &str {
        &self.type_name
    }

    /// Newest sample; none before the first.
    pub fn newest(self: &Arc<Self>) -> Option<Sample> {
        let newest = self.reader.newest_before(self.until()).or_else(|| self.pinned());
        self.looked.at(newest.as_ref());
        newest.map(|lease| self.sample(lease))
    }

    /// The `n` newest samples, oldest first; at most [`SAMPLES_PER_CALL`], and what `[limits]`
    /// allows.
    ///
    /// # Errors
    ///
    /// [`OutOfFuel`].
    pub fn last(self: &Arc<Self>, n: usize) -> Result<Vec<Sample>, OutOfFuel> {
        let mut leases = Vec::new();
        self.reader.last_before(
            self.until(),
            n.min(self.per_call.clamps().samples()).min(self.depth),
            &mut leases,
        );
        self.hand_out(leases)
    }

    /// Samples received later than `since_ns`, oldest first; as many of the newest as
    /// [`Topic::last`] gives at most.
    ///
    /// # Errors
    ///
    /// [`OutOfFuel`].
    pub fn since(self: &Arc<Self>, since_ns: i64) -> Result<Vec<Sample>, OutOfFuel> {
        let mut leases = Vec::new();
        let until = self.until();
        self.reader.newest_while_before(
            until,
            self.per_call.clamps().samples().min(self.depth),
            |meta| meta.at_ns > since_ns,
            &mut leases,
        );
        self.hand_out(leases)
    }

    fn hand_out(
        self: &Arc<Self>,
        leases: Vec<Lease<SampleMeta>>,
    ) -> Result<Vec<Sample>, OutOfFuel> {
        self.looked.at(leases.first());
        self.per_call.charge(|| leases.len() * FIELD_BYTES)?;
        Ok(leases.into_iter().map(|lease| self.sample(lease)).collect())
    }

    /// What became of the samples.
    pub fn counts(&self) -> Counts {
        let RingCounts { received, overwritten, no_slot, too_big } = self.reader.counts();
        let skipped = self.skipped.load(Ordering::Relaxed);
        let lost = Some(self.lost.load(Ordering::Relaxed)).filter(|lost| *lost != UNKNOWN);
        Counts { received, lost, overwritten, no_slot, too_big, skipped }
    }

    /// Compiles a path once, such as `linear_acceleration.x` or `cov[3]`.
    ///
    /// # Errors
    ///
    /// [`DataError::NoSuchField`] names the nearest field.
    pub fn field(self: &Arc<Self>, path: &str) -> Result<Field, DataError> {
        self.per_call.charge(|| path.len())?;
        clamps::path(path)?;
        let Some(definitions) = &self.definitions else {
            let why = format!(
                "cannot be found: nobody here has message definitions of `{}`",
                self.type_name
            );
            return Err(WrongField::new(path, why).into());
        };
        let path = FieldPath::compile(definitions, path).map_err(DataError::NoSuchField)?;
        Ok(Field { topic: Arc::clone(self), pen: self.pen(|| path.path().to_owned()), path })
    }

    /// `field` of the `n` newest samples; at most `call_items` of `[limits]`.
    ///
    /// # Errors
    ///
    /// [`DataError::WrongField`] if the field is no number or belongs to another topic;
    /// [`DataError::Malformed`]; [`DataError::OutOfTime`].
    pub fn column(self: &Arc<Self>, field: &Field, n: usize) -> Result<Column, DataError> {
        self.per_call.charge(|| self.column_work(field, n))?;
        let until = self.until();
        self.read_column(field, |reader, out| {
            reader.last_before(until, n.min(self.per_call.items).min(self.depth), out)
        })
    }

    /// `field` of all samples received later than `since_ns`; at most `call_items` of `[limits]`.
    ///
    /// # Errors
    ///
    /// As [`Topic::column`].
    pub fn column_since(
        self: &Arc<Self>,
        field: &Field,
        since_ns: i64,
    ) -> Result<Column, DataError> {
        // How many samples it is shows only on the way. At fixed places they cost little, and are
        // charged afterwards.
        let whole_ring = || self.column_work(field, usize::MAX);
        if field.walks() {
            self.per_call.charge(whole_ring)?;
        }
        let until = self.until();
        let is_since = |meta: &SampleMeta| meta.at_ns > since_ns;
        let column = self.read_column(field, |reader, out| {
            reader.newest_while_before(until, self.per_call.items.min(self.depth), is_since, out)
        });
        if !field.walks() {
            let read = |column: &Column| column.values.len() * FIELD_BYTES;
            self.per_call.charge(|| column.as_ref().map_or_else(|_| whole_ring(), read))?;
        }
        column
    }

    fn read_column(
        self: &Arc<Self>,
        field: &Field,
        select: impl FnOnce(&RingReader<SampleMeta>, &mut Vec<Lease<SampleMeta>>),
    ) -> Result<Column, DataError> {
        field.must_belong_to(self)?;
        let mut leases = self.scratch.lock().unwrap_or_else(PoisonError::into_inner);
        select(&self.reader, &mut leases);
        self.looked.at(leases.first());
        let mut unlooked = 0;
        let column =
            leases.iter().try_fold(Column::with_capacity(leases.len()), |mut column, lease| {
                unlooked += field.work(lease.len()).max(BYTES_PER_LOOK / SAMPLES_PER_LOOK);
                if unlooked >= BYTES_PER_LOOK {
                    unlooked = 0;
                    self.per_call.due.check()?;
                }
                column.values.push(self.number(&field.path, lease)?);
                column.at_ns.push(lease.meta().at_ns);
                Ok(column)
            });
        // Nothing of the ring may stay pinned between two calls.
        leases.clear();
        if let (Some(pen), Ok(column)) = (&field.pen, &column) {
            pen.column(column);
        }
        column
    }

    /// From now on what is read of compiled paths goes into these curves.
    pub(super) fn keep(&self, curves: &Arc<Curves>) {
        // Whoever asked first has it.
        let _ = self.curves.set(Arc::clone(curves));
    }

    /// What draws the curve of this name, if any is drawn.
    pub(super) fn pen(&self, name: impl FnOnce() -> String) -> Option<Arc<Pen>> {
        self.curves.get().and_then(|curves| curves.pen(self, name()))
    }

    pub(super) fn number(
        &self,
        path: &FieldPath,
        lease: &Lease<SampleMeta>,
    ) -> Result<f64, DataError> {
        path.number(lease, lease.meta().endian).map_err(|error| self.unreadable(path, error))
    }

    pub(super) fn unreadable(&self, path: &FieldPath, error: CdrError) -> DataError {
        match error {
            CdrError::NotANumber => WrongField::no_number(path.path(), &self.type_name).into(),
            source => DataError::Malformed {
                topic: self.topic.clone(),
                type_name: self.type_name.clone(),
                source,
            },
        }
    }

    /// Bytes that a column of `field` over `n` samples may touch, judged by the newest sample; the
    /// ring holds no more than its depth.
    fn column_work(&self, field: &Field, n: usize) -> usize {
        let held = usize::try_from(self.reader.head()).unwrap_or(usize::MAX).min(self.depth);
        let message_bytes = self.reader.newest_before(self.until()).map_or(0, |lease| lease.len());
        n.min(held).min(self.per_call.items).saturating_mul(field.work(message_bytes))
    }

    /// The end of what the lambda sees, as a position in the ring.
    pub(crate) fn until(&self) -> u64 {
        self.until.load(Ordering::Relaxed)
    }

    fn pinned(&self) -> Option<Lease<SampleMeta>> {
        self.newest.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// When a call has to end, for all inputs of the lambda.
    pub(super) fn due(&self) -> Due {
        self.per_call.due.clone()
    }

    /// What calls cost, for all inputs of the lambda.
    pub(super) fn fuel(&self) -> Fuel {
        self.per_call.fuel.clone()
    }

    /// How many samples the lambda sees at most.
    pub(crate) fn depth(&self) -> usize {
        self.depth
    }

    pub(crate) fn reader(&self) -> &RingReader<SampleMeta> {
        &self.reader
    }

    pub(crate) fn sample(self: &Arc<Self>, lease: Lease<SampleMeta>) -> Sample {
        Sample::new(Arc::clone(self), lease)
    }

    pub(crate) fn add_skipped(&self, samples: u64) {
        self.skipped.fetch_add(samples, Ordering::Relaxed);
    }

    /// Nanoseconds spent in decoding JPEG and PNG for this topic.
    pub fn decode_ns(&self) -> u64 {
        self.images.decode_ns()
    }
}

/// What only matters while time passes.
impl Topic {
    /// From now on the lambda sees the samples received until `at_ns`, and `woken_by` at most: what
    /// arrives while it runs belongs to the next wake, as in a replay.
    pub(crate) fn see_until(&self, at_ns: i64, woken_by: Option<u64>) {
        let until = woken_by.map_or_else(|| self.received_until(at_ns), |position| position + 1);
        self.until.store(until, Ordering::Relaxed);
        *self.newest.lock().unwrap_or_else(PoisonError::into_inner) =
            self.reader.newest_before(until);
    }

    fn received_until(&self, at_ns: i64) -> u64 {
        let head = self.reader.head();
        let oldest = head.saturating_sub(self.reader.depth() as u64);
        let is_later = |position: &u64| {
            self.reader.get(*position).is_none_or(|lease| lease.meta().at_ns > at_ns)
        };
        head - (oldest..head).rev().take_while(is_later).count() as u64
    }

    /// Receive stamp of the newest sample.
    pub(crate) fn newest_at(&self) -> Option<i64> {
        self.reader.newest().map(|lease| lease.meta().at_ns)
    }

    /// Notes how many samples were lost before they reached this process.
    pub(crate) fn set_lost(&self, lost: u64) {
        self.lost.store(lost, Ordering::Relaxed);
    }
}

/// Why a lambda runs.
pub enum Wake {
    /// A new sample on the input that the schedule names.
    Event(Sample),
    /// The period is over.
    Tick(Tick),
}

impl Wake {
    /// Time of the wake, in nanoseconds.
    pub fn at_ns(&self) -> i64 {
        match self {
            Self::Event(sample) => sample.meta().at_ns,
            Self::Tick(tick) => tick.at_ns,
        }
    }
}

//! Topics as a lambda reads them: samples, fields and columns.
//!
//! Every number that a lambda passes is clamped here. No allocation exceeds the clamps.

use std::ops::ControlFlow;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use gleaner_buffers::shared::SharedReader;
use gleaner_buffers::{Lease, RingCounts, RingReader};
use gleaner_messages::transport::StoredMeta;
use gleaner_messages::{CdrError, Definitions, FieldPath, HeaderStamp, header_stamp, is_viewed};
use gleaner_rules::clamps::{self, WrongField};
pub use gleaner_rules::clamps::{PATH_BYTES, SAMPLES_PER_CALL, TEXTS_PER_FIELD};

pub use super::call::{Due, PerCall};
use super::curves::{CurveWriter, Curves};
pub use super::error::{DataError, DataErrorKind};
use super::field::FIELD_BYTES;
pub use super::field::Field;
use super::fuel::Fuel;
pub use super::fuel::OutOfFuel;
use super::images::{ImageMessage, Images};
use super::live_layout::LiveLayout;
use super::look_back::LookBack;
pub use super::look_back::SumsBefore;
pub use super::sample::Sample;
use super::tensor::TensorLimits;
pub use super::values::{Column, Counts, Identity, Stamps, Tick};

/// Samples of a column, and bytes of samples that are parsed, between two checks of the deadline.
const SAMPLES_PER_CHECK: usize = 1024;
const BYTES_PER_CHECK: usize = 1 << 20;

const UNKNOWN: u64 = u64::MAX;

/// The ring of one input, as its lambda sees it.
pub struct Topic {
    input: String,
    pub(super) topic: String,
    pub(super) type_name: String,
    reader: RingReader<StoredMeta>,
    /// Number of samples that the lambda sees; the ring may be deeper.
    depth: usize,
    /// `None` if there are none: the lambda can then read bytes, but no fields.
    definitions: Option<Arc<Definitions>>,
    /// By the number of the layout.
    pub(super) headers: Box<[Option<HeaderStamp>]>,
    pub(crate) live_layout: LiveLayout,
    /// True if its messages have not the layout of the pictures of ROS 2.
    pub(super) has_other_layout: bool,
    pub(super) images: Images,
    pub(super) per_call: PerCall,
    skipped: AtomicU64,
    /// Position in the ring from which on samples arrived after the wake began: the lambda does not
    /// see them.
    until: AtomicU64,
    /// The newest sample that it sees, pinned while it runs: however many arrive, this one stays.
    newest: Mutex<Option<Lease<StoredMeta>>>,
    /// Samples lost before they reached this process, or [`UNKNOWN`].
    lost: AtomicU64,
    sums_digests: Arc<AtomicBool>,
    pub(super) sums_before: SumsBefore,
    /// Refused holds that were reported as a fault.
    reported_holds: AtomicU64,
    pub(super) look_back: LookBack,
    /// Curves of the values that are read, if they are recorded.
    curves: OnceLock<Arc<Curves>>,
}

/// The ring of an input, before it is a [`Topic`].
pub struct InputRing {
    pub reader: RingReader<StoredMeta>,
    /// Number of samples that the lambda sees; the ring may be deeper.
    pub depth: usize,
    /// Request of digests, to the thread of this process that fills the ring, if one does.
    pub sums_digests: Arc<AtomicBool>,
    /// Sums over the samples before its first one.
    pub sums_before: SumsBefore,
}

impl Topic {
    /// The topic behind input `input`, whose samples arrive through `ring`.
    pub fn new(
        input: &str,
        topic: &str,
        type_name: &str,
        InputRing { reader, depth, sums_digests, sums_before }: InputRing,
        definitions: Option<Arc<Definitions>>,
        (images, per_call): (Images, PerCall),
    ) -> Arc<Self> {
        Arc::new(Self {
            input: input.to_owned(),
            topic: topic.to_owned(),
            type_name: type_name.to_owned(),
            headers: definitions
                .iter()
                .flat_map(|known| known.layouts().map(header_stamp))
                .collect(),
            live_layout: LiveLayout::default(),
            has_other_layout: ImageMessage::is_type(type_name)
                && definitions.as_deref().is_some_and(|known| !is_viewed(known)),
            reader,
            depth,
            newest: Mutex::default(),
            definitions,
            images,
            per_call,
            skipped: AtomicU64::new(0),
            until: AtomicU64::new(u64::MAX),
            lost: AtomicU64::new(UNKNOWN),
            sums_digests,
            sums_before,
            reported_holds: AtomicU64::new(0),
            look_back: LookBack::default(),
            curves: OnceLock::new(),
        })
    }

    /// Limits of the lambda's tensors, which share the memory of its frames.
    pub(super) fn tensor_limits(&self) -> TensorLimits {
        let (per_call, budget) = (self.per_call.clone(), self.images.budget.clone());
        TensorLimits { per_call, budget }
    }

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

    /// Returns the newest sample; `None` before the first.
    ///
    /// # Errors
    ///
    /// [`DataError::OutOfHolds`].
    pub fn newest(self: &Arc<Self>) -> Result<Option<Sample>, DataError> {
        let newest = match self.pinned() {
            Some(pinned) => Some(pinned),
            None => self.held(|| self.reader.newest_before(self.until()))?,
        };
        self.look_back.at(newest.as_ref());
        Ok(newest.map(|lease| self.sample(lease)))
    }

    /// Returns the `n` newest samples, oldest first; at most [`SAMPLES_PER_CALL`], and as many as
    /// `[limits]` allows.
    ///
    /// # Errors
    ///
    /// [`DataError::OutOfHolds`]; [`DataError::OutOfFuel`].
    pub fn last(self: &Arc<Self>, n: usize) -> Result<Vec<Sample>, DataError> {
        let mut leases = Vec::new();
        let n = n.min(self.per_call.clamps().samples()).min(self.depth);
        self.held(|| self.reader.last_before(self.until(), n, &mut leases))?;
        self.samples_of(leases)
    }

    /// Returns the samples received later than `since_ns`, oldest first; at most as many of the
    /// newest as [`Topic::last`] returns, and with its errors.
    pub fn since(self: &Arc<Self>, since_ns: i64) -> Result<Vec<Sample>, DataError> {
        let mut leases = Vec::new();
        let most = self.per_call.clamps().samples().min(self.depth);
        let is_since = |meta: &StoredMeta| meta.sample.at_ns > since_ns;
        self.held(|| self.reader.newest_while_before(self.until(), most, is_since, &mut leases))?;
        self.samples_of(leases)
    }

    fn samples_of(
        self: &Arc<Self>,
        leases: Vec<Lease<StoredMeta>>,
    ) -> Result<Vec<Sample>, DataError> {
        self.look_back.at(leases.first());
        self.per_call.charge(|| leases.len() * FIELD_BYTES)?;
        Ok(leases.into_iter().map(|lease| self.sample(lease)).collect())
    }

    /// Counts of samples since the start.
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
                "cannot be found: there are no message definitions of `{}`",
                self.type_name
            );
            return Err(WrongField::new(path, why).into());
        };
        let path = FieldPath::compile(definitions, path).map_err(DataError::NoSuchField)?;
        Ok(Field {
            topic: Arc::clone(self),
            curve: self.curve_writer(|| path.path().to_owned()),
            path,
        })
    }

    /// Returns `field` of the `n` newest samples; at most `call_items` of `[limits]`.
    ///
    /// # Errors
    ///
    /// [`DataError::WrongField`] if the field is no number or belongs to another topic;
    /// [`DataError::Malformed`]; [`DataError::OutOfTime`]; [`DataError::OutOfHolds`].
    pub fn column(self: &Arc<Self>, field: &Field, n: usize) -> Result<Column, DataError> {
        self.per_call.charge(|| self.column_work(field, n))?;
        self.read_column(field, n, |_| true)
    }

    /// Returns `field` of all samples received later than `since_ns`; at most `call_items` of
    /// `[limits]`. Fails as [`Topic::column`].
    pub fn column_since(
        self: &Arc<Self>,
        field: &Field,
        since_ns: i64,
    ) -> Result<Column, DataError> {
        // The number of samples is known only after the read. Fields at fixed offsets cost little,
        // and are charged afterwards.
        let whole_ring = || self.column_work(field, usize::MAX);
        if field.walks() {
            self.per_call.charge(whole_ring)?;
        }
        let column = self.read_column(field, usize::MAX, |meta| meta.sample.at_ns > since_ns);
        if !field.walks() {
            let read = |column: &Column| column.values.len() * FIELD_BYTES;
            self.per_call.charge(|| column.as_ref().map_or_else(|_| whole_ring(), read))?;
        }
        column
    }

    /// Reads `field` of the newest samples, at most `n`, back to the first one that `keep` refuses.
    fn read_column(
        self: &Arc<Self>,
        field: &Field,
        n: usize,
        keep: impl FnMut(&StoredMeta) -> bool,
    ) -> Result<Column, DataError> {
        field.must_belong_to(self)?;
        let most = n.min(self.per_call.items).min(self.depth);
        let mut column = Column::with_capacity(most.min(SAMPLES_PER_CHECK));
        let (mut unchecked, mut failed) = (0, None);
        let add = |position, meta: &StoredMeta, message: &[u8]| {
            self.look_back.at_position(position);
            unchecked += field.work(message.len()).max(BYTES_PER_CHECK / SAMPLES_PER_CHECK);
            if unchecked >= BYTES_PER_CHECK {
                unchecked = 0;
                if let Err(late) = self.per_call.due.check() {
                    failed = Some(late);
                    return ControlFlow::Break(());
                }
            }
            match self.number(&field.path, message, meta) {
                Ok(number) => {
                    column.values.push(number);
                    column.at_ns.push(meta.sample.at_ns);
                }
                // The error is that of the oldest one.
                Err(error) => failed = Some(error),
            }
            ControlFlow::Continue(())
        };
        self.held(|| self.reader.visit_while_before(self.until(), most, keep, add))?;
        if let Some(error) = failed {
            return Err(error);
        }
        // Read newest first.
        column.values.reverse();
        column.at_ns.reverse();
        if let Some(curve) = &field.curve {
            curve.column(&column);
        }
        Ok(column)
    }

    /// The writer of the curve of this name, if curves are recorded.
    pub(super) fn curve_writer(&self, name: impl FnOnce() -> String) -> Option<Arc<CurveWriter>> {
        let curves = self.curves.get()?;
        curves.curve_writer(&self.input, &self.topic, name())
    }

    pub(super) fn number(
        &self,
        path: &FieldPath,
        message: &[u8],
        meta: &StoredMeta,
    ) -> Result<f64, DataError> {
        path.in_layout(self.live_layout.number_of(&meta.sample))
            .and_then(|path| path.number(message, meta.sample.endian))
            .map_err(|error| self.unreadable(path, error))
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

    /// Number of bytes that a column of `field` over `n` samples may touch, estimated by the newest
    /// sample; the ring holds no more than its depth.
    fn column_work(&self, field: &Field, n: usize) -> usize {
        let held = usize::try_from(self.reader.head()).unwrap_or(usize::MAX).min(self.depth);
        let message_bytes = self.reader.newest_before(self.until()).map_or(0, |lease| lease.len());
        n.min(held).min(self.per_call.items).saturating_mul(field.work(message_bytes))
    }

    /// Reads the ring of samples that another process writes.
    fn held<T>(&self, read: impl FnOnce() -> T) -> Result<T, DataError> {
        let refused = self.reader.refused_holds();
        let found = read();
        if self.reader.refused_holds() == refused {
            return Ok(found);
        }
        Err(DataError::OutOfHolds { input: self.input.clone() })
    }

    /// Returns the error of a lambda that keeps too many samples, once for all samples that could
    /// not be read since the last call.
    pub(super) fn take_refused_holds(&self) -> Option<DataError> {
        let refused = self.reader.refused_holds();
        let is_new = self.reported_holds.swap(refused, Ordering::Relaxed) != refused;
        is_new.then(|| DataError::OutOfHolds { input: self.input.clone() })
    }

    /// Sums the digests of samples from now on, if this process fills the ring.
    pub(super) fn sum_digests(&self) {
        self.sums_digests.store(true, Ordering::Relaxed);
    }

    /// Position in the ring at which the lambda's view ends, exclusive.
    pub(crate) fn until(&self) -> u64 {
        self.until.load(Ordering::Relaxed)
    }

    /// The newest sample that the lambda sees in a live run.
    pub(super) fn pinned(&self) -> Option<Lease<StoredMeta>> {
        self.newest.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Due time of calls, shared by all inputs of the lambda.
    pub(super) fn due(&self) -> Due {
        self.per_call.due.clone()
    }

    /// Fuel account of calls, shared by all inputs of the lambda.
    pub(super) fn fuel(&self) -> Fuel {
        self.per_call.fuel.clone()
    }

    /// Maximum number of samples that the lambda sees.
    pub(crate) fn depth(&self) -> usize {
        self.depth
    }

    pub(crate) fn reader(&self) -> &RingReader<StoredMeta> {
        &self.reader
    }

    pub(crate) fn sample(self: &Arc<Self>, lease: Lease<StoredMeta>) -> Sample {
        Sample::new(Arc::clone(self), lease)
    }

    pub(crate) fn add_skipped(&self, samples: u64) {
        self.skipped.fetch_add(samples, Ordering::Relaxed);
    }

    /// Time spent in decoding JPEG and PNG for this topic, in ns.
    pub fn decode_ns(&self) -> u64 {
        self.images.decode_ns()
    }
}

/// Methods for live runs.
impl Topic {
    /// Limits the lambda's view to samples received until `at_ns`, or up to `woken_by`: samples
    /// that arrive while it runs belong to the next wake, as in a replay.
    pub(crate) fn see_until(&self, at_ns: i64, woken_by: Option<u64>) {
        let until = woken_by.map_or_else(|| self.received_until(at_ns), |position| position + 1);
        self.hide_from(until);
    }

    fn received_until(&self, at_ns: i64) -> u64 {
        let head = self.reader.head();
        let oldest = head.saturating_sub(self.reader.depth() as u64);
        let is_later = |position: &u64| {
            self.reader.meta(*position).is_none_or(|meta| meta.sample.at_ns > at_ns)
        };
        head - (oldest..head).rev().take_while(is_later).count() as u64
    }

    pub(crate) fn hide_from(&self, position: u64) {
        self.until.store(position, Ordering::Relaxed);
        *self.newest.lock().unwrap_or_else(PoisonError::into_inner) =
            self.reader.newest_before(position);
    }

    /// Receive stamp of the newest sample.
    pub(crate) fn newest_at(&self) -> Option<i64> {
        self.reader.newest_meta().map(|(_, meta)| meta.sample.at_ns)
    }

    /// Sets the number of samples that were lost before they reached this process; `None` if
    /// unknown.
    pub(crate) fn set_lost(&self, lost: Option<u64>) {
        self.lost.store(lost.unwrap_or(UNKNOWN), Ordering::Relaxed);
    }

    /// Continues the topic in the memory of another ingress, whose samples from position `first` of
    /// `reader` on follow those so far. `before` are its sums before them.
    pub(crate) fn continue_in(&self, reader: SharedReader, first: u64, before: SumsBefore) {
        let so_far = self.sums_so_far();
        self.reader.continue_in(reader, first, before.refused, move |words| {
            let meta = StoredMeta::of_words(words);
            let digests = meta.digests.wrapping_sub(before.digest).wrapping_add(so_far.digest);
            let refused = meta.refused.saturating_sub(before.refused) + so_far.refused;
            StoredMeta { digests, refused, ..meta }
        });
    }

    /// Returns the sums over all samples so far, if no further ones arrive.
    fn sums_so_far(&self) -> SumsBefore {
        let newest = self.reader.newest_meta();
        let digest = newest.map_or(self.sums_before.digest, |(_, meta)| meta.digests);
        let refused = self.sums_before.refused + self.reader.counts().too_big;
        SumsBefore { digest, refused }
    }
}

/// Starts to record the values of fields of `inputs` that are compiled from now on.
pub(crate) fn record_curves(inputs: &[Arc<Topic>]) -> Arc<Curves> {
    let curves = Arc::new(Curves::default());
    for topic in inputs {
        // The first request wins.
        let _ = topic.curves.set(Arc::clone(&curves));
    }
    curves
}

/// The cause of a wake.
pub enum Wake {
    /// A new sample on the input that the schedule names.
    Event(Sample),
    Tick(Tick),
}

impl Wake {
    pub fn at_ns(&self) -> i64 {
        match self {
            Self::Event(sample) => sample.meta().at_ns,
            Self::Tick(tick) => tick.at_ns,
        }
    }
}

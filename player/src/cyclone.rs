//! Cyclone DDS: a participant, and writers of any type, that are handed whole CDR messages without
//! copying them.
//!
//! A topic of Cyclone DDS is usually made from a C type. `cyclors` also makes one from names alone,
//! whose samples are opaque bytes; for those we bring our own operations on samples, so that
//! Cyclone DDS refers to our buffers, and drops them when the last reader has acknowledged them.
//! There are no readers here, so nothing is ever made from received bytes.
#![allow(unsafe_code)]

use std::ffi::{CStr, CString, c_char, c_void};
use std::ptr;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use cyclors::{
    DDS_DATA_REPRESENTATION_XCDR1, DDS_RETCODE_TIMEOUT, dds_entity_t, ddsi_keyhash, ddsi_serdata,
    ddsi_serdata_ops, ddsi_sertype, ddsrt_iovec_t,
};
use gleaner_base::{Exit, Explain};

use crate::buffer::Buffer;
use crate::offer::Offer;

/// Why Cyclone DDS does not do what we want.
#[derive(Debug, thiserror::Error)]
pub(crate) enum CycloneError {
    /// A participant or a writer cannot be made.
    #[error("Cyclone DDS cannot make {what}: {said}")]
    Create { what: String, said: String },
    /// A message was not sent: readers did not acknowledge older ones in time.
    #[error("readers did not take what was sent before within {} s", MAX_BLOCKING.as_secs())]
    Blocked,
    /// A message was not sent for another reason.
    #[error("Cyclone DDS cannot send a message of {len} bytes: {said}")]
    Write { len: usize, said: String },
}

impl Explain for CycloneError {
    fn help(&self) -> Option<String> {
        matches!(self, CycloneError::Create { .. }).then(|| {
            "see what Cyclone DDS said above; is there a network interface that is up, and is --interface an address of it?"
                .to_owned()
        })
    }

    fn exit(&self) -> Exit {
        Exit::Unreachable
    }
}

/// How long a write waits for readers that lag behind. ROS 2 waits forever; then a stopped reader
/// stops the player.
const MAX_BLOCKING: Duration = Duration::from_secs(1);

/// More than any message of ROS 2, and what Cyclone DDS sends at most.
const MAX_MESSAGE: usize = i32::MAX as usize - 8;

/// Our presence in a domain.
pub(crate) struct Participant {
    participant: dds_entity_t,
}

impl Participant {
    /// Joins a domain, with this configuration (XML), or with what the environment says.
    pub(crate) fn join(domain: u32, config: Option<&str>) -> Result<Participant, CycloneError> {
        let what = || format!("a participant in domain {domain}");
        if let Some(config) = config {
            let config = c_string(config);
            // SAFETY: the text is terminated, and outlives the call, which reads it.
            created(unsafe { cyclors::dds_create_domain(domain, config.as_ptr()) }, what)?;
        }
        // SAFETY: null stands for the default quality of service and for no listener.
        let participant =
            unsafe { cyclors::dds_create_participant(domain, ptr::null(), ptr::null()) };
        created(participant, what).map(|participant| Participant { participant })
    }

    /// Offers a topic by the names that DDS has for it and for its type.
    pub(crate) fn writer(
        &self,
        topic: &str,
        type_name: &str,
        offer: Offer,
    ) -> Result<Writer<'_>, CycloneError> {
        let what = || format!("a writer of `{topic}` with type `{type_name}`");
        let (topic_name, type_name) = (c_string(topic), c_string(type_name));
        // SAFETY: both texts are terminated and outlive the call, which copies them and does not
        // write to them.
        let topic = unsafe {
            cyclors::cdds_create_blob_topic(
                self.participant,
                topic_name.as_ptr().cast_mut(),
                type_name.as_ptr().cast_mut(),
                true,
            )
        };
        created(topic, what)?;
        let mut sertype: *const ddsi_sertype = ptr::null();
        // SAFETY: the topic is ours, and the place for the answer is valid.
        let answer = unsafe { cyclors::dds_get_entity_sertype(topic, &mut sertype) };
        created(answer, what)?;
        // SAFETY: a fresh set of policies, filled by the calls below, copied by dds_create_writer,
        // deleted once; the array of representations is as long as it says.
        let writer = unsafe {
            let qos = cyclors::dds_create_qos();
            let (reliability, durability) = kinds(offer);
            cyclors::dds_qset_reliability(qos, reliability, MAX_BLOCKING.as_nanos() as i64);
            cyclors::dds_qset_durability(qos, durability);
            // At most 1000: see `Offer`.
            let depth = offer.depth as i32;
            let keep_last = cyclors::dds_history_kind_DDS_HISTORY_KEEP_LAST;
            cyclors::dds_qset_history(qos, keep_last, depth);
            // How many of a topic that is transient local are kept for late readers.
            cyclors::dds_qset_durability_service(qos, 0, keep_last, depth, -1, -1, -1);
            let xcdr1 = DDS_DATA_REPRESENTATION_XCDR1 as i16;
            cyclors::dds_qset_data_representation(qos, 1, &xcdr1);
            let writer = cyclors::dds_create_writer(self.participant, topic, qos, ptr::null());
            cyclors::dds_delete_qos(qos);
            writer
        };
        created(writer, what).map(|writer| Writer { writer, sertype, _participant: self })
    }
}

impl Drop for Participant {
    fn drop(&mut self) {
        // Also ends its writers and topics. What it returns says only that it is gone already.
        // SAFETY: a handle that is not valid any more is refused.
        unsafe { cyclors::dds_delete(self.participant) };
    }
}

/// Writes messages of one topic.
pub(crate) struct Writer<'p> {
    writer: dds_entity_t,
    /// The topic's type, which lives as long as the topic, and so as the participant.
    sertype: *const ddsi_sertype,
    _participant: &'p Participant,
}

// SAFETY: Cyclone DDS locks its entities itself, and never changes a type after the topic was made.
unsafe impl Send for Writer<'_> {}
// SAFETY: as above.
unsafe impl Sync for Writer<'_> {}

impl Writer<'_> {
    /// Sends `message`: encapsulation, CDR, and zeros up to a multiple of four. Returns when the
    /// kernel has it; waits at most [`MAX_BLOCKING`] for readers that lag behind.
    pub(crate) fn write(&self, message: Buffer) -> Result<(), CycloneError> {
        let len = message.len();
        if len > MAX_MESSAGE || !len.is_multiple_of(4) || len < 4 {
            return Err(CycloneError::Write {
                len,
                said: "it has no length that a message can have".to_owned(),
            });
        }
        // SAFETY: all of `ddsi_serdata` is numbers and pointers, for which zeros are valid;
        // `ddsi_serdata_init` fills it with one reference, which dds_writecdr takes over.
        let code = unsafe {
            let mut sample = Box::new(Sample { base: std::mem::zeroed(), message });
            cyclors::ddsi_serdata_init(
                &mut sample.base,
                self.sertype,
                cyclors::ddsi_serdata_kind_SDK_DATA,
            );
            sample.base.ops = &OPERATIONS;
            cyclors::dds_writecdr(self.writer, Box::into_raw(sample).cast())
        };
        match code {
            0.. => Ok(()),
            DDS_RETCODE_TIMEOUT => Err(CycloneError::Blocked),
            code => Err(CycloneError::Write { len, said: said(code) }),
        }
    }

    /// Readers that match now.
    pub(crate) fn readers(&self) -> usize {
        // SAFETY: with room for no handle, none is written, and the answer is their number.
        let count =
            unsafe { cyclors::dds_get_matched_subscriptions(self.writer, ptr::null_mut(), 0) };
        usize::try_from(count).unwrap_or(0)
    }

    /// Waits until all readers have acknowledged everything; false if that took too long.
    pub(crate) fn flush(&self, at_most: Duration) -> bool {
        // SAFETY: only the handle is passed, and one that is not valid is refused.
        unsafe { cyclors::dds_wait_for_acks(self.writer, at_most.as_nanos() as i64) >= 0 }
    }
}

fn kinds(offer: Offer) -> (cyclors::dds_reliability_kind, cyclors::dds_durability_kind) {
    let reliability = match offer.reliable {
        true => cyclors::dds_reliability_kind_DDS_RELIABILITY_RELIABLE,
        false => cyclors::dds_reliability_kind_DDS_RELIABILITY_BEST_EFFORT,
    };
    let durability = match offer.transient_local {
        true => cyclors::dds_durability_kind_DDS_DURABILITY_TRANSIENT_LOCAL,
        false => cyclors::dds_durability_kind_DDS_DURABILITY_VOLATILE,
    };
    (reliability, durability)
}

fn c_string(text: &str) -> CString {
    CString::new(text).expect("names and configurations are checked to have no zero byte")
}

fn created(answer: i32, what: impl FnOnce() -> String) -> Result<dds_entity_t, CycloneError> {
    if answer >= 0 {
        Ok(answer)
    } else {
        Err(CycloneError::Create { what: what(), said: said(answer) })
    }
}

fn said(code: i32) -> String {
    // SAFETY: the answer is a terminated text that is never freed, for any number.
    unsafe { CStr::from_ptr(cyclors::dds_strretcode(code)) }.to_string_lossy().into_owned()
}

/// A message as Cyclone DDS holds it. It only knows the first field, and frees it through [`free`].
#[repr(C)]
struct Sample {
    base: ddsi_serdata,
    message: Buffer,
}

/// What Cyclone DDS asks of a sample that is written. The rest is for samples that are received.
static OPERATIONS: ddsi_serdata_ops = ddsi_serdata_ops {
    eqkey: Some(eqkey),
    get_size: Some(get_size),
    from_ser: None,
    from_ser_iov: None,
    from_keyhash: None,
    from_sample: None,
    to_ser: Some(to_ser),
    to_ser_ref: Some(to_ser_ref),
    to_ser_unref: Some(to_ser_unref),
    to_sample: None,
    to_untyped: Some(to_untyped),
    untyped_to_sample: None,
    free: Some(free),
    print: Some(print),
    get_keyhash: Some(get_keyhash),
    from_loaned_sample: None,
    from_psmx: None,
};

/// Topics of ROS 2 have no keys: all samples are of one instance.
unsafe extern "C" fn eqkey(_: *const ddsi_serdata, _: *const ddsi_serdata) -> bool {
    true
}

unsafe extern "C" fn get_size(sample: *const ddsi_serdata) -> u32 {
    // SAFETY: Cyclone DDS calls these operations only with samples that `write` or `to_untyped`
    // made, and that live.
    let message = unsafe { &(*sample.cast::<Sample>()).message };
    // At most MAX_MESSAGE.
    message.len() as u32
}

unsafe extern "C" fn to_ser(
    sample: *const ddsi_serdata,
    from: usize,
    len: usize,
    into: *mut c_void,
) {
    // SAFETY: as in `get_size`; `into` has room for `len` bytes, and is not ours.
    unsafe {
        let message = &(*sample.cast::<Sample>()).message;
        ptr::copy_nonoverlapping(message[from..from + len].as_ptr(), into.cast::<u8>(), len);
    }
}

/// Lends a part of the message. It counts as a reference, so that the part stays where it is until
/// [`to_ser_unref`].
unsafe extern "C" fn to_ser_ref(
    sample: *const ddsi_serdata,
    from: usize,
    len: usize,
    part: *mut ddsrt_iovec_t,
) -> *mut ddsi_serdata {
    // SAFETY: as in `get_size`; `part` is valid. The count is only ever changed atomically, by
    // Cyclone DDS and here. What is lent is only read.
    unsafe {
        let lent = &(&(*sample.cast::<Sample>()).message)[from..from + len];
        (*part).iov_base = lent.as_ptr().cast_mut().cast();
        (*part).iov_len = len;
        let sample = sample.cast_mut();
        AtomicU32::from_ptr(&raw mut (*sample).refc.v).fetch_add(1, Ordering::Relaxed);
        sample
    }
}

unsafe extern "C" fn to_ser_unref(sample: *mut ddsi_serdata, _: *const ddsrt_iovec_t) {
    // SAFETY: gives back the reference that `to_ser_ref` took.
    unsafe { cyclors::ddsi_serdata_unref(sample) };
}

/// The key of a sample, which is nothing.
unsafe extern "C" fn to_untyped(sample: *const ddsi_serdata) -> *mut ddsi_serdata {
    // SAFETY: as in `write`; the type is that of a live sample, and a key is not to refer to it
    // afterwards.
    unsafe {
        let mut key = Box::new(Sample { base: std::mem::zeroed(), message: Buffer::default() });
        cyclors::ddsi_serdata_init(
            &mut key.base,
            (*sample).type_,
            cyclors::ddsi_serdata_kind_SDK_KEY,
        );
        key.base.ops = &OPERATIONS;
        key.base.type_ = ptr::null();
        Box::into_raw(key).cast()
    }
}

unsafe extern "C" fn free(sample: *mut ddsi_serdata) {
    // SAFETY: as in `get_size`; this was the last reference, and the box was given away when the
    // first was.
    drop(unsafe { Box::from_raw(sample.cast::<Sample>()) });
}

/// What a trace of Cyclone DDS shows of a sample: nothing.
unsafe extern "C" fn print(
    _: *const ddsi_sertype,
    _: *const ddsi_serdata,
    into: *mut c_char,
    len: usize,
) -> usize {
    if len > 0 {
        // SAFETY: there is room for `len` bytes.
        unsafe { *into = 0 };
    }
    0
}

unsafe extern "C" fn get_keyhash(
    _: *const ddsi_serdata,
    into: *mut ddsi_keyhash,
    _force_md5: bool,
) {
    // SAFETY: Cyclone DDS brings the place for the answer.
    unsafe { (*into).value = [0; 16] };
}

//! Cyclone DDS: a participant, and writers of any type that send whole CDR messages without
//! copying.
//!
//! A topic of Cyclone DDS is usually created from a C type. `cyclors` also creates one from names
//! alone, whose samples are opaque bytes. For those this module provides its own operations on
//! samples: Cyclone DDS refers to the buffers of the player, and drops them when the last reader
//! has acknowledged them. There are no readers here, so no sample is ever created from received
//! bytes.
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

#[derive(Debug, thiserror::Error)]
pub(crate) enum CycloneError {
    /// A participant or a writer cannot be created.
    #[error("Cyclone DDS cannot create {what}: {reason}")]
    Create { what: String, reason: String },
    /// A message was not sent: readers did not acknowledge earlier ones in time.
    #[error("readers did not acknowledge earlier messages within {} s", MAX_BLOCKING.as_secs())]
    Blocked,
    /// A message was not sent for another reason.
    #[error("Cyclone DDS cannot send a message of {len} bytes: {reason}")]
    Write { len: usize, reason: String },
}

impl Explain for CycloneError {
    fn help(&self) -> Option<String> {
        matches!(self, CycloneError::Create { .. }).then(|| {
            "see the output of Cyclone DDS above; check that a network interface is up and that \
             --interface is one of its addresses"
                .to_owned()
        })
    }

    fn exit(&self) -> Exit {
        Exit::Unreachable
    }
}

/// Maximum time that a write waits for slow readers. ROS 2 waits forever; then a stopped reader
/// would stop the player.
const MAX_BLOCKING: Duration = Duration::from_secs(1);

/// Larger than any message of ROS 2; the maximum that Cyclone DDS sends.
const MAX_MESSAGE: usize = i32::MAX as usize - 8;

pub(crate) struct Participant {
    participant: dds_entity_t,
}

impl Participant {
    /// Joins a domain, with this configuration (XML), or with that of the environment.
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

    /// Creates a writer for a topic, by the DDS names of the topic and its type.
    pub(crate) fn writer(
        &self,
        topic: &str,
        type_name: &str,
        offer: Offer,
    ) -> Result<CycloneWriter<'_>, CycloneError> {
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
        // SAFETY: `topic` was created above, and the pointer for the result is valid.
        let answer = unsafe { cyclors::dds_get_entity_sertype(topic, &mut sertype) };
        created(answer, what)?;
        // SAFETY: `qos` is new, set by the calls below, copied by dds_create_writer and deleted
        // once; the array of representations has the given length.
        let writer = unsafe {
            let qos = cyclors::dds_create_qos();
            let (reliability, durability) = kinds(offer);
            cyclors::dds_qset_reliability(qos, reliability, MAX_BLOCKING.as_nanos() as i64);
            cyclors::dds_qset_durability(qos, durability);
            // At most 1000: see `Offer`.
            let depth = offer.depth as i32;
            let keep_last = cyclors::dds_history_kind_DDS_HISTORY_KEEP_LAST;
            cyclors::dds_qset_history(qos, keep_last, depth);
            // Number of samples of a transient-local topic that are kept for late readers.
            cyclors::dds_qset_durability_service(qos, 0, keep_last, depth, -1, -1, -1);
            let xcdr1 = DDS_DATA_REPRESENTATION_XCDR1 as i16;
            cyclors::dds_qset_data_representation(qos, 1, &xcdr1);
            let writer = cyclors::dds_create_writer(self.participant, topic, qos, ptr::null());
            cyclors::dds_delete_qos(qos);
            writer
        };
        created(writer, what).map(|writer| CycloneWriter { writer, sertype, _participant: self })
    }
}

impl Drop for Participant {
    fn drop(&mut self) {
        // Also deletes its writers and topics. An error can only mean that it no longer exists.
        // SAFETY: an invalid handle is refused.
        unsafe { cyclors::dds_delete(self.participant) };
    }
}

pub(crate) struct CycloneWriter<'p> {
    writer: dds_entity_t,
    /// The topic's type, which lives as long as the topic, and so as the participant.
    sertype: *const ddsi_sertype,
    _participant: &'p Participant,
}

// SAFETY: Cyclone DDS locks its entities itself, and never changes a type after creation.
unsafe impl Send for CycloneWriter<'_> {}
// SAFETY: as above.
unsafe impl Sync for CycloneWriter<'_> {}

impl CycloneWriter<'_> {
    /// Sends `message`: encapsulation, CDR, and zeros up to a multiple of four. Returns when the
    /// kernel has it; waits at most [`MAX_BLOCKING`] for slow readers.
    pub(crate) fn write(&self, message: Buffer) -> Result<(), CycloneError> {
        let len = message.len();
        if len > MAX_MESSAGE || !len.is_multiple_of(4) || len < 4 {
            return Err(CycloneError::Write { len, reason: "invalid length".to_owned() });
        }
        // SAFETY: all of `ddsi_serdata` is numbers and pointers, for which zeros are valid;
        // `ddsi_serdata_init` fills it with one reference, which dds_writecdr takes over.
        let code = unsafe {
            let mut sample = Box::new(CycloneSample { base: std::mem::zeroed(), message });
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
            code => Err(CycloneError::Write { len, reason: reason(code) }),
        }
    }

    /// Number of readers that match now.
    pub(crate) fn readers(&self) -> usize {
        // SAFETY: with room for no handle, none is written; the result is their number.
        let count =
            unsafe { cyclors::dds_get_matched_subscriptions(self.writer, ptr::null_mut(), 0) };
        usize::try_from(count).unwrap_or(0)
    }

    /// Waits until all readers have acknowledged everything. Returns false on timeout.
    pub(crate) fn flush(&self, at_most: Duration) -> bool {
        // SAFETY: only the handle is passed, and an invalid one is refused.
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
        Err(CycloneError::Create { what: what(), reason: reason(answer) })
    }
}

fn reason(code: i32) -> String {
    // SAFETY: for any number, the result is a terminated text that is never freed.
    unsafe { CStr::from_ptr(cyclors::dds_strretcode(code)) }.to_string_lossy().into_owned()
}

/// A message as Cyclone DDS holds it: it accesses only the first field, and frees it by [`free`].
#[repr(C)]
struct CycloneSample {
    base: ddsi_serdata,
    message: Buffer,
}

/// Operations of a sample that is written. The rest is for received samples.
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
    let message = unsafe { &(*sample.cast::<CycloneSample>()).message };
    // At most MAX_MESSAGE.
    message.len() as u32
}

unsafe extern "C" fn to_ser(
    sample: *const ddsi_serdata,
    from: usize,
    len: usize,
    into: *mut c_void,
) {
    // SAFETY: as in `get_size`; `into` has room for `len` bytes, and does not overlap the message.
    unsafe {
        let message = &(*sample.cast::<CycloneSample>()).message;
        ptr::copy_nonoverlapping(message[from..from + len].as_ptr(), into.cast::<u8>(), len);
    }
}

/// Lends a part of the message. The loan counts as a reference, so that the part stays in place
/// until [`to_ser_unref`].
unsafe extern "C" fn to_ser_ref(
    sample: *const ddsi_serdata,
    from: usize,
    len: usize,
    part: *mut ddsrt_iovec_t,
) -> *mut ddsi_serdata {
    // SAFETY: as in `get_size`; `part` is valid. The count is only ever changed atomically, by
    // Cyclone DDS and here. What is lent is only read.
    unsafe {
        let lent = &(&(*sample.cast::<CycloneSample>()).message)[from..from + len];
        (*part).iov_base = lent.as_ptr().cast_mut().cast();
        (*part).iov_len = len;
        let sample = sample.cast_mut();
        AtomicU32::from_ptr(&raw mut (*sample).refc.v).fetch_add(1, Ordering::Relaxed);
        sample
    }
}

unsafe extern "C" fn to_ser_unref(sample: *mut ddsi_serdata, _: *const ddsrt_iovec_t) {
    // SAFETY: releases the reference that `to_ser_ref` took.
    unsafe { cyclors::ddsi_serdata_unref(sample) };
}

/// The key of a sample, which is empty.
unsafe extern "C" fn to_untyped(sample: *const ddsi_serdata) -> *mut ddsi_serdata {
    // SAFETY: as in `write`; the type is that of a live sample, and a key must not refer to it
    // afterwards.
    unsafe {
        let mut key =
            Box::new(CycloneSample { base: std::mem::zeroed(), message: Buffer::default() });
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
    // SAFETY: as in `get_size`; this was the last reference, and the box was released when the
    // first was created.
    drop(unsafe { Box::from_raw(sample.cast::<CycloneSample>()) });
}

/// Prints a sample in a trace of Cyclone DDS: as nothing.
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
    // SAFETY: Cyclone DDS passes a valid pointer for the result.
    unsafe { (*into).value = [0; 16] };
}

//! Passes CDR bytes of any type out of RustDDS and into it, unchanged.

use std::cell::RefCell;
use std::convert::Infallible;
use std::panic::{AssertUnwindSafe, catch_unwind};

use bytes::Bytes;
use rustdds::{RepresentationIdentifier, no_key};

use super::state::panic_text;
use gleaner_messages::Endian;
use gleaner_messages::transport::{Clock, Sink};

pub(super) type RawReader = no_key::SimpleDataReader<Raw, RawAdapter>;
pub(super) type RawWriter = no_key::DataWriter<Bytes, RawAdapter>;

/// A sample at the time its bytes are copied.
#[derive(Debug)]
pub(super) struct Raw {
    pub(super) at_ns: i64,
    pub(super) endian: Endian,
    pub(super) copied_to: CopiedTo,
}

/// The place to which the bytes of a sample were copied.
#[derive(Debug)]
pub(super) enum CopiedTo {
    /// To the sink, unless the sink refused them.
    Sink,
    /// To the memory that all samples share.
    SharedMemory,
    /// Nowhere: the sink panicked, with this text.
    SinkPanicked(String),
    /// Nowhere: the sample cannot be read, for this reason.
    Unreadable(String),
}

/// Binds RustDDS to bytes.
pub(super) struct RawAdapter;

impl no_key::DeserializerAdapter<Raw> for RawAdapter {
    type Error = Unreadable;
    type Decoded = Raw;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &ENCODINGS
    }

    fn transform_decoded(raw: Raw) -> Raw {
        raw
    }
}

impl no_key::SerializerAdapter<Bytes> for RawAdapter {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(cdr: &Bytes) -> Result<Bytes, Infallible> {
        Ok(cdr.clone())
    }
}

/// All encodings that have a name. Only the first two are read. For a sample in one of the others,
/// RustDDS gives its writer and number, which it does not for an encoding that is missing here.
const ENCODINGS: [RepresentationIdentifier; 17] = [
    RepresentationIdentifier::CDR_LE,
    RepresentationIdentifier::CDR_BE,
    RepresentationIdentifier::PL_CDR_LE,
    RepresentationIdentifier::PL_CDR_BE,
    RepresentationIdentifier::XML,
    RepresentationIdentifier::XCDR2_LE,
    RepresentationIdentifier::XCDR2_BE,
    RepresentationIdentifier::D_CDR2_LE,
    RepresentationIdentifier::D_CDR2_BE,
    RepresentationIdentifier::PL_XCDR2_LE,
    RepresentationIdentifier::PL_XCDR2_BE,
    RepresentationIdentifier::CDR2_LE,
    RepresentationIdentifier::CDR2_BE,
    RepresentationIdentifier::PL_CDR2_LE,
    RepresentationIdentifier::PL_CDR2_BE,
    RepresentationIdentifier::D_CDR_LE,
    RepresentationIdentifier::D_CDR_BE,
];

#[derive(Debug, thiserror::Error)]
pub(super) enum Unreadable {
    #[error("no memory for {bytes} bytes")]
    NoMemory { bytes: usize },
    #[error("{encoding:?} is not CDR")]
    Encoding { encoding: RepresentationIdentifier },
}

/// Copies a sample into the sink's memory, if the sink can copy before it gets the sample's
/// metadata; else into memory that all samples share, one after the other.
///
/// RustDDS gives the bytes while it holds the lock of the topic, and their writer only afterwards.
/// A panic that unwound from here would poison that lock and end RustDDS's own thread.
#[derive(Copy, Clone)]
pub(super) struct CopyInto<'a> {
    pub(super) sink: Option<&'a dyn Sink>,
    pub(super) memory: &'a RefCell<Vec<u8>>,
    pub(super) clock: Clock,
}

impl<'de> no_key::Decode<'de, Raw> for CopyInto<'_> {
    type Error = Unreadable;

    fn decode_bytes(
        self,
        bytes: &'de [u8],
        encoding: RepresentationIdentifier,
    ) -> Result<Raw, Unreadable> {
        let at_ns = self.clock.now();
        let endian = match encoding {
            RepresentationIdentifier::CDR_LE => Endian::Little,
            RepresentationIdentifier::CDR_BE => Endian::Big,
            encoding => return Err(Unreadable::Encoding { encoding }),
        };
        let raw = |copied_to| Ok(Raw { at_ns, endian, copied_to });
        if let Some(sink) = self.sink {
            match catch_unwind(AssertUnwindSafe(|| sink.copy(bytes))) {
                Ok(Some(_)) => return raw(CopiedTo::Sink),
                Ok(None) => {}
                Err(panic) => return raw(CopiedTo::SinkPanicked(panic_text(&*panic))),
            }
        }
        let mut memory = self.memory.borrow_mut();
        memory.clear();
        memory.try_reserve(bytes.len()).map_err(|_| Unreadable::NoMemory { bytes: bytes.len() })?;
        memory.extend_from_slice(bytes);
        raw(CopiedTo::SharedMemory)
    }
}

/// Copies a sample, or returns the error in place of it: with an error, RustDDS does not give the
/// sample's writer.
#[derive(Copy, Clone)]
pub(super) struct CopyOrReport<'a>(pub(super) CopyInto<'a>);

impl<'de> no_key::Decode<'de, Raw> for CopyOrReport<'_> {
    type Error = Unreadable;

    fn decode_bytes(
        self,
        bytes: &'de [u8],
        encoding: RepresentationIdentifier,
    ) -> Result<Raw, Unreadable> {
        let unreadable = |why: Unreadable| {
            let copied_to = CopiedTo::Unreadable(why.to_string());
            Raw { at_ns: self.0.clock.now(), endian: Endian::Little, copied_to }
        };
        Ok(self.0.decode_bytes(bytes, encoding).unwrap_or_else(unreadable))
    }
}

//! CDR bytes out of RustDDS and into it, untouched, whatever their type.

use std::cell::RefCell;
use std::convert::Infallible;
use std::panic::{AssertUnwindSafe, catch_unwind};

use bytes::Bytes;
use rustdds::{RepresentationIdentifier, no_key};

use super::state::panic_text;
use gleaner_messages::Endian;
use gleaner_transport::{Clock, Sink};

/// A reader of any type.
pub(super) type RawReader = no_key::SimpleDataReader<Raw, RawAdapter>;
/// A writer of any type.
pub(super) type RawWriter = no_key::DataWriter<Bytes, RawAdapter>;

/// What is known of a sample when its bytes are copied.
#[derive(Debug)]
pub(super) struct Raw {
    pub(super) at_ns: i64,
    pub(super) endian: Endian,
    pub(super) held: Held,
}

/// Who has the bytes of a sample.
#[derive(Debug)]
pub(super) enum Held {
    /// The sink, or it has refused them.
    Sink,
    /// The memory that all samples share.
    Memory,
    /// Nobody: the sink panicked, with these words.
    Nobody(String),
    /// Nobody: it cannot be read, for this reason.
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

/// All that have a name. Only the first two are read; of a sample in one of the others, RustDDS
/// tells whose it is and which, which it does not of a sample in one that is missing here.
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

/// Why a sample cannot be read.
#[derive(Debug, thiserror::Error)]
pub(super) enum Unreadable {
    #[error("no memory for {bytes} bytes")]
    NoMemory { bytes: usize },
    #[error("{encoding:?} is not CDR")]
    Encoding { encoding: RepresentationIdentifier },
}

/// Copies a sample: into the sink's memory, if the sink can copy before it knows whose sample it
/// is; else into memory of ours that all samples share, one after the other.
///
/// RustDDS shows the bytes while it holds the lock of the topic, and says who wrote them only
/// afterwards. What unwound from here would poison that lock and end RustDDS's own thread.
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
        let raw = |held| Ok(Raw { at_ns, endian, held });
        if let Some(sink) = self.sink {
            match catch_unwind(AssertUnwindSafe(|| sink.copy(bytes))) {
                Ok(Some(_)) => return raw(Held::Sink),
                Ok(None) => {}
                Err(panic) => return raw(Held::Nobody(panic_text(&*panic))),
            }
        }
        let mut memory = self.memory.borrow_mut();
        memory.clear();
        memory.try_reserve(bytes.len()).map_err(|_| Unreadable::NoMemory { bytes: bytes.len() })?;
        memory.extend_from_slice(bytes);
        raw(Held::Memory)
    }
}

/// Copies a sample, or says in its place why not: with an error RustDDS does not tell whose sample
/// it was.
#[derive(Copy, Clone)]
pub(super) struct CopyOrSay<'a>(pub(super) CopyInto<'a>);

impl<'de> no_key::Decode<'de, Raw> for CopyOrSay<'_> {
    type Error = Unreadable;

    fn decode_bytes(
        self,
        bytes: &'de [u8],
        encoding: RepresentationIdentifier,
    ) -> Result<Raw, Unreadable> {
        let unreadable = |why: Unreadable| {
            let held = Held::Unreadable(why.to_string());
            Raw { at_ns: self.0.clock.now(), endian: Endian::Little, held }
        };
        Ok(self.0.decode_bytes(bytes, encoding).unwrap_or_else(unreadable))
    }
}

/// Reads and forgets.
#[derive(Copy, Clone)]
pub(super) struct PassOver;

impl<'de> no_key::Decode<'de, Raw> for PassOver {
    type Error = Unreadable;

    fn decode_bytes(self, _: &'de [u8], _: RepresentationIdentifier) -> Result<Raw, Unreadable> {
        Ok(Raw { at_ns: 0, endian: Endian::Little, held: Held::Memory })
    }
}

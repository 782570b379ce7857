//! Reads classic CDR: a cursor that aligns, checks bounds, and swaps bytes.
//!
//! The bytes are a payload without its four bytes of encapsulation; alignment counts from the first
//! byte and is at most 8. Source: OMG CORBA 3.0, section 15.3, called XCDR1 by DDS-XTypes.

#[derive(Copy, Clone, Debug, PartialEq, Eq, Hash, Default)]
pub enum Endian {
    /// Least significant byte first, as on nearly every vehicle.
    #[default]
    Little,
    /// Most significant byte first.
    Big,
}

/// Reasons why a field cannot be read from the bytes.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum CdrError {
    #[error("message too short: {needed} bytes needed at offset {offset}, it has {have} there")]
    Short { offset: usize, needed: usize, have: usize },
    #[error("sequence at offset {offset} claims {count} elements, only {have} bytes follow")]
    Count { offset: usize, count: usize, have: usize },
    #[error("element {index} requested, the sequence at offset {offset} has {count}")]
    Index { offset: usize, index: usize, count: usize },
    #[error("string at offset {offset} is not UTF-8")]
    NotUtf8 { offset: usize },
    /// [`super::FieldPath::number`] was called on a path whose kind is not a number.
    #[error("the field is not a number")]
    NotANumber,
    /// The message has a layout that its topic did not have when the path was compiled.
    #[error("it has layout {0} of its type, which is unknown")]
    Layout(u16),
}

#[derive(Copy, Clone)]
pub(super) struct Cursor<'a> {
    bytes: &'a [u8],
    /// May be beyond the end after a skip; the next read then fails.
    pos: usize,
    endian: Endian,
}

macro_rules! read_scalar {
    ($($name:ident: $ty:ty),*) => {$(
        pub(super) fn $name(&mut self) -> Result<$ty, CdrError> {
            self.align(size_of::<$ty>());
            let raw = self.array()?;
            Ok(match self.endian {
                Endian::Little => <$ty>::from_le_bytes(raw),
                Endian::Big => <$ty>::from_be_bytes(raw),
            })
        }
    )*};
}

impl<'a> Cursor<'a> {
    pub(super) fn new(bytes: &'a [u8], endian: Endian) -> Self {
        Self { bytes, pos: 0, endian }
    }

    pub(super) fn pos(&self) -> usize {
        self.pos
    }

    pub(super) fn endian(&self) -> Endian {
        self.endian
    }

    pub(super) fn left(&self) -> usize {
        self.bytes.len().saturating_sub(self.pos)
    }

    /// Moves to the next multiple of `to`, a power of two.
    pub(super) fn align(&mut self, to: usize) {
        // Positions stay below twice the length of a slice, so this cannot overflow; if it did,
        // saturation would make it a read error.
        self.pos = self.pos.saturating_add(to - 1) & !(to - 1);
    }

    /// Moves to `pos`, which may lie beyond the end: the next read then fails.
    pub(super) fn jump(&mut self, pos: usize) {
        self.pos = pos;
    }

    /// Skips `n` bytes, which must exist.
    pub(super) fn skip(&mut self, n: usize) -> Result<(), CdrError> {
        self.take(n).map(|_| ())
    }

    pub(super) fn take(&mut self, n: usize) -> Result<&'a [u8], CdrError> {
        let taken = self.pos.checked_add(n).and_then(|end| self.bytes.get(self.pos..end));
        match taken {
            Some(taken) => {
                self.pos += n;
                Ok(taken)
            }
            None => Err(self.short(n)),
        }
    }

    #[inline]
    fn array<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        let found = self.bytes.get(self.pos..).and_then(|rest| rest.first_chunk());
        match found {
            Some(raw) => {
                self.pos += N;
                Ok(*raw)
            }
            None => Err(self.short(N)),
        }
    }

    #[cold]
    fn short(&self, needed: usize) -> CdrError {
        CdrError::Short { offset: self.pos, needed, have: self.left() }
    }

    read_scalar!(u8: u8, i8: i8, u16: u16, i16: i16, u32: u32, i32: i32, u64: u64, i64: i64,
        f32: f32, f64: f64);

    /// Reads the count of a sequence whose elements take at least `least` bytes each (not 0).
    ///
    /// A count that the rest of the message cannot hold is an error here, before it controls a loop
    /// or an allocation.
    pub(super) fn count(&mut self, least: usize) -> Result<usize, CdrError> {
        let count = self.u32()? as usize;
        if count > self.left() / least {
            return Err(CdrError::Count { offset: self.pos - 4, count, have: self.left() });
        }
        Ok(count)
    }

    /// Skips a string: its length, its characters and the final zero.
    pub(super) fn skip_text(&mut self) -> Result<(), CdrError> {
        let len = self.u32()? as usize;
        self.skip(len)
    }

    /// Reads a string without its final zero. A length of 0, which some writers use, means empty.
    pub(super) fn text(&mut self) -> Result<&'a str, CdrError> {
        let len = self.u32()? as usize;
        let offset = self.pos;
        let raw = self.take(len)?;
        let raw = raw.strip_suffix(&[0]).unwrap_or(raw);
        str::from_utf8(raw).map_err(|_| CdrError::NotUtf8 { offset })
    }

    /// Returns the `n` elements of `size` bytes each that start at the next multiple of `size`.
    ///
    /// Without elements there is no padding: CDR aligns an element when it writes one.
    pub(super) fn elements(&mut self, n: usize, size: usize) -> Result<&'a [u8], CdrError> {
        if n == 0 {
            return Ok(&[]);
        }
        self.align(size);
        match n.checked_mul(size) {
            Some(len) => self.take(len),
            None => Err(self.short(usize::MAX)),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_aligned_to_their_size() {
        let bytes = [7, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0x40];
        let mut cursor = Cursor::new(&bytes, Endian::Little);
        assert_eq!(cursor.u8(), Ok(7));
        assert_eq!(cursor.u32(), Ok(1));
        assert_eq!(cursor.f64(), Ok(2.0));
        assert_eq!(cursor.u8(), Err(CdrError::Short { offset: 16, needed: 1, have: 0 }));
    }

    #[test]
    fn text_drops_its_zero_and_refuses_other_encodings() {
        assert_eq!(Cursor::new(b"\x03\0\0\0ab\0", Endian::Little).text(), Ok("ab"));
        assert_eq!(Cursor::new(b"\0\0\0\0", Endian::Little).text(), Ok(""));
        let latin1 = Cursor::new(b"\x02\0\0\0\xe4\0", Endian::Little).text();
        assert_eq!(latin1, Err(CdrError::NotUtf8 { offset: 4 }));
    }
}

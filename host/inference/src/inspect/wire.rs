//! Reads the fields of a protobuf message in place: no byte is copied, and no memory is taken for a
//! length before that many bytes are there.

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("it is not a protobuf message")]
pub(super) struct NoMessage;

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct WireField<'a> {
    pub(super) number: u64,
    pub(super) value: WireValue<'a>,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum WireValue<'a> {
    Varint(u64),
    Fixed,
    Bytes(&'a [u8]),
}

impl<'a> WireField<'a> {
    /// Returns the bytes of an embedded message or a string.
    pub(super) fn bytes(&self) -> Result<&'a [u8], NoMessage> {
        match self.value {
            WireValue::Bytes(bytes) => Ok(bytes),
            _ => Err(NoMessage),
        }
    }

    pub(super) fn text(&self) -> Result<&'a str, NoMessage> {
        std::str::from_utf8(self.bytes()?).map_err(|_| NoMessage)
    }

    /// Returns the fields of an embedded message.
    pub(super) fn fields(&self) -> Result<WireFields<'a>, NoMessage> {
        self.bytes().map(WireFields)
    }

    /// Adds the numbers of a list, which is one of them, or all of them packed.
    pub(super) fn numbers(&self, list: &mut Vec<i64>) -> Result<(), NoMessage> {
        let WireValue::Bytes(packed) = self.value else {
            list.push(self.number()?);
            return Ok(());
        };
        let mut packed = WireFields(packed);
        while !packed.0.is_empty() {
            list.push(packed.varint()?.cast_signed());
        }
        Ok(())
    }

    /// Returns a number; negative ones are encoded as the 64 bits of their two's complement.
    pub(super) fn number(&self) -> Result<i64, NoMessage> {
        match self.value {
            WireValue::Varint(value) => Ok(value.cast_signed()),
            _ => Err(NoMessage),
        }
    }
}

/// The fields of a message, in the order in which they were written.
#[derive(Debug, Clone, Copy)]
pub(super) struct WireFields<'a>(pub(super) &'a [u8]);

impl<'a> WireFields<'a> {
    /// Returns those with one of these numbers.
    pub(super) fn of(
        self,
        numbers: &'static [u64],
    ) -> impl Iterator<Item = Result<WireField<'a>, NoMessage>> {
        self.filter(move |field| {
            field.is_err() || field.is_ok_and(|it| numbers.contains(&it.number))
        })
    }

    fn varint(&mut self) -> Result<u64, NoMessage> {
        let mut value = 0_u64;
        for shift in (0..64).step_by(7) {
            let (first, rest) = self.0.split_first().ok_or(NoMessage)?;
            self.0 = rest;
            let bits = u64::from(first & 0x7f);
            // The tenth byte has one bit.
            if shift == 63 && bits > 1 {
                return Err(NoMessage);
            }
            value |= bits << shift;
            if first & 0x80 == 0 {
                return Ok(value);
            }
        }
        Err(NoMessage)
    }

    fn take(&mut self, length: u64) -> Result<&'a [u8], NoMessage> {
        let length = usize::try_from(length).map_err(|_| NoMessage)?;
        let (taken, rest) = self.0.split_at_checked(length).ok_or(NoMessage)?;
        self.0 = rest;
        Ok(taken)
    }

    fn field(&mut self) -> Result<WireField<'a>, NoMessage> {
        let key = self.varint()?;
        let value = match key & 7 {
            0 => WireValue::Varint(self.varint()?),
            1 => self.take(8).map(|_| WireValue::Fixed)?,
            2 => {
                let length = self.varint()?;
                WireValue::Bytes(self.take(length)?)
            }
            5 => self.take(4).map(|_| WireValue::Fixed)?,
            // Groups, which ONNX does not use.
            _ => return Err(NoMessage),
        };
        if key >> 3 == 0 {
            return Err(NoMessage);
        }
        Ok(WireField { number: key >> 3, value })
    }
}

impl<'a> Iterator for WireFields<'a> {
    type Item = Result<WireField<'a>, NoMessage>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.0.is_empty() {
            return None;
        }
        let field = self.field();
        if field.is_err() {
            self.0 = &[];
        }
        Some(field)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fields(bytes: &[u8]) -> Result<Vec<WireField<'_>>, NoMessage> {
        WireFields(bytes).collect()
    }

    #[test]
    fn fields_of_every_kind_are_read() {
        let bytes = [&[0x08, 0x96, 0x01, 0x12, 2, b'h', b'i', 0x1d, 0, 0, 0, 0, 0x21][..], &[0; 8]];
        let read = fields(&bytes.concat()).map(|fields| {
            let texts = fields.iter().filter_map(|field| field.text().ok());
            (fields.len(), fields[0].number(), texts.collect::<String>())
        });
        assert_eq!(read, Ok((4, Ok(150), "hi".to_owned())));
        let mut listed = Vec::new();
        for field in fields(&[0x08, 7, 0x0a, 3, 0x96, 0x01, 2]).unwrap() {
            field.numbers(&mut listed).unwrap();
        }
        assert_eq!(listed, [7, 150, 2]);
        let minus_one = [&[0x08][..], &[0xff; 9], &[1]].concat();
        assert_eq!(fields(&minus_one).unwrap()[0].number(), Ok(-1));
    }

    #[test]
    fn truncated_and_impossible_fields_are_refused() {
        let long = [&[0x08][..], &[0xff; 9], &[2]].concat();
        let huge = [0x12, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0x7f];
        for bytes in [&[0x08][..], &[0x12, 3, 1, 2], &[0x0b], &[0x0c], &[0], &[0x1d, 0], &long] {
            assert_eq!(fields(bytes), Err(NoMessage), "{bytes:?}");
        }
        assert_eq!(fields(&huge), Err(NoMessage));
    }
}

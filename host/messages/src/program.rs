//! The skip program of a compiled field path, and its interpreter.

use super::cdr::{CdrError, Cursor, Endian};
use super::layout::SkipTable;
use super::parse::{Count, Primitive};
use super::value::{MessageValue, ValueKind};

#[derive(Debug)]
pub(super) enum Op {
    /// Any run of fixed-size fields.
    Fixed(SkipTable),
    Text,
    /// A sequence of primitives of this many bytes each.
    Primitives(usize),
    /// A sequence of fixed-size structs of at least `least` bytes each.
    Structs {
        table: SkipTable,
        least: usize,
    },
    /// A sequence of elements of variable size, of at least `least` bytes each.
    Each {
        body: Box<[Op]>,
        least: usize,
    },
    /// `n` elements of variable size, without a count in front.
    Times {
        body: Box<[Op]>,
        n: usize,
    },
    /// The count of a sequence with element `index` on the path; the steps that follow skip those
    /// before it.
    Enter {
        index: usize,
        least: usize,
    },
}

#[derive(Copy, Clone, Debug)]
pub(super) enum Leaf {
    Scalar(Primitive),
    Text,
    /// Never [`Count::One`].
    Array(Primitive, Count),
    /// Never [`Count::One`].
    Texts(Count),
}

/// Runs `ops` from the cursor's position.
///
/// A fixed run may end beyond the message: the next read then fails. Every loop body reads at least
/// one count or string length, so the message bounds the number of iterations.
pub(super) fn walk(ops: &[Op], cursor: &mut Cursor<'_>) -> Result<(), CdrError> {
    for op in ops {
        match op {
            Op::Fixed(table) => cursor.jump(table.after(cursor.pos())),
            Op::Text => cursor.skip_text()?,
            Op::Primitives(size) => {
                let n = cursor.count(*size)?;
                cursor.elements(n, *size)?;
            }
            Op::Structs { table, least } => {
                let n = cursor.count(*least)?;
                cursor.jump(table.after_times(cursor.pos(), n));
            }
            Op::Each { body, least } => {
                for _ in 0..cursor.count(*least)? {
                    walk(body, cursor)?;
                }
            }
            Op::Times { body, n } => {
                for _ in 0..*n {
                    walk(body, cursor)?;
                }
            }
            Op::Enter { index, least } => {
                let count = cursor.count(*least)?;
                if *index >= count {
                    let offset = cursor.pos() - 4;
                    return Err(CdrError::Index { offset, index: *index, count });
                }
            }
        }
    }
    Ok(())
}

impl Leaf {
    pub(super) fn kind(&self) -> ValueKind {
        match self {
            Self::Scalar(Primitive::Bool) => ValueKind::Bool,
            Self::Scalar(Primitive::F32 | Primitive::F64) => ValueKind::Real,
            Self::Scalar(Primitive::U8 | Primitive::U16 | Primitive::U32 | Primitive::U64) => {
                ValueKind::Unsigned
            }
            Self::Scalar(_) => ValueKind::Signed,
            Self::Text => ValueKind::Text,
            Self::Array(Primitive::U8, _) => ValueKind::Bytes,
            Self::Array(..) => ValueKind::Numbers,
            Self::Texts(_) => ValueKind::Texts,
        }
    }

    pub(super) fn read<'a>(&self, cursor: &mut Cursor<'a>) -> Result<MessageValue<'a>, CdrError> {
        Ok(match *self {
            Self::Scalar(primitive) => scalar(primitive, cursor)?,
            Self::Text => MessageValue::Text(cursor.text()?),
            Self::Array(primitive, count) => {
                let n = elements(count, primitive.size(), cursor)?;
                let raw = cursor.elements(n, primitive.size())?;
                match primitive {
                    Primitive::U8 => MessageValue::Bytes(raw),
                    _ => MessageValue::Numbers(numbers(primitive, raw, cursor.endian())),
                }
            }
            Self::Texts(count) => {
                let n = elements(count, 4, cursor)?;
                // A fixed count comes from the definition: allocate only for what the message can
                // hold.
                let mut texts = Vec::with_capacity(n.min(cursor.left() / 4));
                for _ in 0..n {
                    texts.push(cursor.text()?);
                }
                MessageValue::Texts(texts)
            }
        })
    }

    #[inline]
    pub(super) fn number(&self, cursor: &mut Cursor<'_>) -> Result<f64, CdrError> {
        let Self::Scalar(primitive) = *self else {
            return Err(CdrError::NotANumber);
        };
        Ok(match primitive {
            Primitive::F64 => cursor.f64()?,
            Primitive::F32 => cursor.f32()?.into(),
            Primitive::Bool => u8::from(cursor.u8()? != 0).into(),
            Primitive::U8 => cursor.u8()?.into(),
            Primitive::I8 => cursor.i8()?.into(),
            Primitive::U16 => cursor.u16()?.into(),
            Primitive::I16 => cursor.i16()?.into(),
            Primitive::U32 => cursor.u32()?.into(),
            Primitive::I32 => cursor.i32()?.into(),
            Primitive::U64 => cursor.u64()? as f64,
            Primitive::I64 => cursor.i64()? as f64,
        })
    }
}

fn elements(count: Count, least: usize, cursor: &mut Cursor<'_>) -> Result<usize, CdrError> {
    match count {
        Count::One => Ok(1),
        Count::Fixed(n) => Ok(n),
        Count::Sequence => cursor.count(least),
    }
}

fn scalar<'a>(primitive: Primitive, cursor: &mut Cursor<'a>) -> Result<MessageValue<'a>, CdrError> {
    Ok(match primitive {
        Primitive::Bool => MessageValue::Bool(cursor.u8()? != 0),
        Primitive::U8 => MessageValue::Unsigned(cursor.u8()?.into()),
        Primitive::U16 => MessageValue::Unsigned(cursor.u16()?.into()),
        Primitive::U32 => MessageValue::Unsigned(cursor.u32()?.into()),
        Primitive::U64 => MessageValue::Unsigned(cursor.u64()?),
        Primitive::I8 => MessageValue::Signed(cursor.i8()?.into()),
        Primitive::I16 => MessageValue::Signed(cursor.i16()?.into()),
        Primitive::I32 => MessageValue::Signed(cursor.i32()?.into()),
        Primitive::I64 => MessageValue::Signed(cursor.i64()?),
        Primitive::F32 => MessageValue::Real(cursor.f32()?.into()),
        Primitive::F64 => MessageValue::Real(cursor.f64()?),
    })
}

/// `raw` is a whole number of elements, as [`Cursor::elements`] returns it.
fn numbers(primitive: Primitive, raw: &[u8], endian: Endian) -> Vec<f64> {
    macro_rules! each {
        ($ty:ty) => {{
            let (chunks, _) = raw.as_chunks::<{ size_of::<$ty>() }>();
            match endian {
                Endian::Little => chunks.iter().map(|c| <$ty>::from_le_bytes(*c) as f64).collect(),
                Endian::Big => chunks.iter().map(|c| <$ty>::from_be_bytes(*c) as f64).collect(),
            }
        }};
    }
    match primitive {
        Primitive::Bool => raw.iter().map(|byte| u8::from(*byte != 0).into()).collect(),
        Primitive::U8 => each!(u8),
        Primitive::I8 => each!(i8),
        Primitive::U16 => each!(u16),
        Primitive::I16 => each!(i16),
        Primitive::U32 => each!(u32),
        Primitive::I32 => each!(i32),
        Primitive::U64 => each!(u64),
        Primitive::I64 => each!(i64),
        Primitive::F32 => each!(f32),
        Primitive::F64 => each!(f64),
    }
}

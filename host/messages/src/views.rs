//! Views of the two image messages, borrowed from the bytes.

use super::cdr::{CdrError, Cursor, Endian};
use super::definitions::Definitions;
use super::sources::Sources;

/// A `sensor_msgs/msg/Image` without its header.
///
/// Only the bounds of the message are checked: `data` may be shorter or longer than `height *
/// step`.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct ImageView<'a> {
    pub width: u32,
    pub height: u32,
    /// Pixel format, such as `rgb8`.
    pub encoding: &'a str,
    /// Byte order of pixels wider than a byte.
    pub is_bigendian: bool,
    /// Bytes from one row to the next.
    pub step: u32,
    /// Pixels, row by row.
    pub data: &'a [u8],
}

/// A `sensor_msgs/msg/CompressedImage` without its header.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct CompressedView<'a> {
    /// Description of `data` by the writer, such as `jpeg` or `rgb8; jpeg compressed bgr8`.
    pub format: &'a str,
    /// The compressed file.
    pub data: &'a [u8],
}

/// Returns whether a view reads messages of these definitions: all of their layouts are that of
/// ROS 2, whatever the type is called.
pub fn is_viewed(definitions: &Definitions) -> bool {
    let known = Sources::new(&[], &[]).find(definitions.type_name()).ok().flatten();
    let known = known.and_then(|text| Definitions::parse(definitions.type_name(), &text).ok());
    known.is_some_and(|known| definitions.layouts().all(|layout| layout.is_equivalent(&known)))
}

impl<'a> ImageView<'a> {
    /// Reads a whole `sensor_msgs/msg/Image`.
    pub fn read(cdr: &'a [u8], endian: Endian) -> Result<Self, CdrError> {
        let mut cursor = Cursor::new(cdr, endian);
        skip_header(&mut cursor)?;
        let (height, width) = (cursor.u32()?, cursor.u32()?);
        let encoding = cursor.text()?;
        let is_bigendian = cursor.u8()? != 0;
        let step = cursor.u32()?;
        Ok(Self { width, height, encoding, is_bigendian, step, data: bytes(&mut cursor)? })
    }
}

impl<'a> CompressedView<'a> {
    /// Reads a whole `sensor_msgs/msg/CompressedImage`.
    pub fn read(cdr: &'a [u8], endian: Endian) -> Result<Self, CdrError> {
        let mut cursor = Cursor::new(cdr, endian);
        skip_header(&mut cursor)?;
        Ok(Self { format: cursor.text()?, data: bytes(&mut cursor)? })
    }
}

/// Skips a `std_msgs/Header`: a stamp of eight bytes and the name of the frame.
fn skip_header(cursor: &mut Cursor<'_>) -> Result<(), CdrError> {
    cursor.skip(8)?;
    cursor.skip_text()
}

fn bytes<'a>(cursor: &mut Cursor<'a>) -> Result<&'a [u8], CdrError> {
    let n = cursor.count(1)?;
    cursor.take(n)
}

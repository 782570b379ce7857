//! Reads the time stamp at the front of most messages, without a path.

use super::cdr::{CdrError, Cursor, Endian};
use super::definitions::{Definitions, Struct};
use super::parse::{Count, Element, FieldDefinition, Primitive};

/// Reads `header.stamp`, or a leading `stamp`, of one message type.
#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub struct HeaderStamp(());

/// Returns a reader of the stamp, if the type begins with a `std_msgs/Header` or with a
/// `builtin_interfaces/Time` named `stamp`: then the stamp is in the first eight bytes.
pub fn header_stamp(definitions: &Definitions) -> Option<HeaderStamp> {
    let inner = first(definitions, definitions.root())?;
    let is_stamped = match inner {
        ("stamp", time) => is_time(time),
        (_, header) if header.name == "std_msgs/Header" => {
            first(definitions, header).is_some_and(|(name, time)| name == "stamp" && is_time(time))
        }
        _ => false,
    };
    is_stamped.then_some(HeaderStamp(()))
}

impl HeaderStamp {
    /// Returns the stamp, in ns.
    ///
    /// # Errors
    ///
    /// [`CdrError::Short`] if the message has fewer than eight bytes.
    pub fn read(&self, cdr: &[u8], endian: Endian) -> Result<i64, CdrError> {
        let mut cursor = Cursor::new(cdr, endian);
        let (sec, nanosec) = (cursor.i32()?, cursor.u32()?);
        // At most 2^31 s, which is far inside i64 in ns.
        Ok(i64::from(sec) * 1_000_000_000 + i64::from(nanosec))
    }
}

fn first<'d>(definitions: &'d Definitions, owner: &'d Struct) -> Option<(&'d str, &'d Struct)> {
    let field = owner.fields.first().filter(|field| field.count == Count::One)?;
    match &field.element {
        Element::Struct(index) => Some((&field.name, definitions.get(*index))),
        _ => None,
    }
}

/// A drive may define the type differently: then its bytes are not a stamp.
fn is_time(found: &Struct) -> bool {
    let is = |field: &FieldDefinition<usize>, name: &str, primitive| {
        field.name == name
            && field.count == Count::One
            && matches!(&field.element, Element::Primitive(p) if *p == primitive)
    };
    found.name == "builtin_interfaces/Time"
        && matches!(&found.fields[..], [sec, nanosec]
            if is(sec, "sec", Primitive::I32) && is(nanosec, "nanosec", Primitive::U32))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stamp_of(text: &str) -> Option<HeaderStamp> {
        header_stamp(&Definitions::parse("p/T", text).unwrap())
    }

    #[test]
    fn a_type_that_only_has_the_names_of_a_stamp_is_not_one() {
        let text = "builtin_interfaces/Time stamp\n===\nMSG: builtin_interfaces/Time\n";
        assert!(stamp_of(&format!("{text}int32 sec\nuint32 nanosec\n")).is_some());
        for other in [
            "int64 sec\nuint32 nanosec\n",
            "int32 sec\nint32 nanosec\n",
            "int32[1] sec\nuint32 nanosec\n",
        ] {
            assert_eq!(stamp_of(&format!("{text}{other}")), None, "{other}");
        }
    }

    const HEADER: &str =
        "===\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n";

    #[test]
    fn a_leading_header_or_stamp_is_found() {
        assert!(stamp_of(&format!("std_msgs/Header header\nint8 x\n{HEADER}")).is_some());
        assert!(stamp_of("builtin_interfaces/Time stamp").is_some());
        assert!(stamp_of(&format!("int8 x\nstd_msgs/Header header\n{HEADER}")).is_none());
        assert!(stamp_of("builtin_interfaces/Time until").is_none());
        assert!(stamp_of("builtin_interfaces/Duration stamp").is_none());
    }

    #[test]
    fn seconds_and_nanoseconds_become_nanoseconds() {
        let stamp = HeaderStamp(());
        assert_eq!(stamp.read(&[2, 0, 0, 0, 5, 0, 0, 0], Endian::Little), Ok(2_000_000_005));
        assert_eq!(stamp.read(&[0xff; 8], Endian::Big), Ok(-1_000_000_000 + 4_294_967_295));
        assert!(stamp.read(&[0; 7], Endian::Little).is_err());
    }
}

//! Checks that the indexes of an MCAP file name all of its records and no others, since readers may
//! rely on an index.

use std::collections::BTreeMap;

use crate::records::op;

/// Maximum number of records to compare: some 60 MB of memory.
const RECORDS_MAX: usize = 1 << 20;
/// Bytes at the beginning of an index record with a position and a length.
pub const INDEX_BYTES: usize = 32;

/// Chunks, attachments and metadata records by position: their kind, and their length with the
/// head.
type Places = BTreeMap<u64, (u8, u64)>;

/// The positions of records in the file and in its indexes.
#[derive(Default)]
pub struct Indexes {
    held: Places,
    named: Places,
    misfit: Option<String>,
}

impl Indexes {
    /// Notes the record at `at`, which has `len` bytes with its head. For an index record, `body`
    /// has its first [`INDEX_BYTES`] bytes, or all if it is shorter.
    pub fn add(&mut self, opcode: u8, at: u64, len: u64, body: &[u8]) {
        let number =
            |from: usize| body.get(from..from + 8)?.first_chunk().copied().map(u64::from_le_bytes);
        let is_new = match opcode {
            op::CHUNK | op::ATTACHMENT | op::METADATA => {
                self.held.insert(at, (opcode, len)).is_none()
            }
            op::CHUNK_INDEX => self.name(op::CHUNK, number(16), number(24)),
            op::ATTACHMENT_INDEX => self.name(op::ATTACHMENT, number(0), number(8)),
            op::METADATA_INDEX => self.name(op::METADATA, number(0), number(8)),
            op::HEADER..=op::DATA_END => true,
            _ => {
                return self
                    .note(|| format!("a record of unknown kind {opcode:#04x} at byte {at}"));
            }
        };
        if !is_new {
            self.note(|| {
                format!("an index record at byte {at} that is malformed, or names a record again")
            });
        }
        if self.held.len() + self.named.len() > RECORDS_MAX {
            self.note(|| format!("more than {RECORDS_MAX} records with an index"));
            (self.held, self.named) = Default::default();
        }
    }

    /// Returns the first difference; `None` in a correct file.
    pub fn misfit(self) -> Option<String> {
        let Self { held, named, misfit } = self;
        let differs = |a: &Places, b: &Places| {
            a.iter().find(|(at, record)| b.get(at) != Some(record)).map(|(at, _)| *at)
        };
        misfit
            .or_else(|| {
                differs(&named, &held)
                    .map(|at| format!("an index names byte {at}, which has no such record"))
            })
            .or_else(|| {
                differs(&held, &named).map(|at| format!("no index names the record at byte {at}"))
            })
    }

    fn name(&mut self, opcode: u8, at: Option<u64>, len: Option<u64>) -> bool {
        at.zip(len).is_some_and(|(at, len)| self.named.insert(at, (opcode, len)).is_none())
    }

    fn note(&mut self, what: impl FnOnce() -> String) {
        self.misfit.get_or_insert_with(what);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn index(at: u64, len: u64) -> Vec<u8> {
        [at, len].map(u64::to_le_bytes).concat()
    }

    fn misfit(records: &[(u8, u64, u64, Vec<u8>)]) -> Option<String> {
        let mut indexes = Indexes::default();
        records.iter().for_each(|(opcode, at, len, body)| indexes.add(*opcode, *at, *len, body));
        indexes.misfit()
    }

    #[test]
    fn indexes_must_name_each_record_once_and_nothing_else() {
        let record = (op::METADATA, 8, 20, Vec::new());
        let named = |at, len| (op::METADATA_INDEX, 100, 30, index(at, len));
        assert_eq!(misfit(&[record.clone(), named(8, 20)]), None);
        for (records, expected) in [
            (vec![record.clone()], "no index names the record at byte 8"),
            (vec![record.clone(), named(9, 20)], "an index names byte 9"),
            (vec![record.clone(), named(8, 21)], "an index names byte 8"),
            (vec![record.clone(), named(8, 20), named(8, 20)], "names a record again"),
            (
                vec![record.clone(), (op::ATTACHMENT_INDEX, 100, 30, index(8, 20))],
                "an index names byte 8",
            ),
            (vec![record.clone(), (op::METADATA_INDEX, 100, 30, vec![1])], "malformed"),
            (
                vec![record, named(8, 20), (0x80, 50, 20, Vec::new())],
                "a record of unknown kind 0x80 at byte 50",
            ),
        ] {
            let found = misfit(&records).unwrap();
            assert!(found.contains(expected), "{found}");
        }
    }
}

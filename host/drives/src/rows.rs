//! Reads the messages of a database, in the order of their times.
//!
//! Messages are read piece by piece, and kept in memory like those of a chunk, so the merge need
//! not know the format. The time index returns one row after the other; their order is checked, so
//! that a damaged page cannot cause an endless loop.

use std::collections::HashMap;
use std::error::Error;
use std::path::{Path, PathBuf};

use rusqlite::types::ValueRef;
use rusqlite::{Connection, ErrorCode, Row, Rows as Cursor};

use crate::chunk::OpenSegment;
use crate::damage::{Damage, DamageLocation};
use crate::error::ReplayError;
use crate::options::Span;
use crate::records::MessageHead;

/// Size in bytes at which a piece ends, after the message that reaches it.
const PIECE_BYTES: usize = 1 << 20;

/// Conditions: messages of the same time after a given one, and those after a time.
pub const SAME_TIME: &str = "timestamp = ?1 AND rowid > ?2";
pub const LATER: &str = "timestamp > ?1";

/// Returns a query of messages in their order, with the content of those of the topics in `list`.
pub fn select(index: &str, list: &str, condition: &str) -> String {
    format!(
        "SELECT rowid, timestamp, topic_id, CASE WHEN topic_id IN ({list}) THEN data END \
         FROM messages INDEXED BY {index} WHERE {condition} ORDER BY timestamp, rowid"
    )
}

/// `SQLITE_IOERR_SHORT_READ`.
const SHORT_READ: i32 = 522;

pub struct MessageRows {
    path: PathBuf,
    /// `None` once everything is read: an open database keeps pages in memory.
    db: Option<Connection>,
    /// The time index of the messages, quoted.
    index: String,
    /// Channel ids by topic number of the database.
    channels: HashMap<i64, u16>,
    /// The first time, if it is valid.
    first: Result<Option<u64>, Damage>,
    /// Known damage, reported after all messages.
    known_damage: Option<Damage>,
    span: Span,
    /// The subscribed topics, sorted.
    wanted: Vec<i64>,
    /// Time and number of the row that was read last.
    after: Option<(i64, i64)>,
    /// Start time of the next piece.
    next: Option<u64>,
    broken: Option<Damage>,
    pieces: u64,
}

enum PieceEnd {
    /// There are more messages, from this time on.
    Piece(u64),
    Span,
    Table,
}

impl MessageRows {
    pub fn new(
        path: &Path,
        db: Connection,
        index: String,
        channels: HashMap<i64, u16>,
        first: Result<Option<u64>, Damage>,
    ) -> Self {
        Self {
            path: path.to_owned(),
            db: Some(db),
            index,
            channels,
            first,
            known_damage: None,
            span: Span::ALL,
            wanted: Vec::new(),
            after: None,
            next: None,
            broken: None,
            pieces: 0,
        }
    }

    pub fn path(&self) -> &Path {
        &self.path
    }

    pub fn damaged(&self, what: Damage) -> ReplayError {
        let what = match what {
            Damage::Database(error) if is_of_system(&*error) => {
                let source = std::io::Error::other(error);
                return ReplayError::Read { path: self.path.clone(), offset: 0, source };
            }
            what => what,
        };
        let at = DamageLocation::Message(self.after.map_or(0, |(_, number)| number));
        ReplayError::Damaged { path: self.path.clone(), at, what }
    }

    /// Begins with the first message of `span`. `known_damage` is the damage that is already known.
    pub fn start(
        &mut self,
        span: Span,
        known_damage: Option<Damage>,
        is_wanted: impl Fn(u16) -> bool,
    ) {
        self.wanted = self
            .channels
            .iter()
            .filter(|(_, id)| is_wanted(**id))
            .map(|(topic, _)| *topic)
            .collect();
        self.wanted.sort_unstable();
        (self.span, self.known_damage) = (span, known_damage);
        match std::mem::replace(&mut self.first, Ok(None)) {
            Ok(Some(first)) => {
                self.next = Some(first.max(span.from)).filter(|next| !span.ends_before(*next))
            }
            // No message at all, perhaps because of the damage.
            Ok(None) => self.next = self.known_damage.is_some().then_some(span.from),
            // The first time is invalid; later ones may be valid.
            Err(_) if span.from > 0 => self.next = Some(span.from),
            Err(what) => (self.broken, self.next) = (Some(what), Some(0)),
        }
    }

    pub fn next_start(&self) -> Option<u64> {
        self.next
    }

    /// Reads the next piece, and returns its number. An error is reported in a piece of its own, so
    /// that all earlier messages are delivered.
    pub fn open_next(&mut self, into: &mut OpenSegment) -> Result<u64, ReplayError> {
        into.clear();
        self.pieces += 1;
        if let Some(what) = self.broken.take() {
            self.next = None;
            return Err(self.damaged(what));
        }
        let what = match self.read(into) {
            Ok(PieceEnd::Piece(next)) => {
                self.next = Some(next);
                return Ok(self.pieces);
            }
            Ok(PieceEnd::Span) => None,
            Ok(PieceEnd::Table) => self.known_damage.take(),
            // In a truncated file, a missing page is explained by the truncation.
            Err(Damage::Database(error)) if !is_of_system(&*error) => {
                self.known_damage.take().or(Some(Damage::Database(error)))
            }
            Err(what) => Some(what),
        };
        let behind =
            self.after.map_or(self.span.from, |(at, _)| at.unsigned_abs().saturating_add(1));
        self.next = what.is_some().then_some(behind.max(self.span.from));
        self.broken = what;
        self.db = None;
        Ok(self.pieces)
    }

    fn read(&mut self, into: &mut OpenSegment) -> Result<PieceEnd, Damage> {
        let Self { db, index, channels, wanted, span, after, .. } = self;
        let Some(db) = db else { return Ok(PieceEnd::Table) };
        let list = wanted.iter().map(i64::to_string).collect::<Vec<_>>().join(",");
        // The content of other topics is not read, but their rows keep the order.
        let rows =
            |condition: &str| db.prepare(&select(index, &list, condition)).map_err(unreadable);
        let mut piece = PieceFiller { channels, wanted, span: *span, after, into };
        if let Some((at, number)) = *piece.after {
            // First the remaining messages of the same time.
            let mut same_time = rows(SAME_TIME)?;
            if let Some(end) = piece.fill(same_time.query((at, number)).map_err(unreadable)?)? {
                return Ok(end);
            }
        }
        // Times may not be numbers: all later rows are checked.
        let behind = match *piece.after {
            Some((at, _)) => at,
            None => i64::try_from(span.from).unwrap_or(i64::MAX) - 1,
        };
        let mut later = rows(LATER)?;
        Ok(piece.fill(later.query([behind]).map_err(unreadable)?)?.unwrap_or(PieceEnd::Table))
    }
}

/// Returns whether the system failed, and not the database.
pub fn is_of_system(error: &(dyn Error + 'static)) -> bool {
    let Some(error) = error.downcast_ref::<rusqlite::Error>() else { return false };
    // A file that is too short is not a failure of the system.
    let is_short = error.sqlite_error().is_some_and(|error| error.extended_code == SHORT_READ);
    let codes = [
        ErrorCode::SystemIoFailure,
        ErrorCode::OutOfMemory,
        ErrorCode::CannotOpen,
        ErrorCode::PermissionDenied,
    ];
    !is_short && error.sqlite_error_code().is_some_and(|code| codes.contains(&code))
}

pub fn unreadable(error: rusqlite::Error) -> Damage {
    Damage::Database(error.into())
}

struct PieceFiller<'a> {
    channels: &'a HashMap<i64, u16>,
    wanted: &'a [i64],
    span: Span,
    after: &'a mut Option<(i64, i64)>,
    into: &'a mut OpenSegment,
}

impl PieceFiller<'_> {
    /// Takes `rows` until the piece is full; `None` if it is not full.
    fn fill(&mut self, mut rows: Cursor<'_>) -> Result<Option<PieceEnd>, Damage> {
        while let Some(row) = rows.next().map_err(unreadable)? {
            let (number, at) =
                (row.get(0).map_err(unreadable)?, time(row.get_ref(1).map_err(unreadable)?)?);
            // `time` returns no value below 0.
            let log_time = at.unsigned_abs();
            if self.after.is_some_and(|after| after >= (at, number)) {
                return Err(Damage::Malformed("its time index is not in order"));
            }
            if self.span.ends_before(log_time) {
                return Ok(Some(PieceEnd::Span));
            }
            if self.into.len() >= PIECE_BYTES {
                return Ok(Some(PieceEnd::Piece(log_time)));
            }
            self.take(row, log_time)?;
            *self.after = Some((at, number));
        }
        Ok(None)
    }

    fn take(&mut self, row: &Row<'_>, log_time: u64) -> Result<(), Damage> {
        let ValueRef::Integer(topic) = row.get_ref(2).map_err(unreadable)? else {
            return Err(Damage::Malformed("a message has a topic that is not a number"));
        };
        let channel = *self.channels.get(&topic).ok_or(Damage::UnknownTopic(topic))?;
        match row.get_ref(3).map_err(unreadable)? {
            ValueRef::Blob(data) => {
                // rosbag2 stores no sequence numbers in databases, and only one time.
                let head = MessageHead { channel, sequence: 0, log_time, publish_time: log_time };
                self.into.push(&head, data);
                Ok(())
            }
            ValueRef::Null if self.wanted.binary_search(&topic).is_err() => Ok(()),
            _ => Err(Damage::Malformed("a message is not a blob")),
        }
    }
}

/// Returns the time of a message, in ns.
pub fn time(value: ValueRef<'_>) -> Result<i64, Damage> {
    match value {
        ValueRef::Integer(at) if at >= 0 => Ok(at),
        ValueRef::Integer(_) => Err(Damage::Malformed("a message is from before 1970")),
        _ => Err(Damage::Malformed("a message has a time that is not an integer")),
    }
}

#[cfg(test)]
mod tests {
    use rusqlite::ffi;

    use super::*;

    #[test]
    fn a_disk_failure_is_not_damage_of_the_drive() {
        for (code, is_damage) in [
            (ffi::SQLITE_IOERR, false),
            (ffi::SQLITE_IOERR_READ, false),
            (ffi::SQLITE_NOMEM, false),
            (ffi::SQLITE_CANTOPEN, false),
            (SHORT_READ, true),
            (ffi::SQLITE_CORRUPT, true),
            (ffi::SQLITE_NOTADB, true),
        ] {
            let db = Connection::open_in_memory().unwrap();
            let path = Path::new("drive.db3");
            let rows = MessageRows::new(path, db, String::new(), HashMap::new(), Ok(None));
            let what = unreadable(rusqlite::Error::SqliteFailure(ffi::Error::new(code), None));
            match rows.damaged(what) {
                ReplayError::Damaged { .. } => assert!(is_damage, "{code}"),
                ReplayError::Read { .. } => assert!(!is_damage, "{code}"),
                other => panic!("{code}: {other}"),
            }
        }
    }
}

//! Opens databases of rosbag2 for reading, without trusting them.
//!
//! A database contains its own schema, and a schema can contain views, triggers and computed
//! columns. None of that runs here: the three tables that are read must be plain tables, and their
//! columns plain columns. Nothing is written, not even beside the database.
//!
//! Source: `rosbag2_storage_sqlite3`, schema versions 1 to 4.

use std::collections::{BTreeMap, HashMap};
use std::error::Error;
use std::io::{self, Read};
use std::ops::RangeInclusive;
use std::os::unix::ffi::OsStrExt;
use std::path::Path;
use std::sync::Arc;

use rusqlite::config::DbConfig;
use rusqlite::limits::Limit;
use rusqlite::{Connection, OpenFlags, OptionalExtension};
use tracing::warn;

use crate::bag::journals_of;
use crate::damage::Damage;
use crate::error::ReplayError;
use crate::file::{ChannelInfo, Channels, Contents, offered_qos};
use crate::options::DriveLimits;
use crate::rows::{LATER, MessageRows, SAME_TIME, is_of_system, select, time, unreadable};

type BoxedError = Box<dyn Error + Send + Sync>;

/// The supported schemas of `rosbag2_storage_sqlite3`.
const VERSIONS: RangeInclusive<i64> = 1..=4;

/// SQLite counts the length of a row in 31 bits.
const LARGEST_ROW: u64 = 1 << 30;
/// Own statements list at most 65536 topics; those of a schema have no reason to be longer.
const LONGEST_SQL: i32 = 4 << 20;

/// Column with RIHS01 of a type, since ROS 2 Iron.
const HASH: &str = "type_description_hash";

/// Approximate size of a row, without its texts. A damaged or malicious table may have any number
/// of rows.
const ROW_BYTES: usize = 128;

#[derive(Copy, Clone)]
pub struct DatabaseFile<'a> {
    shown: &'a Path,
    real: &'a Path,
    /// Set if there may be a journal beside it.
    may_be_open: bool,
}

impl<'a> DatabaseFile<'a> {
    pub fn beside_its_journal(path: &'a Path) -> Self {
        Self { shown: path, real: path, may_be_open: true }
    }

    /// Describes the content of `shown`, which was copied to `real`.
    pub fn elsewhere(shown: &'a Path, real: &'a Path) -> Self {
        Self { shown, real, may_be_open: false }
    }
}

pub fn open(
    file: DatabaseFile<'_>,
    len: u64,
    limits: DriveLimits,
) -> Result<(MessageRows, Contents), ReplayError> {
    if file.may_be_open {
        is_closed(file.real)?;
    }
    let path = file.shown.to_owned();
    let refused = |source: BoxedError| {
        if is_of_system(&*source) {
            return ReplayError::Open { path: path.clone(), source: io::Error::other(source) };
        }
        ReplayError::Database { path: path.clone(), source }
    };
    let expected = claimed_len(file.real)
        .map_err(|source| ReplayError::Open { path: path.clone(), source })?;
    let is_cut_off = expected > len;
    let db = connect(file.real, limits, is_cut_off).map_err(|error| refused(error.into()))?;
    is_known_version(&db).map_err(refused)?;
    let known = topics(&db).map_err(refused)?;
    let Some(index) = index_of_times(&db).map_err(|error| refused(error.into()))? else {
        return Err(ReplayError::NoTimes { path });
    };
    in_order(&db, &index).map_err(refused)?;
    let first = edge(&db, &index, "ASC");
    // A truncated file has lost its newest messages.
    let last = edge(&db, &index, "DESC").ok().flatten();
    let mut contents =
        Contents { channels: known.channels, uncounted: true, ..Contents::default() };
    let known_first = first.as_ref().ok().copied().flatten();
    contents.times = known_first.map(|first| (first, last.unwrap_or(first).max(first)));
    if is_cut_off {
        warn!(
            path = %path.display(),
            expected,
            found = len,
            "database was truncated; its newest messages are lost"
        );
        contents.is_end_unknown = last.is_none();
        contents.damage = Some((len, Damage::DatabaseTruncated { expected, found: len }));
    }
    Ok((MessageRows::new(file.shown, db, index, known.ids, first), contents))
}

/// Refuses a database whose newest messages are still in its journal.
fn is_closed(path: &Path) -> Result<(), ReplayError> {
    for beside in journals_of(path) {
        match holds_something(&beside) {
            Ok(false) => {}
            Ok(true) => return Err(ReplayError::NotClosed { path: path.to_owned(), beside }),
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            // It is unknown whether it contains messages.
            Err(source) => return Err(ReplayError::Open { path: beside, source }),
        }
    }
    Ok(())
}

/// Returns whether the journal `path` is still in use: then it is not empty and does not begin with
/// zeros.
fn holds_something(path: &Path) -> io::Result<bool> {
    let found = path.metadata()?;
    if !found.is_file() {
        // Not opened: a pipe would block for ever.
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "it is not a regular file"));
    }
    let mut start = [0; 1];
    Ok(found.len() > 0 && std::fs::File::open(path)?.read(&mut start)? > 0 && start != [0])
}

/// Returns the length that the header claims, in bytes; 0 if it claims none. Source: the database
/// file format, section 1.3.
fn claimed_len(path: &Path) -> std::io::Result<u64> {
    let mut header = Vec::new();
    std::fs::File::open(path)?.take(100).read_to_end(&mut header)?;
    let u32_at = |at: usize| {
        header.get(at..).and_then(<[u8]>::first_chunk).map_or(0, |bytes| u32::from_be_bytes(*bytes))
    };
    let page = match header.get(16..18) {
        Some([0, 1]) => 65_536,
        Some(&[high, low]) => u64::from(u16::from_be_bytes([high, low])),
        _ => 0,
    };
    // Old writers do not maintain the number of pages.
    let is_kept = u32_at(24) == u32_at(92);
    Ok(if is_kept { page * u64::from(u32_at(28)) } else { 0 })
}

fn connect(path: &Path, limits: DriveLimits, is_cut_off: bool) -> rusqlite::Result<Connection> {
    let mut uri = "file:".to_owned();
    for byte in path.as_os_str().as_bytes() {
        match byte {
            b'/' | b'.' | b'-' | b'_' | b'0'..=b'9' | b'A'..=b'Z' | b'a'..=b'z' => {
                uri.push(char::from(*byte))
            }
            _ => uri += &format!("%{byte:02X}"),
        }
    }
    // No other process writes to it, so no lock is taken, and no file is created beside it.
    uri += "?immutable=1";
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY
        | OpenFlags::SQLITE_OPEN_URI
        | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let db = Connection::open_with_flags(uri, flags)?;
    for (limit, value) in [
        (Limit::SQLITE_LIMIT_LENGTH, limits.chunk_bytes.min(LARGEST_ROW) as i32),
        (Limit::SQLITE_LIMIT_SQL_LENGTH, LONGEST_SQL),
        (Limit::SQLITE_LIMIT_ATTACHED, 0),
        (Limit::SQLITE_LIMIT_WORKER_THREADS, 0),
        (Limit::SQLITE_LIMIT_TRIGGER_DEPTH, 1),
    ] {
        db.set_limit(limit, value)?;
    }
    for (config, wanted) in [
        (DbConfig::SQLITE_DBCONFIG_TRUSTED_SCHEMA, false),
        (DbConfig::SQLITE_DBCONFIG_ENABLE_TRIGGER, false),
        (DbConfig::SQLITE_DBCONFIG_ENABLE_VIEW, false),
        (DbConfig::SQLITE_DBCONFIG_DQS_DML, false),
        (DbConfig::SQLITE_DBCONFIG_DQS_DDL, false),
        // Otherwise nothing of a truncated file can be read. Nothing can be written anyway.
        (DbConfig::SQLITE_DBCONFIG_WRITABLE_SCHEMA, is_cut_off),
        (DbConfig::SQLITE_DBCONFIG_DEFENSIVE, !is_cut_off),
    ] {
        db.set_db_config(config, wanted)?;
    }
    // Pages are read once, in order; a drive may have hundreds of databases, each with a cache (in
    // KiB).
    db.execute_batch(
        "PRAGMA cell_size_check = ON; PRAGMA temp_store = MEMORY; \
         PRAGMA mmap_size = 0; PRAGMA cache_size = -512;",
    )?;
    Ok(db)
}

/// Refuses a database of a later rosbag2, whose changes are unknown. Version 1 has no number.
fn is_known_version(db: &Connection) -> Result<(), BoxedError> {
    if kind(db, "schema")?.is_none() {
        return Ok(());
    }
    table(db, "schema", &["schema_version"])?;
    let version: Option<i64> =
        db.query_row("SELECT max(schema_version) FROM schema NOT INDEXED", [], |row| row.get(0))?;
    match version.filter(|version| !VERSIONS.contains(version)) {
        None => Ok(()),
        Some(version) => {
            let (first, last) = (VERSIONS.start(), VERSIONS.end());
            Err(format!(
                "its schema has version {version}; only versions {first} to {last} can be read"
            )
            .into())
        }
    }
}

struct DatabaseTopics {
    channels: Channels,
    /// Channel ids by topic number of the database.
    ids: HashMap<i64, u16>,
}

fn topics(db: &Connection) -> Result<DatabaseTopics, BoxedError> {
    table(db, "messages", &["topic_id", "timestamp", "data"])?;
    let columns = table(db, "topics", &["id", "name", "type", "serialization_format"])?;
    let optional = |name| if columns.iter().any(|column| column == name) { name } else { "NULL" };
    let (qos, hash) = (optional("offered_qos_profiles"), optional(HASH));
    let texts = definitions(db)?;
    let sql = format!(
        "SELECT id, name, type, serialization_format, {qos}, {hash} FROM topics NOT INDEXED"
    );
    let mut statement = db.prepare(&sql)?;
    let mut rows = statement.query([])?;
    let (mut found, mut room) = (BTreeMap::<i64, ChannelInfo>::new(), Channels::default());
    while let Some(row) = rows.next()? {
        if found.len() > usize::from(u16::MAX) {
            return Err("it has more than 65536 topics".into());
        }
        let (number, topic, type_name): (_, String, String) =
            (row.get(0)?, row.get(1)?, row.get(2)?);
        let hash = row.get::<_, Option<String>>(5)?.unwrap_or_default();
        let texts = texts.get(&type_name).map_or(&[][..], Vec::as_slice);
        let (text, unknown_layout) = match text_with(texts, &hash) {
            Ok(text) => (text, None),
            Err(why) => (None, Some(why)),
        };
        let info = ChannelInfo {
            offered_qos: offered_qos(&topic, row.get::<_, Option<String>>(4)?.as_deref()),
            topic,
            message_encoding: row.get(3)?,
            schema_encoding: text.map(|found| found.encoding.clone()).unwrap_or_default(),
            definitions_text: text.map(|found| found.text.clone()),
            type_name,
            writer: None,
            is_latched: false,
            type_hash: Some(hash).filter(|hash| !hash.is_empty()),
            unknown_layout,
        };
        room.make_room(ROW_BYTES + info.bytes())?;
        if found.insert(number, info).is_some() {
            return Err(format!("two of its topics have the number {number}").into());
        }
    }
    let mut known = DatabaseTopics { channels: Channels::default(), ids: HashMap::new() };
    for (id, (number, info)) in (0..=u16::MAX).zip(found) {
        known.ids.insert(number, id);
        known.channels.add(id, info)?;
    }
    Ok(known)
}

struct DatabaseDefinition {
    encoding: String,
    text: Arc<str>,
    /// RIHS01 of the type; empty if the writer did not know it.
    hash: String,
}

/// Returns the definition for a topic that states `hash`, or an empty one.
fn text_with<'a>(
    texts: &'a [DatabaseDefinition],
    hash: &str,
) -> Result<Option<&'a DatabaseDefinition>, &'static str> {
    let stated = texts.iter().find(|found| !hash.is_empty() && found.hash == hash);
    let Some((first, rest)) = texts.split_first().filter(|_| stated.is_none()) else {
        return Ok(stated);
    };
    if !hash.is_empty() && texts.iter().all(|found| !found.hash.is_empty()) {
        return Err("its database has definitions of its type, but none with the hash it states");
    }
    match rest.iter().all(|other| other.text == first.text) {
        true => Ok(Some(first)),
        false => Err("its database has several definitions of its type, and it states no hash"),
    }
}

/// Reads the message definitions by type. Databases from before ROS 2 Iron have none.
fn definitions(db: &Connection) -> Result<HashMap<String, Vec<DatabaseDefinition>>, BoxedError> {
    let name = "message_definitions";
    if kind(db, name)?.is_none() {
        return Ok(HashMap::new());
    }
    let columns = table(db, name, &["topic_type", "encoding", "encoded_message_definition"])?;
    let hash = if columns.iter().any(|column| column == HASH) { HASH } else { "NULL" };
    let mut statement = db.prepare(&format!(
        "SELECT topic_type, encoding, encoded_message_definition, {hash} FROM \
         message_definitions NOT INDEXED"
    ))?;
    let mut rows = statement.query([])?;
    let mut texts: HashMap<_, Vec<_>> = HashMap::new();
    let mut room = Channels::default();
    while let Some(row) = rows.next()? {
        let (type_name, encoding, text): (String, String, String) =
            (row.get(0)?, row.get(1)?, row.get(2)?);
        let hash = row.get::<_, Option<String>>(3)?.unwrap_or_default();
        let bytes = type_name.len() + encoding.len() + text.len() + hash.len();
        room.make_room(ROW_BYTES + bytes)?;
        let text: Arc<str> = text.trim().into();
        if !text.is_empty() {
            texts.entry(type_name).or_default().push(DatabaseDefinition { encoding, text, hash });
        }
    }
    Ok(texts)
}

/// Returns what `name` in the schema is according to SQLite: the text of a schema can be written in
/// many ways.
fn kind(db: &Connection, name: &str) -> rusqlite::Result<Option<String>> {
    let sql =
        "SELECT type FROM pragma_table_list WHERE schema = 'main' AND name = ?1 COLLATE NOCASE";
    db.query_row(sql, [name], |row| row.get(0)).optional()
}

/// Returns the columns of the table `name`, which must contain `wanted`.
fn table(db: &Connection, name: &str, wanted: &[&str]) -> Result<Vec<String>, BoxedError> {
    match kind(db, name)?.as_deref() {
        Some("table") => {}
        Some(_) => return Err(format!("its `{name}` is not a plain table").into()),
        None => {
            let why = format!("it has no table `{name}`, so it is not a database of rosbag2");
            return Err(why.into());
        }
    }
    // Computed columns are hidden ones.
    let mut statement = db.prepare("SELECT name, hidden FROM pragma_table_xinfo(?1)")?;
    let all: Vec<(String, i64)> = statement
        .query_map([name], |row| Ok((row.get(0)?, row.get(1)?)))?
        .collect::<Result<_, _>>()?;
    if all.iter().any(|(column, _)| column.eq_ignore_ascii_case("rowid")) {
        return Err(format!(
            "its table `{name}` has a column `rowid`, which is SQLite's own name for row numbers"
        )
        .into());
    }
    let columns: Vec<_> =
        all.into_iter().filter(|(_, hidden)| *hidden == 0).map(|(column, _)| column).collect();
    match wanted.iter().find(|wanted| !columns.iter().any(|column| column == *wanted)) {
        None => Ok(columns),
        Some(column) => Err(format!("its table `{name}` has no column `{column}`").into()),
    }
}

/// Returns an index that orders all messages by time, quoted for SQL.
fn index_of_times(db: &Connection) -> rusqlite::Result<Option<String>> {
    let mut statement =
        db.prepare("SELECT name FROM pragma_index_list('messages') WHERE partial = 0")?;
    let names: Vec<String> =
        statement.query_map([], |row| row.get(0))?.collect::<Result<_, _>>()?;
    let mut columns = db.prepare("SELECT name, desc FROM pragma_index_xinfo(?1) ORDER BY seqno")?;
    for name in names {
        let found: Vec<(Option<String>, i64)> = columns
            .query_map([&name], |row| Ok((row.get(0)?, row.get(1)?)))?
            .collect::<Result<_, _>>()?;
        // The second column is the row number.
        if let [(Some(column), 0), (None, 0)] = found.as_slice()
            && column == "timestamp"
        {
            return Ok(Some(format!("\"{}\"", name.replace('"', "\"\""))));
        }
    }
    Ok(None)
}

/// Refuses a database whose index does not order the messages by time, such as one with another
/// collation: SQLite would read and sort all messages in memory for each piece.
fn in_order(db: &Connection, index: &str) -> Result<(), BoxedError> {
    let pieces = [SAME_TIME, LATER].map(|condition| (select(index, "0", condition), false));
    let edges = ["ASC", "DESC"].map(|order| (edge_sql(index, order), true));
    for (sql, may_scan) in pieces.into_iter().chain(edges) {
        let mut statement = db.prepare(&format!("EXPLAIN QUERY PLAN {sql}"))?;
        // A plan needs no values, and is the same for all.
        let mut steps = statement.raw_query();
        while let Some(step) = steps.next()? {
            let step: String = step.get("detail")?;
            if step.contains("TEMP B-TREE") || step.starts_with("SCAN") && !may_scan {
                return Err(
                    format!("its messages cannot be read in order by the index {index}").into()
                );
            }
        }
    }
    Ok(())
}

fn edge_sql(index: &str, order: &str) -> String {
    format!("SELECT timestamp FROM messages INDEXED BY {index} ORDER BY timestamp {order} LIMIT 1")
}

/// Returns the first or the last time; `None` if there are no messages.
fn edge(db: &Connection, index: &str, order: &str) -> Result<Option<u64>, Damage> {
    let mut statement = db.prepare(&edge_sql(index, order)).map_err(unreadable)?;
    let mut rows = statement.query([]).map_err(unreadable)?;
    let Some(row) = rows.next().map_err(unreadable)? else {
        return Ok(None);
    };
    time(row.get_ref(0).map_err(unreadable)?).map(|at| Some(at.unsigned_abs()))
}

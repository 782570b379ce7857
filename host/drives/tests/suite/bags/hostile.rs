//! Tests databases that are malicious, damaged, or too large.

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use gleaner_drives::{Damage, DamageLocation, DriveLimits, Replay, ReplayError};
use gleaner_messages::transport::Transport;
use rusqlite::Connection;

use super::bag::{TABLES, add_message, add_topic, cdr, empty_database, folder, new_database};
use crate::support::{MemorySink, TOPICS, TYPE, begun, expected, file, listen, run, spec, ticking};

pub fn damage(error: Option<ReplayError>) -> (DamageLocation, Damage) {
    match error {
        Some(ReplayError::Damaged { at, what, .. }) => (at, what),
        other => panic!("expected damage, got {other:?}"),
    }
}

pub fn refused(path: &Path) -> ReplayError {
    Replay::open(&[path.to_owned()]).err().expect("an error")
}

/// Returns the error of the database that a replay of `path` is refused with.
#[track_caller]
fn refusal(path: &Path) -> String {
    match refused(path) {
        ReplayError::Database { source, .. } => source.to_string(),
        other => panic!("{other}"),
    }
}

/// Returns the messages that a database of one topic delivers, and the error at its end.
fn replayed(path: &Path) -> (Vec<(i64, i64)>, Option<ReplayError>) {
    let (mut replay, memory) = begun(&[path.to_owned()], &["/a"]);
    let (_, error) = run(&mut replay);
    (memory.values(), error)
}

/// Creates a database with five messages, then changes it by `sql`.
fn changed(sql: &str) -> (tempfile::TempDir, PathBuf) {
    let (folder, path) = new_database(&ticking(&["/a"], 5, 10));
    Connection::open(&path).unwrap().execute_batch(sql).unwrap();
    (folder, path)
}

#[test]
fn a_database_truncated_anywhere_delivers_its_readable_part_and_an_error() {
    let messages = ticking(&TOPICS, 6000, 1000);
    let (_folder, path) = new_database(&messages);
    let bytes = fs::read(&path).unwrap();
    let (mut most, mut opened) = (0, 0);
    for part in 1..40 {
        let cut = bytes.len() * part / 40;
        fs::write(&path, &bytes[..cut]).unwrap();
        let mut replay = match Replay::open(std::slice::from_ref(&path)) {
            Ok(replay) => replay,
            // The pages with its tables are missing.
            Err(ReplayError::Database { .. }) => continue,
            Err(error) => panic!("cut at {cut}: {error}"),
        };
        opened += 1;
        let memory = listen(&mut replay, &TOPICS);
        let (_, error) = run(&mut replay);
        let all = memory.values();
        assert_eq!(all, expected(&messages)[..all.len()], "cut at {cut}");
        most = most.max(all.len());
        damage(error);
    }
    assert!(opened > 30 && most > 4000, "{opened} opened, {most} messages");
}

#[test]
fn flipped_bytes_in_a_database_cause_only_damage_or_other_messages() {
    let messages = ticking(&TOPICS, 800, 1000);
    let (_folder, path) = new_database(&messages);
    let bytes = fs::read(&path).unwrap();
    let mut damaged = 0;
    for step in 0..400 {
        let mut bytes = bytes.clone();
        // A prime, so that every part of a page is hit.
        let at = step * 7919 % bytes.len();
        bytes[at] ^= 0xff;
        fs::write(&path, &bytes).unwrap();
        let Ok(mut replay) = Replay::open(std::slice::from_ref(&path)) else {
            damaged += 1;
            continue;
        };
        let memory = Arc::new(MemorySink::default());
        TOPICS.iter().for_each(|topic| drop(replay.subscribe(&spec(topic), memory.clone())));
        let (steps, error) = run(&mut replay);
        assert!(steps.len() <= 800, "byte {at}: {} messages", steps.len());
        assert!(steps.is_sorted_by_key(|step| step.at_ns), "byte {at}");
        damaged += usize::from(error.is_some());
    }
    assert!(damaged > 5, "{damaged}");
}

#[test]
fn messages_that_are_not_cdr_are_left_out_and_those_that_are_no_blob_end_the_drive() {
    for value in ["x''", "x'00'", "x'000100'", "x'0700000001020304'"] {
        let (_folder, path) = changed(&format!("UPDATE messages SET data = {value} WHERE id = 4;"));
        let (all, error) = replayed(&path);
        assert!(error.is_none() && all.len() == 4, "{value}: {error:?}");
    }
    for (value, expected) in
        [("'text'", "not a blob"), ("17", "not a blob"), ("x'28b52ffd'", "cannot be unpacked")]
    {
        let (_folder, path) = changed(&format!("UPDATE messages SET data = {value} WHERE id = 4;"));
        let (all, error) = replayed(&path);
        assert_eq!(all.len(), 3, "{value}");
        let what = damage(error).1.to_string();
        assert!(what.contains(expected), "{value}: {what}");
    }
}

#[test]
fn a_message_without_bytes_is_damage_and_not_skipped() {
    let folder = folder();
    let path = folder.path().join("drive.db3");
    let db = Connection::open(&path).unwrap();
    let tables = TABLES.replace("data BLOB NOT NULL", "data BLOB");
    db.execute_batch(&tables).unwrap();
    let topic = add_topic(&db, "/a", TYPE);
    db.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?1, 5, NULL)", [topic])
        .unwrap();
    drop(db);
    let what = damage(replayed(&path).1).1.to_string();
    assert!(what.contains("not a blob"), "{what}");
}

#[test]
fn invalid_times_are_damage() {
    for (time, left, at, expected) in [
        ("-5", 0, DamageLocation::Message(0), "is from before 1970"),
        ("NULL", 0, DamageLocation::Message(0), "not an integer"),
        ("'soon'", 4, DamageLocation::Message(5), "not an integer"),
        ("1e300", 4, DamageLocation::Message(5), "not an integer"),
    ] {
        let folder = folder();
        let path = folder.path().join("drive.db3");
        let db = Connection::open(&path).unwrap();
        let tables = TABLES.replace("timestamp INTEGER NOT NULL", "timestamp INTEGER");
        db.execute_batch(&tables).unwrap();
        let topic = add_topic(&db, "/a", TYPE);
        ticking(&["/a"], 5, 10)
            .iter()
            .for_each(|message| add_message(&db, topic, message.at as i64, &cdr(message)));
        db.execute_batch(&format!("UPDATE messages SET timestamp = {time} WHERE id = 3")).unwrap();
        drop(db);
        let (all, error) = replayed(&path);
        let (location, what) = damage(error);
        assert_eq!((all.len(), location), (left, at), "{time}");
        assert!(what.to_string().contains(expected), "{time}: {what}");
    }
}

#[test]
fn a_message_of_an_undefined_topic_is_damage() {
    let (_folder, path) = changed("UPDATE messages SET topic_id = 77 WHERE id = 3;");
    let (all, error) = replayed(&path);
    assert_eq!(all.len(), 2);
    let (location, what) = damage(error);
    assert_eq!(location, DamageLocation::Message(2));
    assert!(matches!(what, Damage::UnknownTopic(77)));
}

#[test]
fn views_virtual_tables_and_computed_columns_are_refused() {
    let recursion = "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x FROM n) SELECT x AS id, \
                     1 AS topic_id, x AS timestamp, \
                     zeroblob(1000000000) AS data FROM n";
    for (sql, expected) in [
        (format!("DROP TABLE messages; CREATE VIEW messages AS {recursion};"), "not a plain table"),
        (
            "DROP TABLE topics; CREATE VIRTUAL TABLE topics USING fts5(id, name, type, \
             serialization_format);"
                .to_owned(),
            "not a plain table",
        ),
        (
            // As a program writes it to hide it.
            "CREATE VIRTUAL TABLE other USING fts5(id, name, type, serialization_format); DROP \
             TABLE topics; \
             PRAGMA writable_schema = ON; UPDATE sqlite_schema SET name = 'topics', tbl_name = \
             'topics', \
             sql = 'CREATE /**/  VIRTUAL TABLE topics USING fts5(id, name, type, \
             serialization_format)' WHERE name = 'other';"
                .to_owned(),
            "not a plain table",
        ),
        (
            "DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, \
             timestamp INTEGER, \
             data BLOB AS (zeroblob(1000000000)));"
                .to_owned(),
            "no column `data`",
        ),
        ("DROP TABLE messages;".to_owned(), "no table `messages`"),
        ("ALTER TABLE topics DROP COLUMN type;".to_owned(), "no column `type`"),
    ] {
        let (_folder, path) = changed(&sql);
        let error = refusal(&path);
        assert!(error.contains(expected), "{sql}: {error}");
    }
}

#[test]
fn the_error_for_a_missing_time_index_has_the_command_that_creates_it() {
    for sql in [
        "DROP INDEX timestamp_idx;",
        "DROP INDEX timestamp_idx; CREATE INDEX timestamp_idx ON messages (timestamp) WHERE \
         topic_id = 1;",
        "DROP INDEX timestamp_idx; CREATE INDEX timestamp_idx ON messages (timestamp + 0);",
        "DROP INDEX timestamp_idx; CREATE INDEX timestamp_idx ON messages (timestamp DESC);",
    ] {
        let (_folder, path) = changed(sql);
        let error = refused(&path);
        assert!(matches!(error, ReplayError::NoTimes { .. }), "{sql}: {error}");
        assert!(error.help().unwrap().contains("CREATE INDEX timestamp_idx"));
    }
    // The name of the index does not matter.
    let (_folder, path) =
        changed("DROP INDEX timestamp_idx; CREATE INDEX \"a \"\" b\" ON messages (timestamp);");
    assert_eq!(replayed(&path).0.len(), 5);
}

#[test]
fn an_index_that_sqlite_would_have_to_sort_in_memory_is_refused() {
    let table = "DROP TABLE messages; CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id \
                 INTEGER, timestamp INTEGER";
    for (columns, index, expected) in [
        ("COLLATE NOCASE, data BLOB", "timestamp COLLATE BINARY", "cannot be read in order"),
        (", data BLOB, RowID INTEGER", "timestamp", "has a column `rowid`"),
        (", data BLOB, rowid INTEGER AS (1)", "timestamp", "has a column `rowid`"),
    ] {
        let (_folder, path) =
            changed(&format!("{table} {columns}); CREATE INDEX at ON messages ({index});"));
        let error = refusal(&path);
        assert!(error.contains(expected), "{columns}: {error}");
    }
}

#[test]
fn a_schema_of_an_unknown_version_is_refused() {
    let schema =
        "CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);";
    for version in [0, 5, 99, -1] {
        let (_folder, path) =
            changed(&format!("{schema} INSERT INTO schema VALUES ({version}, 'x');"));
        let expected =
            format!("its schema has version {version}; only versions 1 to 4 can be read");
        assert_eq!(refusal(&path), expected);
    }
    for rows in ["", "INSERT INTO schema VALUES (1, 'x');", "INSERT INTO schema VALUES (4, 'x');"] {
        let (_folder, path) = changed(&format!("{schema} {rows}"));
        assert_eq!(replayed(&path).0.len(), 5, "{rows}");
    }
}

#[test]
fn two_topics_with_the_same_number_are_refused() {
    let (_folder, path) = changed(
        "DROP TABLE topics; CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, \
         serialization_format TEXT);
         INSERT INTO topics VALUES (1, '/a', 'test_msgs/msg/Number', 'cdr'), (1, '/b', \
         'test_msgs/msg/Number', 'cdr');",
    );
    let error = refusal(&path);
    assert!(error.contains("two of its topics have the number 1"), "{error}");
}

#[test]
fn too_many_definitions_are_refused_even_if_they_are_short() {
    let (_folder, path) = changed(
        "WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n LIMIT 600000)
         INSERT INTO message_definitions (topic_type, encoding, encoded_message_definition, \
         type_description_hash)
         SELECT '', '', '', '' FROM n;",
    );
    let error = refusal(&path);
    assert!(error.contains("more than 64 MiB"), "{error}");
}

#[test]
fn an_index_with_missing_or_unordered_messages_is_damage() {
    // The index has another order than the table: its result must be in order.
    let (_folder, path) = changed(
        "PRAGMA writable_schema = ON;
         CREATE INDEX other ON messages (id);
         UPDATE sqlite_schema SET rootpage = (SELECT rootpage FROM sqlite_schema WHERE name = \
         'messages') WHERE name = 'timestamp_idx';",
    );
    match Replay::open(std::slice::from_ref(&path)) {
        Err(ReplayError::Database { .. }) => {}
        Err(error) => panic!("{error}"),
        Ok(mut replay) => {
            listen(&mut replay, &["/a"]);
            damage(run(&mut replay).1);
        }
    }
}

#[test]
fn the_error_for_a_database_that_was_not_closed_has_the_way_out() {
    let folder = folder();
    let path = folder.path().join("drive.db3");
    let db = empty_database(&path);
    db.query_row("PRAGMA journal_mode = WAL", [], |_| Ok(())).unwrap();
    let topic = add_topic(&db, "/a", TYPE);
    add_message(&db, topic, 5, &cdr(&ticking(&["/a"], 1, 5)[0]));
    let error = refused(&path);
    assert!(matches!(error, ReplayError::NotClosed { .. }), "{error}");
    assert!(error.help().unwrap().contains("wal_checkpoint"));
    // Its writer closes it, and removes the journal.
    drop(db);
    let (all, error) = replayed(&path);
    assert!(error.is_none(), "{error:?}");
    assert_eq!(all, [(5, 0)]);
}

#[test]
fn a_journal_that_cannot_be_read_is_an_error() {
    let (folder, path) = new_database(&ticking(&["/a"], 5, 10));
    for suffix in ["-wal", "-journal"] {
        let beside = folder.path().join(format!("drive.db3{suffix}"));
        fs::create_dir(&beside).unwrap();
        let error = refused(&path);
        assert!(matches!(error, ReplayError::Open { path, .. } if path == beside), "{suffix}");
        fs::remove_dir(&beside).unwrap();
        // Content of a journal that SQLite has finished.
        fs::write(&beside, [0; 512]).unwrap();
        assert_eq!(replayed(&path).0.len(), 5);
    }
}

#[test]
fn a_pipe_is_refused_without_blocking() {
    let (folder, path) = new_database(&ticking(&["/a"], 5, 10));
    let pipe = |name: &str| {
        let made =
            std::process::Command::new("mkfifo").arg(folder.path().join(name)).status().unwrap();
        assert!(made.success());
    };
    pipe("drive.db3-wal");
    assert!(matches!(refused(&path), ReplayError::Open { .. }));
    pipe("metadata.yaml");
    assert!(matches!(refused(folder.path()), ReplayError::Metadata { .. }));
    pipe("pipe.db3");
    assert!(matches!(refused(&folder.path().join("pipe.db3")), ReplayError::Open { .. }));
}

#[test]
fn a_file_that_only_begins_like_a_database_is_refused() {
    let start = b"SQLite format 3\0";
    for rest in [&b""[..], &[0; 84], &[0xff; 5000]] {
        let path = file(&[&start[..], rest].concat());
        assert!(matches!(refused(&path), ReplayError::Database { .. }), "{} bytes", rest.len());
    }
}

#[test]
fn a_message_of_a_database_beyond_the_limit_is_damage() {
    let folder = folder();
    let path = folder.path().join("drive.db3");
    let db = empty_database(&path);
    let topic = add_topic(&db, "/a", TYPE);
    add_message(&db, topic, 5, &cdr(&ticking(&["/a"], 1, 5)[0]));
    add_message(&db, topic, 6, &[&[0, 1, 0, 0][..], &vec![0; 2 << 20]].concat());
    drop(db);
    let limits = DriveLimits { chunk_bytes: 1 << 20, ..DriveLimits::default() };
    let mut replay = Replay::open_with(&[path], limits).unwrap();
    listen(&mut replay, &["/a"]);
    let (steps, error) = run(&mut replay);
    assert_eq!(steps.len(), 1);
    assert!(matches!(damage(error).1, Damage::Database(_)));
}

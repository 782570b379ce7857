//! Writes drives as rosbag2 does.

use std::collections::{BTreeMap, HashMap};
use std::fs;
use std::path::{Path, PathBuf};

use gleaner_drives::DriveOptions;
use rusqlite::Connection;
use tempfile::TempDir;

use crate::support::{TEXT, TYPE, Written, add_channel, begin, finish, write_data};

/// The tables of rosbag2 since ROS 2 Iron.
pub const TABLES: &str = "\
    CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, \
    serialization_format TEXT NOT NULL, \
        offered_qos_profiles TEXT NOT NULL, type_description_hash TEXT NOT NULL);\
    CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT NULL, encoding \
    TEXT NOT NULL, \
        encoded_message_definition TEXT NOT NULL, type_description_hash TEXT NOT NULL);\
    CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp INTEGER \
    NOT NULL, data BLOB NOT NULL);\
    CREATE INDEX timestamp_idx ON messages (timestamp ASC);";

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Packing {
    No,
    Files,
    Messages,
}

#[derive(Copy, Clone, Debug, PartialEq, Eq)]
pub enum Storage {
    Mcap,
    Sqlite3,
}

pub fn folder() -> TempDir {
    TempDir::new_in(env!("CARGO_TARGET_TMPDIR")).unwrap()
}

pub fn cdr(message: &Written) -> Vec<u8> {
    [&[0, 1, 0, 0][..], &message.value.to_le_bytes()].concat()
}

pub fn empty_database(path: &Path) -> Connection {
    let db = Connection::open(path).unwrap();
    db.execute_batch(TABLES).unwrap();
    db
}

pub fn add_topic(db: &Connection, topic: &str, type_name: &str) -> i64 {
    let sql = "INSERT INTO topics (name, type, serialization_format, offered_qos_profiles, \
               type_description_hash) \
               VALUES (?1, ?2, 'cdr', '- depth: 5', '')";
    db.execute(sql, (topic, type_name)).unwrap();
    db.last_insert_rowid()
}

pub fn add_text(db: &Connection, type_name: &str, encoding: &str, text: &str) {
    let sql = "INSERT INTO message_definitions (topic_type, encoding, encoded_message_definition, \
               type_description_hash) \
               VALUES (?1, ?2, ?3, '')";
    db.execute(sql, (type_name, encoding, text)).unwrap();
}

pub fn add_message(db: &Connection, topic: i64, at: i64, data: &[u8]) {
    let sql = "INSERT INTO messages (topic_id, timestamp, data) VALUES (?1, ?2, ?3)";
    db.execute(sql, (topic, at, data)).unwrap();
}

/// Creates a database with `messages` in this order, each converted by `bytes`.
pub fn database_of(path: &Path, messages: &[Written], bytes: impl Fn(&Written) -> Vec<u8>) {
    let db = empty_database(path);
    db.execute_batch("BEGIN").unwrap();
    add_text(&db, TYPE, "ros2msg", TEXT);
    let mut topics = HashMap::new();
    for message in messages {
        let topic =
            *topics.entry(message.topic).or_insert_with(|| add_topic(&db, message.topic, TYPE));
        add_message(&db, topic, message.at as i64, &bytes(message));
    }
    db.execute_batch("COMMIT").unwrap();
}

pub fn database(path: &Path, messages: &[Written]) {
    database_of(path, messages, cdr);
}

pub fn mcap_of(messages: &[Written], bytes: impl Fn(&Written) -> Vec<u8>) -> Vec<u8> {
    let mut writer = begin();
    for message in messages {
        let channel = add_channel(&mut writer, message.topic, TEXT);
        write_data(&mut writer, channel, message.at, &bytes(message));
    }
    finish(writer)
}

pub fn packed(bytes: &[u8]) -> Vec<u8> {
    zstd::encode_all(bytes, 1).unwrap()
}

/// Creates a directory with `parts`, one in each file.
pub fn bag(storage: Storage, packing: Packing, parts: &[&[Written]]) -> TempDir {
    let folder = folder();
    let mut names = Vec::new();
    for (number, messages) in parts.iter().enumerate() {
        let ending = if storage == Storage::Mcap { "mcap" } else { "db3" };
        let name = format!("bag_{number}.{ending}");
        let bytes = |message: &Written| match packing {
            Packing::Messages => packed(&cdr(message)),
            _ => cdr(message),
        };
        let path = folder.path().join(&name);
        match storage {
            Storage::Mcap => fs::write(&path, mcap_of(messages, bytes)).unwrap(),
            Storage::Sqlite3 => database_of(&path, messages, bytes),
        }
        if packing == Packing::Files {
            fs::write(
                path.with_extension(format!("{ending}.zstd")),
                packed(&fs::read(&path).unwrap()),
            )
            .unwrap();
            fs::remove_file(path).unwrap();
            names.push(format!("{name}.zstd"));
        } else {
            names.push(name);
        }
    }
    let names: Vec<_> = names.iter().map(String::as_str).collect();
    let storage = if storage == Storage::Mcap { "mcap" } else { "sqlite3" };
    let mode = match packing {
        Packing::No => "",
        Packing::Files => "FILE",
        Packing::Messages => "MESSAGE",
    };
    write_metadata(folder.path(), &metadata(5, storage, mode, &names, &parts.concat()));
    folder
}

pub fn metadata(
    version: u32,
    storage: &str,
    mode: &str,
    files: &[&str],
    messages: &[Written],
) -> String {
    let mut counts = BTreeMap::<_, u64>::new();
    messages.iter().for_each(|message| *counts.entry(message.topic).or_default() += 1);
    let files: String = files.iter().map(|file| format!("    - {file}\n")).collect();
    let topic = |(topic, count): (&&str, &u64)| {
        format!(
            "    - topic_metadata:\n        name: {topic}\n        type: {TYPE}\n        \
             serialization_format: cdr\n\
             \x20       offered_qos_profiles: \"- history: 1\\n  depth: 5\"\n      message_count: \
             {count}\n"
        )
    };
    let topics: String = counts.iter().map(topic).collect();
    let format = if mode.is_empty() { "" } else { "zstd" };
    format!(
        "rosbag2_bagfile_information:\n  version: {version}\n  storage_identifier: {storage}\n  \
         relative_file_paths:\n{files}\
         \x20 duration:\n    nanoseconds: 1\n  starting_time:\n    nanoseconds_since_epoch: 1\n  \
         message_count: {}\n\
         \x20 topics_with_message_count:\n{topics}  compression_format: \"{format}\"\n  \
         compression_mode: \"{mode}\"\n",
        messages.len()
    )
}

pub fn write_metadata(folder: &Path, text: &str) {
    fs::write(folder.join("metadata.yaml"), text).unwrap();
}

pub fn unpack_in(folder: &Path) -> DriveOptions {
    DriveOptions { unpack_in: Some(folder.to_owned()), ..DriveOptions::default() }
}

pub fn database_in(folder: &TempDir, messages: &[Written]) -> PathBuf {
    let path = folder.path().join("drive.db3");
    database(&path, messages);
    path
}

/// Creates a database with `messages` in a folder, which is returned with its path.
pub fn new_database(messages: &[Written]) -> (TempDir, PathBuf) {
    let folder = folder();
    let path = database_in(&folder, messages);
    (folder, path)
}

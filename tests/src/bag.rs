//! Builds drives in the formats of rosbag2 from the sample drive: databases, directories, long
//! ones.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use rusqlite::Connection;

use crate::{TempFolder, sample_drive};

/// Time between two rounds of the sample drive in ns; the drive takes 40 s.
const ROUND_NS: u64 = 40_100_000_000;

/// The tables of ROS 2 Humble, without message definitions.
const TABLES: &str = "\
    PRAGMA journal_mode = OFF; PRAGMA synchronous = OFF;\
    CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);\
    CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, \
        serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL);\
    CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, \
        timestamp INTEGER NOT NULL, data BLOB NOT NULL);\
    CREATE INDEX timestamp_idx ON messages (timestamp ASC);\
    INSERT INTO schema VALUES (3, 'humble'); BEGIN;";

/// The messages of the sample drive by time: topic, type, log time, bytes.
fn sample() -> Vec<(String, String, u64, Vec<u8>)> {
    let bytes = std::fs::read(sample_drive()).expect("the sample drive exists");
    let messages = mcap::MessageStream::new(&bytes).expect("a drive").map(|message| {
        let message = message.expect("a complete drive");
        let type_name = message.channel.schema.as_ref().expect("a schema").name.clone();
        (message.channel.topic.clone(), type_name, message.log_time, message.data.into_owned())
    });
    let mut messages: Vec<_> = messages.collect();
    messages.sort_by_key(|(_, _, at, _)| *at);
    messages
}

/// Writes the sample drive into the new database `path`, `rounds` times in a row. Returns the
/// number of messages by topic.
pub fn database(path: &Path, rounds: u64) -> BTreeMap<String, u64> {
    let db = Connection::open(path).expect("the folder is writable");
    db.execute_batch(TABLES).expect("an empty database");
    let (mut topics, mut counts) = (HashMap::new(), BTreeMap::new());
    let messages = sample();
    {
        let mut insert = db
            .prepare("INSERT INTO messages (topic_id, timestamp, data) VALUES (?1, ?2, ?3)")
            .expect("the tables exist");
        for round in 0..rounds {
            for (topic, type_name, at, data) in &messages {
                let id = *topics.entry(topic).or_insert_with(|| {
                    let sql = "INSERT INTO topics \
                               (name, type, serialization_format, offered_qos_profiles) \
                               VALUES (?1, ?2, 'cdr', '')";
                    db.execute(sql, (topic, type_name)).expect("the tables exist");
                    db.last_insert_rowid()
                });
                let at = i64::try_from(at + round * ROUND_NS).expect("before 2262");
                insert.execute((id, at, data)).expect("room on the disk");
                *counts.entry(topic.clone()).or_default() += 1;
            }
        }
    }
    db.execute_batch("COMMIT").expect("room on the disk");
    counts
}

/// Writes the sample drive into the new MCAP file `path`, `rounds` times in a row, with
/// uncompressed chunks as rosbag2 writes them.
pub fn mcap(path: &Path, rounds: u64) {
    let bytes = std::fs::read(sample_drive()).expect("the sample drive exists");
    let file = BufWriter::new(File::create(path).expect("the folder is writable"));
    let mut writer = mcap::WriteOptions::new()
        .profile("ros2")
        .compression(None)
        .create(file)
        .expect("a new file");
    for round in 0..rounds {
        for message in mcap::MessageStream::new(&bytes).expect("a drive") {
            let mut message = message.expect("a complete drive");
            message.log_time += round * ROUND_NS;
            message.publish_time += round * ROUND_NS;
            writer.write(&message).expect("room on the disk");
        }
    }
    writer.finish().expect("room on the disk");
}

/// A rosbag2 directory with one database, which holds the sample drive `rounds` times in a row.
pub fn directory(folder: &TempFolder, rounds: u64) -> PathBuf {
    let path = folder.path().join("drive");
    std::fs::create_dir(&path).expect("the folder is writable");
    let counts = database(&path.join("drive_0.db3"), rounds);
    let topics: String = counts
        .iter()
        .map(|(topic, count)| {
            format!("    - topic_metadata:\n        name: {topic}\n      message_count: {count}\n")
        })
        .collect();
    let text = format!(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: sqlite3\n  \
         relative_file_paths:\n    - drive_0.db3\n  topics_with_message_count:\n{topics}  \
         compression_format: \"\"\n  compression_mode: \"\"\n"
    );
    folder.write("drive/metadata.yaml", text);
    path
}

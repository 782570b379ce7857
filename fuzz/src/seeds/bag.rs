//! Seeds: rosbag2 metadata of several versions, and small databases.

use rusqlite::Connection;

/// Keys and values of metadata, and names of database tables and columns.
pub const WORDS: &[&str] = &[
    "rosbag2_bagfile_information:",
    "version:",
    "storage_identifier:",
    "relative_file_paths:",
    "files:",
    "path:",
    "topics_with_message_count:",
    "topic_metadata:",
    "name:",
    "message_count:",
    "compression_format:",
    "compression_mode:",
    "mcap",
    "sqlite3",
    "zstd",
    "FILE",
    "a.mcap",
    "../",
    "link.mcap",
    "a/c.mcap",
    "&a",
    "*a",
    "<<:",
    "topics",
    "messages",
    "message_definitions",
    "timestamp",
];

pub fn all() -> Vec<Vec<u8>> {
    let topics = "  topics_with_message_count:\n    - topic_metadata:\n        name: /a\n        \
                  type: test_msgs/msg/Number\n        serialization_format: cdr\n        \
                  offered_qos_profiles: \"- history: 1\"\n      message_count: 3\n";
    let texts = [
        format!(
            "version: 3\n  storage_identifier: sqlite3\n  relative_file_paths:\n    \
             - bag/b.db3.zstd\n{topics}  compression_format: zstd\n  compression_mode: FILE\n"
        ),
        format!(
            "version: 5\n  storage_identifier: mcap\n  relative_file_paths: [a.mcap, a/c.mcap]\n\
             {topics}  files:\n    - path: a.mcap\n      message_count: 3\n"
        ),
        "version: 9\n  storage_identifier: mcap\n  files:\n    - path: &a a.mcap\n  \
         custom_data: {x: *a}\n"
            .to_owned(),
    ];
    let texts =
        texts.iter().map(|text| format!("rosbag2_bagfile_information:\n  {text}").into_bytes());
    let encodings = ["", "ros2msg"];
    texts.chain(encodings.map(database)).collect()
}

fn database(encoding: &str) -> Vec<u8> {
    let db = Connection::open_in_memory().expect("SQLite opens a database in memory");
    db.execute_batch(
        "PRAGMA page_size = 512;
         CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format,
             offered_qos_profiles);
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data);
         CREATE INDEX i ON messages (timestamp);
         INSERT INTO topics VALUES (1, '/a', 'test_msgs/msg/Number', 'cdr', ''),
             (2, '/b', 'test_msgs/msg/Number', 'cdr', '');",
    )
    .expect("the statements are valid");
    if !encoding.is_empty() {
        db.execute_batch(
            "CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type, encoding,
                 encoded_message_definition);
             INSERT INTO message_definitions
                 VALUES (1, 'test_msgs/msg/Number', 'ros2msg', 'int64 value');",
        )
        .expect("the statements are valid");
    }
    for number in 0..8_i64 {
        let data = [&[0, 1, 0, 0][..], &number.to_le_bytes()].concat();
        let sql = "INSERT INTO messages (topic_id, timestamp, data) VALUES (?1, ?2, ?3)";
        db.execute(sql, (number % 2 + 1, 1000 + number / 3, data)).expect("the tables exist");
    }
    let folder =
        std::env::temp_dir().join(format!("gleaner-seed-{}-{encoding}.db3", std::process::id()));
    let _ = std::fs::remove_file(&folder);
    db.execute("VACUUM INTO ?1", [folder.to_str().expect("a temporary path is UTF-8")])
        .expect("it is writable");
    let bytes = std::fs::read(&folder).expect("it was written");
    let _ = std::fs::remove_file(&folder);
    bytes
}

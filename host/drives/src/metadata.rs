//! Parses `metadata.yaml`, which rosbag2 writes beside the files of a directory.
//!
//! Versions 1 to 9 only add keys; those that are needed here have not changed. So unknown keys are
//! skipped, and the needed ones are checked closely: this file is as untrusted as the directory.

use std::collections::BTreeMap;
use std::error::Error;

use serde::Deserialize;

/// Size limit of `metadata.yaml`; one of a thousand topics and files has some 500 KB.
pub const MAX_BYTES: u64 = 16 << 20;
/// Length limit for names of storages and compressions in errors; those of rosbag2 are shorter.
const SHOWN_CHARS: usize = 32;

#[derive(Debug, PartialEq, Eq)]
pub struct BagMetadata {
    pub files: Vec<String>,
    /// Number of messages by topic, in all files.
    pub messages: BTreeMap<String, u64>,
}

#[derive(Deserialize)]
struct Document {
    rosbag2_bagfile_information: Information,
}

#[derive(Deserialize)]
struct Information {
    storage_identifier: String,
    #[serde(default)]
    relative_file_paths: Vec<String>,
    #[serde(default)]
    files: Vec<FileEntry>,
    #[serde(default)]
    compression_format: Option<String>,
    #[serde(default)]
    compression_mode: Option<String>,
    #[serde(default)]
    topics_with_message_count: Vec<CountedTopic>,
}

#[derive(Deserialize)]
struct FileEntry {
    path: String,
}

#[derive(Deserialize)]
struct CountedTopic {
    topic_metadata: TopicMetadata,
    message_count: u64,
}

#[derive(Deserialize)]
struct TopicMetadata {
    name: String,
}

#[derive(Debug, thiserror::Error)]
enum MetadataError {
    #[error("its storage is `{0}`; only mcap and sqlite3 can be read")]
    Storage(String),
    #[error("its files are compressed with `{0}`; only zstd can be read")]
    Compression(String),
    #[error("it does not name any file")]
    NoFiles,
}

pub fn read(text: &str) -> Result<BagMetadata, Box<dyn Error + Send + Sync>> {
    let options = serde_saphyr::options! {
        // Writers do not use aliases; they could make a small file expand to a large one.
        budget: serde_saphyr::budget! {
            max_aliases: 1_000,
            max_recorded_anchor_bytes: 1 << 20,
            max_documents: 1,
            max_merge_keys: 0
        },
        alias_limits: serde_saphyr::alias_limits! {
            max_total_replayed_events: 10_000,
            max_replay_stack_depth: 4
        },
        with_snippet: false,
    };
    let document: Document = serde_saphyr::from_str_with_options(text, options)?;
    let found = document.rosbag2_bagfile_information;
    let shown =
        |text: &str| text.chars().filter(|c| !c.is_control()).take(SHOWN_CHARS).collect::<String>();
    // `ros2 bag reindex` of Humble leaves it empty. The first bytes of a file decide its kind.
    if !["mcap", "sqlite3", ""].contains(&found.storage_identifier.as_str()) {
        return Err(MetadataError::Storage(shown(&found.storage_identifier)).into());
    }
    let mode = found.compression_mode.unwrap_or_default().to_ascii_lowercase();
    let format = found.compression_format.unwrap_or_default();
    // The first bytes of files and messages show whether they are packed.
    if !["", "none"].contains(&mode.as_str()) && !["", "zstd"].contains(&format.as_str()) {
        return Err(MetadataError::Compression(shown(&format)).into());
    }
    let mut files = found.relative_file_paths;
    if files.is_empty() {
        files = found.files.into_iter().map(|file| file.path).collect();
    }
    if files.is_empty() {
        return Err(MetadataError::NoFiles.into());
    }
    let mut messages = BTreeMap::<_, u64>::new();
    for CountedTopic { topic_metadata: TopicMetadata { name }, message_count } in
        found.topics_with_message_count
    {
        let known = messages.entry(name).or_default();
        *known = known.saturating_add(message_count);
    }
    Ok(BagMetadata { files, messages })
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: &str = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n";

    #[test]
    fn needed_keys_are_found_among_others() {
        let text = format!(
            "{START}  duration:\n    nanoseconds: 5\n  relative_file_paths:\n    - a_0.mcap\n    \
             - a_1.mcap\n  message_count: 3\n\
             \x20 topics_with_message_count:\n    - topic_metadata:\n        name: /a\n        \
             type: std_msgs/msg/String\n\
             \x20       offered_qos_profiles:\n          - history: keep_last\n            depth: \
             1\n      message_count: 3\n\
             \x20 compression_format: \"\"\n  compression_mode: \"\"\n  custom_data: ~\n  \
             ros_distro: rolling\n  invented: [1, 2]\n"
        );
        let found = read(&text).unwrap();
        assert_eq!(found.files, ["a_0.mcap", "a_1.mcap"]);
        assert_eq!(found.messages, BTreeMap::from([("/a".to_owned(), 3)]));
    }

    #[test]
    fn files_may_be_named_by_their_own_list_only() {
        let text = format!(
            "{START}  relative_file_paths: []\n  files:\n    - path: a_0.mcap\n      \
             message_count: 3\n"
        );
        assert_eq!(read(&text).unwrap().files, ["a_0.mcap"]);
    }

    #[test]
    fn the_error_names_what_cannot_be_read() {
        let file = "  relative_file_paths: [a]\n";
        for (text, expected) in [
            (START.replace("mcap", "rosbag_v2") + file, "its storage is `rosbag_v2`"),
            (
                format!("{START}{file}  compression_mode: FILE\n  compression_format: lz4\n"),
                "compressed with `lz4`",
            ),
            (START.to_owned(), "it does not name any file"),
            (String::new(), "unexpected end"),
            ("other: 7\n".to_owned(), "rosbag2_bagfile_information"),
            ("rosbag2_bagfile_information: 7\n".to_owned(), "line 1"),
            (format!("{START}  relative_file_paths: [a, [b]]\n"), "line 4"),
        ] {
            let error = read(&text).unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }

    #[test]
    fn a_small_text_does_not_expand_to_a_large_one() {
        let mut bomb = format!("{START}  a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n");
        for level in 1..10 {
            let before = format!("*a{}, ", level - 1).repeat(10);
            bomb += &format!("  a{level}: &a{level} [{before}]\n");
        }
        bomb += "  relative_file_paths: *a9\n";
        read(&bomb).unwrap_err();
        read(&("[".repeat(100_000) + &"]".repeat(100_000))).unwrap_err();
    }
}

//! Tests the sources of definitions of a recorded topic: its file first, then those of live topics.

use std::fs;
use std::path::PathBuf;
use std::sync::Arc;

use gleaner_drives::{DriveOptions, Replay};
use gleaner_messages::transport::{Transport, TransportError};
use gleaner_messages::{FieldPath, Sources};

use super::bag::{add_text, add_topic, empty_database, folder};
use crate::support::{MemorySink, TYPE, drive, file, listen, small_chunks, spec, ticking};

const IMU: &str = "sensor_msgs/msg/Imu";

fn open(path: PathBuf, msg: Option<PathBuf>) -> Replay {
    let sources = Some(Sources::new(&Vec::from_iter(msg), &[]));
    Replay::open_as(&[path], &DriveOptions { sources, ..DriveOptions::default() }).unwrap()
}

fn folder_with(package: &str, name: &str, text: &str) -> tempfile::TempDir {
    let folder = folder();
    let package = folder.path().join(package);
    fs::create_dir_all(&package).unwrap();
    fs::write(package.join(name), text).unwrap();
    folder
}

/// Creates a database with one topic, whose `text` is an encoding and a definition.
fn database(type_name: &str, text: Option<(&str, &str)>) -> (tempfile::TempDir, PathBuf) {
    let folder = folder();
    let path = folder.path().join("drive.db3");
    let db = empty_database(&path);
    add_topic(&db, "/a", type_name);
    if let Some((encoding, text)) = text {
        add_text(&db, type_name, encoding, text);
    }
    (folder, path)
}

#[test]
fn a_type_that_the_file_does_not_carry_is_found_in_ros_2() {
    let (_folder, path) = database(IMU, None);
    let replay = open(path.clone(), None);
    FieldPath::compile(&replay.definitions("/a").unwrap(), "linear_acceleration.x").unwrap();
    // A recorder writes them into its clips.
    let text = replay.topics()[0].definitions_text.clone().unwrap();
    assert!(text.contains("MSG: geometry_msgs/Vector3"));
    // Without sources, only the definitions in the files are used.
    let plain = Replay::open(&[path]).unwrap();
    assert!(matches!(plain.definitions("/a"), Err(TransportError::NoDefinitions { .. })));
    assert_eq!(plain.topics()[0].definitions_text, None);
}

#[test]
fn the_file_comes_before_the_lambda_and_the_lambda_before_ros_2() {
    let msg = folder_with("sensor_msgs/msg", "Imu.msg", "float64 beside_the_lambda\n");
    let (_first, without) = database(IMU, None);
    let (_second, with) = database(IMU, Some(("ros2msg", "float64 in_the_file\n")));
    let finds = |path, field| {
        let replay = open(path, Some(msg.path().to_owned()));
        FieldPath::compile(&replay.definitions("/a").unwrap(), field).map(drop).unwrap();
    };
    finds(without, "beside_the_lambda");
    finds(with, "in_the_file");
}

#[test]
fn a_topic_of_a_database_has_the_definition_with_its_hash() {
    /// Of "int64 new", by rosbags.
    const HASH: &str = "RIHS01_c99ea3e2c06884489588f67048b07f101623fba71afbc57f8e1103c13e390e00";
    let ty = TYPE;
    let (_folder, path) = database(ty, Some(("ros2msg", "int64 old")));
    let db = rusqlite::Connection::open(&path).unwrap();
    add_text(&db, ty, "ros2msg", "int64 new");
    let finds = |topic: &str, definition: &str| {
        db.execute("UPDATE topics SET type_description_hash = ?1", [topic]).unwrap();
        let hash = "UPDATE message_definitions SET type_description_hash = ?1 \
                    WHERE encoded_message_definition LIKE '% new'";
        db.execute(hash, [definition]).unwrap();
        let replay = open(path.clone(), None);
        replay
            .can_subscribe(&spec("/a"))
            .map(|()| replay.definitions("/a").unwrap().fields().next().unwrap().to_owned())
    };
    assert_eq!(finds(HASH, HASH).unwrap(), "new");
    // Two definitions, and no word on which one is meant.
    for topic in ["", "RIHS01_other"] {
        let refused = finds(topic, HASH).unwrap_err();
        assert!(matches!(refused, TransportError::UnknownLayout { .. }), "{refused}");
    }
}

#[test]
fn a_text_in_idl_is_refused_unless_there_is_another() {
    let ty = TYPE;
    let (_folder, path) = database(ty, Some(("ros2idl", "module test_msgs {};")));
    let memory = Arc::new(MemorySink::default());
    let refused = open(path.clone(), None).subscribe(&spec("/a"), memory).unwrap_err();
    let expected = "topic `/a` has schema encoding `ros2idl`; only `ros2msg` can be read";
    assert_eq!(refused.to_string(), expected);
    let msg = folder_with("test_msgs/msg", "Number.msg", "int64 value\n");
    let mut replay = open(path, Some(msg.path().to_owned()));
    listen(&mut replay, &["/a"]);
    FieldPath::compile(&replay.definitions("/a").unwrap(), "value").unwrap();
}

#[test]
fn a_type_without_definitions_can_be_subscribed_but_not_read_by_field() {
    let (_folder, path) = database(TYPE, None);
    let mut replay = open(path, None);
    listen(&mut replay, &["/a"]);
    assert!(matches!(replay.definitions("/a"), Err(TransportError::NoDefinitions { .. })));
}

#[test]
fn the_error_names_invalid_definitions_of_the_lambda() {
    let msg = folder_with("test_msgs/msg", "Number.msg", "int64\n");
    let (_folder, path) = database(TYPE, None);
    let replay = open(path, Some(msg.path().to_owned()));
    assert!(matches!(replay.definitions("/a"), Err(TransportError::UnusableDefinitions { .. })));
    assert_eq!(replay.topics()[0].definitions_text, None);
}

#[test]
fn a_file_that_carries_its_definitions_needs_no_others() {
    let replay = open(file(&drive(small_chunks(), &ticking(&["/a"], 3, 10))), None);
    FieldPath::compile(&replay.definitions("/a").unwrap(), "value").unwrap();
}

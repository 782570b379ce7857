//! Tests undamaged directories and files: every message is delivered, in the order of times.

use std::fs;

use gleaner_drives::{Progress, Replay, files_of};
use gleaner_messages::transport::Transport;

use super::bag::{
    Packing, Storage, add_message, add_topic, bag, cdr, database, database_in, database_of,
    empty_database, folder, metadata, new_database, packed, unpack_in, write_metadata,
};
use crate::support::{
    TOPICS, Written, begun, delivered, drive, expected, file, listen, replayed, run, run_whole,
    small_chunks, ticking,
};

#[test]
fn every_storage_and_packing_gives_the_same_messages() {
    let messages = ticking(&TOPICS, 600, 1000);
    for storage in [Storage::Mcap, Storage::Sqlite3] {
        for packing in [Packing::No, Packing::Files, Packing::Messages] {
            let bag = bag(storage, packing, &[&messages[..200], &messages[200..]]);
            let (all, error) = replayed(&[bag.path().to_owned()], &TOPICS);
            assert!(error.is_none(), "{storage:?} {packing:?}: {error:?}");
            assert_eq!(all, expected(&messages), "{storage:?} {packing:?}");
        }
    }
}

#[test]
fn a_database_is_read_by_time_and_then_by_number() {
    let at = |topic, at, value| Written { topic, at, sequence: 0, value };
    let messages = [
        at("/b", 7, 0),
        at("/a", 5, 1),
        at("/b", 5, 2),
        at("/a", 5, 3),
        at("/a", 6, 4),
        at("/b", 0, 5),
    ];
    let (_folder, path) = new_database(&messages);
    assert_eq!(delivered(&[path], &TOPICS), [(0, 5), (5, 1), (5, 2), (5, 3), (6, 4), (7, 0)]);
}

#[test]
fn a_database_of_many_pieces_keeps_its_order_where_times_are_equal() {
    // Some 8 MB; five thousand messages have the same time, so that pieces end between equal times.
    let messages: Vec<_> = (0..20_000)
        .map(|n| Written {
            topic: TOPICS[n % 2],
            at: n as u64 / 5000,
            sequence: 0,
            value: n as i64,
        })
        .collect();
    let folder = folder();
    let path = folder.path().join("drive.db3");
    database_of(&path, &messages, |message| [cdr(message), vec![0; 400]].concat());
    let (mut replay, memory) = begun(&[path], &TOPICS);
    let steps = run_whole(&mut replay);
    assert_eq!(steps.len(), 20_000);
    let taken = memory.0.lock().unwrap();
    let values = taken.iter().map(|(_, cdr)| i64::from_le_bytes(*cdr.first_chunk().unwrap()));
    assert!(values.eq(0..20_000));
    assert_eq!(replay.out_of_order(), 0);
}

#[test]
fn databases_and_mcap_files_are_merged_by_time() {
    let messages = ticking(&TOPICS, 90, 1000);
    let folder = folder();
    let third = |n: usize| messages.iter().skip(n).step_by(3).cloned().collect::<Vec<_>>();
    let paths = [database_in(&folder, &third(0)), file(&drive(small_chunks(), &third(1)))];
    let packed_path = folder.path().join("packed");
    fs::write(&packed_path, packed(&drive(small_chunks(), &third(2)))).unwrap();
    assert_eq!(delivered(&[&paths[..], &[packed_path]].concat(), &TOPICS), expected(&messages));
}

#[test]
fn a_topic_without_subscription_is_skipped() {
    let messages = ticking(&TOPICS, 60, 1000);
    let folder = folder();
    let all = delivered(&[database_in(&folder, &messages)], &["/b"]);
    let of_b: Vec<_> = messages.into_iter().filter(|message| message.topic == "/b").collect();
    assert_eq!(all, expected(&of_b));
}

#[test]
fn topics_are_described_as_in_the_metadata() {
    let messages = ticking(&TOPICS, 30, 1000);
    let bag = bag(Storage::Sqlite3, Packing::No, &[&messages[..20], &messages[20..]]);
    let mut replay = Replay::open(&[bag.path().to_owned()]).unwrap();
    assert_eq!((replay.start_ns(), replay.end_ns()), (Some(1000), Some(1290)));
    let topics = replay.topics();
    assert_eq!(topics.iter().map(|topic| topic.topic.as_str()).collect::<Vec<_>>(), TOPICS);
    assert!(topics.iter().all(|topic| topic.messages == Some(15)), "{topics:?}");
    let qos = Some("- depth: 5");
    assert!(topics.iter().all(|topic| topic.offered_qos.as_deref() == qos), "{topics:?}");
    listen(&mut replay, &TOPICS);
    assert_eq!(replay.progress(), Progress { done: 0, total: Some(30) });
}

#[test]
fn a_missing_message_count_is_unknown_and_not_zero() {
    let folder = folder();
    let mut replay = Replay::open(&[database_in(&folder, &ticking(&TOPICS, 30, 1000))]).unwrap();
    assert!(replay.topics().iter().all(|topic| topic.messages.is_none()));
    listen(&mut replay, &TOPICS);
    assert_eq!(replay.progress().total, None);
}

#[test]
fn a_writer_in_a_database_counts_up_without_numbers_of_its_own() {
    let folder = folder();
    let (mut replay, _) = begun(&[database_in(&folder, &ticking(&["/a"], 3, 1000))], &["/a"]);
    let (steps, _) = run(&mut replay);
    assert!(steps.iter().map(|step| step.meta.seq).eq([1, 2, 3]));
    assert!(steps.iter().all(|step| step.meta.publish_ns == step.at_ns));
}

#[test]
fn a_database_of_an_old_distribution_is_read() {
    let folder = folder();
    let path = folder.path().join("old.db3");
    let db = rusqlite::Connection::open(&path).unwrap();
    db.execute_batch(
        "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL, \
         serialization_format TEXT NOT NULL);
         CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL, timestamp \
         INTEGER NOT NULL, data BLOB NOT NULL);
         CREATE INDEX timestamp_idx ON messages (timestamp ASC);
         INSERT INTO topics VALUES (4, '/a', 'test_msgs/msg/Number', 'cdr');",
    )
    .unwrap();
    let messages = ticking(&["/a"], 5, 10);
    messages.iter().for_each(|message| add_message(&db, 4, message.at as i64, &cdr(message)));
    drop(db);
    assert_eq!(delivered(&[path], &["/a"]), expected(&messages));
}

#[test]
fn an_empty_database_is_an_empty_drive() {
    let folder = folder();
    let path = folder.path().join("drive.db3");
    add_topic(&empty_database(&path), "/a", crate::support::TYPE);
    let all = delivered(&[path], &["/a"]);
    assert!(all.is_empty());
}

#[test]
fn a_directory_without_metadata_is_read_file_by_file() {
    let messages = ticking(&TOPICS, 40, 1000);
    let bag = bag(Storage::Mcap, Packing::No, &[&messages[..20], &messages[20..]]);
    fs::remove_file(bag.path().join("metadata.yaml")).unwrap();
    fs::write(bag.path().join("notes.txt"), "no drive").unwrap();
    // A second copy, as left by a recorder that was killed while it packed.
    fs::write(bag.path().join("bag_1.mcap.zstd"), packed(b"begun")).unwrap();
    let path = [bag.path().to_owned()];
    let names: Vec<_> =
        files_of(&path).unwrap().iter().map(|path| path.file_name().unwrap().to_owned()).collect();
    assert_eq!(names, ["bag_0.mcap", "bag_1.mcap"]);
    assert_eq!(delivered(&path, &TOPICS), expected(&messages));
}

#[test]
fn a_directory_of_version_3_may_have_been_renamed() {
    let messages = ticking(&TOPICS, 20, 1000);
    let folder = folder();
    database(&folder.path().join("drive_0.db3"), &messages);
    write_metadata(folder.path(), &metadata(3, "sqlite3", "", &["drive/drive_0.db3"], &messages));
    assert_eq!(delivered(&[folder.path().to_owned()], &TOPICS), expected(&messages));
}

#[test]
fn files_that_were_packed_or_unpacked_later_are_found() {
    let messages = ticking(&TOPICS, 20, 1000);
    for (there, named) in [("x.mcap", "x.mcap.zstd"), ("x.mcap.zstd", "x.mcap")] {
        let folder = folder();
        let bytes = drive(small_chunks(), &messages);
        let bytes = if there.ends_with("zstd") { packed(&bytes) } else { bytes };
        fs::write(folder.path().join(there), bytes).unwrap();
        write_metadata(folder.path(), &metadata(8, "mcap", "FILE", &[named], &messages));
        let (all, _) = replayed(&[folder.path().to_owned()], &TOPICS);
        assert_eq!(all, expected(&messages), "{there}");
    }
}

#[test]
fn unpacked_content_is_in_the_given_folder_and_is_removed() {
    let messages = ticking(&TOPICS, 60, 1000);
    for storage in [Storage::Mcap, Storage::Sqlite3] {
        let (bag, folder) = (bag(storage, Packing::Files, &[&messages]), folder());
        let paths = [bag.path().to_owned()];
        let mut replay = Replay::open_as(&paths, &unpack_in(folder.path())).unwrap();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 0);
        let memory = listen(&mut replay, &TOPICS);
        assert!(run(&mut replay).1.is_none());
        assert_eq!(memory.values(), expected(&messages));
        // A folder that does not exist is an error.
        let nowhere = unpack_in(&folder.path().join("missing"));
        let refused = Replay::open_as(&paths, &nowhere).err().unwrap();
        assert!(refused.help().unwrap().contains("zstd -d"), "{refused}");
    }
}

#[test]
fn a_path_may_contain_any_character() {
    let folder = folder();
    let messages = ticking(&TOPICS, 20, 1000);
    let path = folder.path().join("50% of ?a#b& 'ä\".db3");
    database(&path, &messages);
    assert_eq!(replayed(&[path], &TOPICS).0, expected(&messages));
}

#[test]
fn reading_leaves_nothing_beside_a_database() {
    let (folder, path) = new_database(&ticking(&TOPICS, 20, 1000));
    let before = fs::read(&path).unwrap();
    replayed(std::slice::from_ref(&path), &TOPICS);
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    assert_eq!(fs::read(&path).unwrap(), before);
}

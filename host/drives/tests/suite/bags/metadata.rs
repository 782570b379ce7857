//! Tests directories whose metadata cannot be used, or lead elsewhere.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::PathBuf;

use gleaner_drives::{Replay, ReplayError};

use super::bag::{Packing, Storage, bag, database, folder, metadata, write_metadata};
use super::hostile::refused;
use crate::support::{begun, drive, file, run, run_whole, small_chunks, ticking};

#[test]
fn metadata_that_are_a_link_out_of_the_directory_are_refused() {
    let (bag, other) = (bag(Storage::Mcap, Packing::No, &[&ticking(&["/a"], 3, 10)]), folder());
    let (path, elsewhere) = (bag.path().join("metadata.yaml"), other.path().join("metadata.yaml"));
    fs::rename(&path, &elsewhere).unwrap();
    symlink(&elsewhere, &path).unwrap();
    let error = refused(bag.path());
    assert!(matches!(error, ReplayError::Metadata { .. }), "{error}");
    // A link inside the directory is allowed.
    fs::remove_file(&path).unwrap();
    fs::rename(&elsewhere, bag.path().join("old.yaml")).unwrap();
    symlink("old.yaml", &path).unwrap();
    Replay::open(&[bag.path().to_owned()]).unwrap();
}

#[test]
fn a_path_that_leaves_the_directory_is_refused() {
    let messages = ticking(&["/a"], 5, 10);
    let elsewhere = folder();
    let secret = elsewhere.path().join("secret.mcap");
    fs::write(&secret, drive(small_chunks(), &messages)).unwrap();
    let inside = elsewhere.path().join("bag");
    fs::create_dir(&inside).unwrap();
    symlink(&secret, inside.join("link.mcap")).unwrap();
    let absolute = secret.display().to_string();
    for name in ["../secret.mcap", "bag/../../secret.mcap", absolute.as_str(), "link.mcap", "\"\""]
    {
        write_metadata(&inside, &metadata(5, "mcap", "", &[name], &messages));
        let error = refused(&inside);
        assert!(matches!(error, ReplayError::Outside { .. }), "{name}: {error}");
        assert!(error.to_string().contains("is not in its directory"), "{error}");
        assert!(error.help().is_some());
    }
    // Without metadata, a link is not a file of the directory.
    fs::remove_file(inside.join("metadata.yaml")).unwrap();
    assert!(matches!(refused(&inside), ReplayError::NoBag { .. }));
}

#[test]
fn the_error_names_a_missing_file_and_the_way_out() {
    let messages = ticking(&["/a"], 5, 10);
    let bag = bag(Storage::Mcap, Packing::No, &[&messages[..2], &messages[2..]]);
    fs::remove_file(bag.path().join("bag_1.mcap")).unwrap();
    let error = refused(bag.path());
    assert!(error.to_string().contains("names `bag_1.mcap`, which does not exist"), "{error}");
    assert!(error.help().unwrap().contains("ros2 bag reindex"));
}

#[test]
fn invalid_metadata_are_refused_with_their_path() {
    let messages = ticking(&["/a"], 5, 10);
    let bag = bag(Storage::Mcap, Packing::No, &[&messages]);
    let large = format!("# {}\n", "x".repeat(17 << 20));
    for text in ["", "{", "\0", "rosbag2_bagfile_information: []\n", large.as_str()] {
        write_metadata(bag.path(), text);
        let error = refused(bag.path());
        assert!(matches!(error, ReplayError::Metadata { .. }), "{error}");
        assert!(error.to_string().contains("metadata.yaml"), "{error}");
        assert!(error.help().unwrap().contains("ros2 bag reindex"));
    }
    fs::write(bag.path().join("metadata.yaml"), [0xff, 0xfe, 0x00]).unwrap();
    assert!(matches!(refused(bag.path()), ReplayError::Metadata { .. }));
}

#[test]
fn the_error_for_an_empty_directory_names_what_is_missing() {
    let folder = folder();
    let error = refused(folder.path());
    let expected = "has no metadata.yaml, and no .mcap or .db3 file";
    assert!(error.to_string().ends_with(expected), "{error}");
    assert!(error.help().is_some());
}

#[test]
fn a_file_given_together_with_its_directory_is_given_twice() {
    let messages = ticking(&["/a"], 5, 10);
    let bag = bag(Storage::Mcap, Packing::No, &[&messages]);
    let paths: [PathBuf; 2] = [bag.path().to_owned(), bag.path().join("./bag_0.mcap")];
    assert!(matches!(Replay::open(&paths), Err(ReplayError::Twice { .. })));
}

#[test]
fn a_higher_message_count_in_the_metadata_is_not_damage() {
    let messages = ticking(&["/a"], 50, 10);
    let folder = folder();
    database(&folder.path().join("drive_0.db3"), &messages[..40]);
    write_metadata(folder.path(), &metadata(5, "sqlite3", "", &["drive_0.db3"], &messages));
    let (mut replay, _) = begun(&[folder.path().to_owned()], &["/a"]);
    assert_eq!(replay.progress().total, Some(50));
    let steps = run_whole(&mut replay);
    assert_eq!(steps.len(), 40);
}

#[test]
fn a_truncated_file_of_a_directory_is_damage() {
    let messages = ticking(&["/a"], 50, 10);
    let bytes = drive(small_chunks(), &messages);
    let folder = folder();
    fs::rename(file(&bytes[..bytes.len() / 2]), folder.path().join("drive_0.mcap")).unwrap();
    write_metadata(folder.path(), &metadata(5, "mcap", "", &["drive_0.mcap"], &messages));
    let (mut replay, _) = begun(&[folder.path().to_owned()], &["/a"]);
    let (steps, error) = run(&mut replay);
    assert!(!steps.is_empty() && steps.len() < 50, "{}", steps.len());
    assert!(matches!(error, Some(ReplayError::Damaged { .. })), "{error:?}");
}

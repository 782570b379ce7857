use std::sync::Arc;

use gleaner_fleet::clips::{ClipName, ClipPolicy, ClipReport, UploadedClips};
use serde_json::json;
use tempfile::TempDir;

use super::{ClipFiles, FileOfClip};
use crate::place::FilePlace;
use crate::s3::S3Bucket;
use crate::store::{ClipBounds, ClipQuery, CloudStore};

#[path = "../../tests/fleet/bucket.rs"]
mod bucket;

const BOUNDS: ClipBounds =
    ClipBounds { clips: 3, vehicle_bytes: 100, bytes: 150, unfinished: 1, unfinished_s: 0 };

async fn store() -> (TempDir, CloudStore) {
    let folder = TempDir::new().unwrap();
    let store = CloudStore::of_test(&folder).await;
    let policy =
        ClipPolicy { upload: UploadedClips::All, day_bytes: 1 << 40, keep_s: 0, keep_bytes: 0 };
    for vehicle in ["a", "b"] {
        store.invite_vehicle("ann", vehicle).await.unwrap();
    }
    store.set_clip_policy("ann", &policy).await.unwrap();
    (folder, store)
}

async fn announce(store: &CloudStore, vehicle: &str, name: &str, bytes: u64) {
    let clip = json!({ "name": name, "from_ns": 1, "to_ns": 2, "bytes": bytes,
                       "sha256": "0".repeat(64), "thumbnail": null, "lambdas": [], "triggers": 0,
                       "moments": [] });
    let report = json!({ "cursor": "1", "clips": [clip], "gone": [] });
    let report: ClipReport = serde_json::from_value(report).unwrap();
    store.announce_clips(vehicle, &report, BOUNDS).await.unwrap();
}

async fn wanted(store: &CloudStore, vehicle: &str) -> Vec<String> {
    let orders = store.clip_orders(vehicle, BOUNDS).await.unwrap();
    orders.wanted.iter().map(|it| it.name.to_string()).collect()
}

fn name(text: &str) -> ClipName {
    text.parse().unwrap()
}

#[tokio::test]
async fn files_are_bounded_for_each_vehicle_and_in_all() {
    let (_folder, store) = store().await;
    for (vehicle, name, bytes) in [("a", "1", 60), ("a", "2", 60), ("b", "1", 95)] {
        announce(&store, vehicle, name, bytes).await;
    }
    assert_eq!(wanted(&store, "a").await, ["1", "2"]);
    let first = store.clip_progress("a", &name("1"), BOUNDS).await.unwrap();
    store.clip_part_received(&first, (60, "d"), true).await.unwrap();
    assert!(wanted(&store, "a").await.is_empty(), "the second one does not fit any more");
    let full = store.clip_progress("a", &name("2"), BOUNDS).await.unwrap_err().reason();
    assert!(full.contains("of its vehicle have 60 of 100 bytes"), "{full}");
    let full = store.clip_progress("b", &name("1"), BOUNDS).await.unwrap_err().reason();
    assert!(full.contains("of all vehicles have 60 of 150 bytes"), "{full}");
}

#[tokio::test]
async fn unfinished_files_are_bounded_and_forgotten_after_a_time() {
    let (_folder, store) = store().await;
    for name in ["1", "2"] {
        announce(&store, "a", name, 10).await;
    }
    let first = store.clip_progress("a", &name("1"), BOUNDS).await.unwrap();
    store.clip_part_received(&first, (8, "d"), false).await.unwrap();
    assert_eq!(wanted(&store, "a").await, ["1"], "no other one is begun");
    let busy = store.clip_progress("a", &name("2"), BOUNDS).await.unwrap_err().reason();
    assert!(busy.contains("1 uploads of the vehicle are unfinished"), "{busy}");
    let forgotten = store.forget_unfinished_clips(3600).await.unwrap();
    assert!(forgotten.is_empty(), "it is still young");
    let forgotten = store.forget_unfinished_clips(0).await.unwrap();
    assert_eq!(forgotten.iter().map(ToString::to_string).collect::<Vec<_>>(), ["1@a"]);
    assert_eq!(wanted(&store, "a").await, ["1", "2"]);
}

#[tokio::test]
async fn the_oldest_clips_without_files_are_forgotten_above_the_bound() {
    let (_folder, store) = store().await;
    announce(&store, "a", "0", 10).await;
    let stored = store.clip_progress("a", &name("0"), BOUNDS).await.unwrap();
    store.clip_part_received(&stored, (10, "d"), true).await.unwrap();
    for name in ["1", "2", "3", "4"] {
        announce(&store, "a", name, 10).await;
    }
    let page = store.clips(&ClipQuery::default()).await.unwrap();
    let names: Vec<_> = page.items.iter().map(|clip| clip.facts.name.to_string()).collect();
    assert_eq!(names, ["4", "3", "2", "0"]);
}

#[tokio::test]
async fn stored_clips_are_removed_by_people_and_by_age_and_size() {
    let (_folder, store) = store().await;
    for name in ["1", "2", "3", "4"] {
        announce(&store, "a", name, 10).await;
        if name != "4" {
            let progress = store.clip_progress("a", &self::name(name), BOUNDS).await.unwrap();
            store.clip_part_received(&progress, (10, "d"), true).await.unwrap();
        }
    }
    let names = async || {
        let page = store.clips(&ClipQuery::default()).await.unwrap();
        page.items.iter().map(|clip| clip.facts.name.to_string()).collect::<Vec<_>>()
    };
    let id = |name: &str| format!("{name}@a").parse().unwrap();
    store.remove_clip("ann", &id("1")).await.unwrap();
    assert!(store.remove_clip("ann", &id("1")).await.is_err(), "it is removed already");
    let refused = store.remove_clip("ann", &id("4")).await.unwrap_err().reason();
    assert!(refused.contains("is not in the cloud"), "{refused}");
    assert_eq!(names().await, ["4", "3", "2"]);
    // Its files are removed later, also after a kill.
    assert_eq!(store.removed_clips().await.unwrap(), [id("1")]);
    let removed = store.removed_clip(id("1")).await.unwrap();
    assert!(!removed.has_file && !removed.has_thumbnail);
    store.forget_removed_clip(&id("1")).await.unwrap();

    let keep = async |keep_s, keep_bytes| {
        let upload = UploadedClips::All;
        let policy = ClipPolicy { upload, day_bytes: 1 << 40, keep_s, keep_bytes };
        store.set_clip_policy("ann", &policy).await.unwrap();
        while store.expire_clips().await.unwrap() {}
    };
    keep(3600, 20).await;
    assert_eq!(names().await, ["4", "3", "2"], "they are young and few");
    keep(0, 10).await;
    assert_eq!(names().await, ["4", "3"], "the oldest goes first");
    store.execute("UPDATE clips SET part_time = part_time - 3600").await;
    keep(3600, 0).await;
    assert_eq!(names().await, ["4"], "only stored ones are removed");
    let counts = store.clip_counts().await.unwrap();
    assert_eq!((counts.stored, counts.removed, counts.removed_bytes), (0, 3, 30));
    let audit = store.audit(u64::MAX, 100).await.unwrap();
    let of = |action: &str| audit.iter().filter(|entry| entry.action == action).count();
    assert_eq!((of("remove clip"), of("remove clips")), (1, 2));
}

#[tokio::test]
async fn two_processes_remove_the_oldest_clip_once_and_keep_what_the_other_one_has_stored() {
    let (folder, store) = store().await;
    let other = CloudStore::open(&crate::store::address(&folder).await).await.unwrap();
    for name in ["1", "2"] {
        announce(&store, "a", name, 10).await;
        let progress = store.clip_progress("a", &self::name(name), BOUNDS).await.unwrap();
        store.clip_part_received(&progress, (10, "d"), true).await.unwrap();
        // The same file was on its way to the other one, where it was damaged.
        assert!(!other.clip_upload_failed(&progress.id, "damaged").await.unwrap());
        assert!(other.removed_clip(progress.id).await.unwrap().has_file);
    }
    let upload = UploadedClips::All;
    let policy = ClipPolicy { upload, day_bytes: 1 << 40, keep_s: 0, keep_bytes: 10 };
    store.set_clip_policy("ann", &policy).await.unwrap();
    let (one, two) = tokio::join!(store.expire_clips(), other.expire_clips());
    assert!(!one.unwrap() && !two.unwrap());
    let counts = other.clip_counts().await.unwrap();
    assert_eq!((counts.stored, counts.removed, counts.removed_bytes), (1, 1, 10));
}

#[tokio::test]
async fn a_part_that_comes_to_another_process_replaces_no_acknowledged_one() {
    let bucket = S3Bucket::of_test(&format!("http://{}", bucket::serve()), bucket::KEY);
    let folder = TempDir::new().unwrap();
    let files = ["one", "two"].map(|name| {
        let folder = folder.path().join(name);
        std::fs::create_dir(&folder).unwrap();
        let place = FilePlace::open(folder, Some(&bucket), "clips/").unwrap();
        Arc::new(ClipFiles::new(place, BOUNDS))
    });
    let id = "1@a".parse().unwrap();
    let append = async |files: &ClipFiles, content: &'static [u8]| {
        let sha256 = gleaner_trust::sha256(content);
        let length = content.len() as u64;
        let part = files.receive(&id, (length, sha256.as_str()), content.into()).await.unwrap();
        assert!(files.append(&id, (0, sha256.as_str()), part).await.unwrap());
        sha256.to_string()
    };
    let acknowledged = append(&files[0], b"content").await;
    append(&files[1], b"contend").await;
    let recording = FileOfClip::Recording(7, vec![acknowledged.clone()]);
    let content = files[1].content(&id, recording, 0).await.unwrap().unwrap();
    assert_eq!(axum::body::to_bytes(content, 100).await.unwrap(), "content");
    files[0].remove_recording(&id).await.unwrap();
    assert!(!files[1].has_recording(&id, &[acknowledged]).await.unwrap());
    assert_eq!(bucket.list("clips/").await.unwrap(), Vec::<String>::new(), "nor is any other left");
}

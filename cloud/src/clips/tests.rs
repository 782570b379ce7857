use std::sync::Arc;

use gleaner_fleet::clips::{ClipName, ClipPolicy, ClipReport, UploadedClips};
#[cfg(feature = "scaled")]
use gleaner_test_support::cloud::bucket;
use serde_json::{Value, json};
use tempfile::TempDir;

use super::ClipFiles;
use crate::error::CloudResult;
use crate::place::FilePlace;
use crate::scaled::S3Bucket;
use crate::store::{ClipBounds, ClipProgress, ClipQuery, CloudStore, StoredPart};

const MIB: u64 = 1 << 20;
const BOUNDS: ClipBounds = ClipBounds {
    clips: 3,
    vehicle_bytes: 100 * MIB,
    bytes: 150 * MIB,
    unfinished: 2,
    unfinished_s: 0,
};
const THUMBNAIL: u64 = 256 << 10;

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
    announce_as(store, vehicle, name, json!({ "bytes": bytes })).await;
}

/// Announces a clip with these facts beside the usual ones.
async fn announce_as(store: &CloudStore, vehicle: &str, name: &str, facts: Value) {
    let mut clip = json!({ "name": name, "from_ns": 1, "to_ns": 2, "bytes": 10,
                           "sha256": "0".repeat(64), "thumbnail": null, "lambdas": [],
                           "triggers": 0, "moments": [] });
    clip.as_object_mut().unwrap().extend(facts.as_object().unwrap().clone());
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
    for (vehicle, name, mib) in [("a", "1", 60), ("a", "2", 60), ("b", "1", 95)] {
        announce(&store, vehicle, name, mib * MIB).await;
    }
    assert_eq!(wanted(&store, "a").await, ["1", "2"]);
    let first = store.clip_progress("a", &name("1"), BOUNDS).await.unwrap();
    let second = store.clip_progress("a", &name("2"), BOUNDS).await.unwrap();
    store.clip_part_received(&first, (60 * MIB, "d"), true, BOUNDS).await.unwrap();
    // It was received at the same time.
    let full = store.clip_part_received(&second, (MIB, "d"), false, BOUNDS).await.unwrap_err();
    assert!(full.reason().contains("there is no room for clip `2`"), "{}", full.reason());
    assert!(wanted(&store, "a").await.is_empty(), "the second one does not fit any more");
    let full = store.clip_progress("a", &name("2"), BOUNDS).await.unwrap_err().reason();
    assert!(full.contains("of its vehicle have") && full.contains("of 104857600 bytes"), "{full}");
    let full = store.clip_progress("b", &name("1"), BOUNDS).await.unwrap_err().reason();
    assert!(full.contains("of all vehicles have"), "{full}");
    // What a failed upload has left counts until it is removed.
    announce(&store, "a", "3", 30 * MIB).await;
    let third = store.clip_progress("a", &name("3"), BOUNDS).await.unwrap();
    store.clip_part_received(&third, (20 * MIB, "d"), false, BOUNDS).await.unwrap();
    let before = disk(&store).await;
    assert!(store.clip_upload_failed(&third.id, "damaged").await.unwrap());
    assert_eq!(disk(&store).await, before - 10 * MIB);
    assert_eq!(store.removed_clips().await.unwrap(), std::slice::from_ref(&third.id));
    store.forget_removed_clip(&third.id).await.unwrap();
    assert_eq!(disk(&store).await, before - 30 * MIB);
}

/// Returns the bytes that all clips have on the disk.
async fn disk(store: &CloudStore) -> u64 {
    store.clip_counts().await.unwrap().disk_bytes
}

/// Announces a clip of a byte with a large thumbnail, and stores both, unless they do not fit.
async fn store_small(store: &CloudStore, name: &str, bounds: ClipBounds) -> CloudResult<()> {
    let facts = json!({ "bytes": 1, "thumbnail": "1".repeat(64) });
    announce_as(store, "a", name, facts).await;
    let progress = store.clip_progress("a", &self::name(name), bounds).await?;
    let file = format!("the thumbnail of `{name}`");
    store.must_fit("a", (&file, Some(THUMBNAIL)), bounds).await?;
    store.thumbnail_received(&progress.id, THUMBNAIL).await?;
    store.clip_part_received(&progress, (1, "d"), true, bounds).await
}

/// Four thumbnails and entries have more than 1 MiB, three have less.
#[tokio::test]
async fn small_clips_with_large_thumbnails_are_held_to_each_bound() {
    let (_folder, store) = store().await;
    let bounds = ClipBounds { clips: 1000, vehicle_bytes: MIB, ..BOUNDS };
    for number in 0..3 {
        store_small(&store, &number.to_string(), bounds).await.unwrap();
    }
    let full = store_small(&store, "3", bounds).await.unwrap_err().reason();
    assert!(full.contains("the thumbnail of `3`"), "{full}");
    let orders = store.clip_orders("a", bounds).await.unwrap();
    assert_eq!((orders.thumbnails.len(), orders.wanted.len()), (0, 1), "one byte has room");

    for number in 3..20 {
        store_small(&store, &number.to_string(), BOUNDS).await.unwrap();
    }
    let upload = UploadedClips::All;
    let policy = ClipPolicy { upload, day_bytes: 1 << 40, keep_s: 0, keep_bytes: MIB };
    store.set_clip_policy("ann", &policy).await.unwrap();
    while store.expire_clips().await.unwrap() {}
    for id in store.removed_clips().await.unwrap() {
        store.forget_removed_clip(&id).await.unwrap();
    }
    let left = disk(&store).await;
    assert!(left <= MIB, "{left}");
    assert_eq!(store.clip_counts().await.unwrap().stored, 3);
}

#[tokio::test]
async fn an_unreadable_clip_is_announced_with_its_cause_and_again_once_it_can_be_read() {
    let (_folder, store) = store().await;
    let unreadable = json!({ "sha256": null, "unreadable": "Input/output error" });
    announce_as(&store, "a", "1", unreadable.clone()).await;
    announce(&store, "a", "2", 10).await;
    let reason = async || {
        let clip = store.clip(&"1@a".parse().unwrap()).await.unwrap();
        (clip.state.as_str(), clip.reason.unwrap_or_default())
    };
    let cause = "the vehicle cannot read it: Input/output error";
    assert_eq!(reason().await, ("failed", cause.to_owned()));
    let orders = store.clip_orders("a", BOUNDS).await.unwrap();
    assert_eq!(orders.wanted.len(), 1);
    announce(&store, "a", "1", 10).await;
    assert_eq!(reason().await, ("wanted", String::new()));
    assert_eq!(wanted(&store, "a").await, ["1", "2"]);
    // A bad block appears while it is sent; then the vehicle deletes it.
    let progress = store.clip_progress("a", &name("1"), BOUNDS).await.unwrap();
    store.clip_part_received(&progress, (5, "d"), false, BOUNDS).await.unwrap();
    announce_as(&store, "a", "1", unreadable).await;
    assert_eq!(reason().await, ("failed", cause.to_owned()));
    announce_as(&store, "a", "1", json!({ "bytes": 11 })).await;
    let removed = store.removed_clips().await.unwrap();
    assert_eq!(removed, [progress.id], "its first bytes are of another file");
    announce_as(&store, "a", "1", json!({ "sha256": null })).await;
    assert_eq!(reason().await.0, "gone");
}

#[tokio::test]
async fn unfinished_files_are_bounded_and_forgotten_after_a_time() {
    let (_folder, store) = store().await;
    for name in ["1", "2", "3"] {
        announce(&store, "a", name, 10).await;
    }
    for name in ["1", "2"] {
        let begun = store.clip_progress("a", &self::name(name), BOUNDS).await.unwrap();
        store.clip_part_received(&begun, (8, "d"), false, BOUNDS).await.unwrap();
    }
    assert_eq!(wanted(&store, "a").await, ["1", "2"], "no other one is begun");
    let unreadable = json!({ "sha256": null, "unreadable": "Input/output error" });
    announce_as(&store, "a", "1", unreadable).await;
    assert_eq!(wanted(&store, "a").await, ["2"], "one that cannot be read is unfinished, too");
    let busy = store.clip_progress("a", &name("3"), BOUNDS).await.unwrap_err().reason();
    assert!(busy.contains("2 uploads of the vehicle are unfinished"), "{busy}");
    let orders = store.clip_orders("a", BOUNDS).await.unwrap();
    assert_eq!(orders.unreadable, [name("1")], "the vehicle reads it again");
    store.forget_unfinished_clips(3600).await.unwrap();
    assert_eq!(store.removed_clips().await.unwrap(), [], "they are still young");
    store.execute("UPDATE clips SET part_time = part_time - 600").await;
    store.forget_unfinished_clips(3600).await.unwrap();
    assert_eq!(store.removed_clips().await.unwrap(), ["1@a".parse().unwrap()]);
    assert_eq!(wanted(&store, "a").await, ["2", "3"], "there is room for another one");
}

#[tokio::test]
async fn the_oldest_clips_without_files_are_forgotten_above_the_bound() {
    let (_folder, store) = store().await;
    announce(&store, "a", "0", 10).await;
    let stored = store.clip_progress("a", &name("0"), BOUNDS).await.unwrap();
    store.clip_part_received(&stored, (10, "d"), true, BOUNDS).await.unwrap();
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
            store.clip_part_received(&progress, (10, "d"), true, BOUNDS).await.unwrap();
        }
    }
    let names = async || {
        let page = store.clips(&ClipQuery::default()).await.unwrap();
        page.items.iter().map(|clip| clip.facts.name.to_string()).collect::<Vec<_>>()
    };
    let id = |name: &str| format!("{name}@a").parse().unwrap();
    let all = disk(&store).await;
    let entry = (all - 30) / 4;
    store.remove_clip("ann", &id("1")).await.unwrap();
    assert_eq!(disk(&store).await, all, "its files are still there");
    assert!(store.remove_clip("ann", &id("1")).await.is_err(), "it is removed already");
    let refused = store.remove_clip("ann", &id("4")).await.unwrap_err().reason();
    assert!(refused.contains("is not in the cloud"), "{refused}");
    assert_eq!(names().await, ["4", "3", "2"]);
    // Its files are removed later, also after a kill.
    assert_eq!(store.removed_clips().await.unwrap(), [id("1")]);
    let removed = store.removed_clip(id("1")).await.unwrap();
    assert!(!removed.has_file && !removed.has_thumbnail);
    store.forget_removed_clip(&id("1")).await.unwrap();
    assert_eq!(disk(&store).await, all - entry - 10);

    let keep = async |keep_s, keep_bytes| {
        let upload = UploadedClips::All;
        let policy = ClipPolicy { upload, day_bytes: 1 << 40, keep_s, keep_bytes };
        store.set_clip_policy("ann", &policy).await.unwrap();
        while store.expire_clips().await.unwrap() {}
    };
    keep(3600, 2 * (entry + 10)).await;
    assert_eq!(names().await, ["4", "3", "2"], "they are young and few");
    keep(0, entry + 10).await;
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
        store.clip_part_received(&progress, (10, "d"), true, BOUNDS).await.unwrap();
        // The same file was on its way to the other one, where it was damaged.
        assert!(!other.clip_upload_failed(&progress.id, "damaged").await.unwrap());
        assert!(other.removed_clip(progress.id).await.unwrap().has_file);
    }
    let upload = UploadedClips::All;
    let keep_bytes = disk(&store).await / 2;
    let policy = ClipPolicy { upload, day_bytes: 1 << 40, keep_s: 0, keep_bytes };
    store.set_clip_policy("ann", &policy).await.unwrap();
    let (one, two) = tokio::join!(store.expire_clips(), other.expire_clips());
    assert!(!one.unwrap() && !two.unwrap());
    let counts = other.clip_counts().await.unwrap();
    assert_eq!((counts.stored, counts.removed, counts.removed_bytes), (1, 1, 10));
}

fn files(folder: &TempDir, name: &str, bucket: Option<&S3Bucket>) -> Arc<ClipFiles> {
    let folder = folder.path().join(name);
    std::fs::create_dir(&folder).unwrap();
    Arc::new(ClipFiles::new(FilePlace::open(folder, bucket, "clips/").unwrap(), BOUNDS))
}

/// Appends a part of a clip of 7 bytes after these parts, and returns it.
async fn append(files: &ClipFiles, parts: &[StoredPart], content: &'static str) -> StoredPart {
    let (id, received) = ("1@a".parse().unwrap(), parts.iter().map(|it| it.bytes).sum());
    let part = parts.len() as u64;
    let progress = ClipProgress { id, bytes: 7, sha256: String::new(), part, received };
    let piece = files.receive(&progress.id, 7, content.into()).await.unwrap();
    let stored = StoredPart { sha256: piece.sha256.clone(), bytes: piece.bytes };
    assert!(files.append(&progress, piece).await.unwrap());
    stored
}

#[cfg(feature = "scaled")]
#[tokio::test]
async fn a_part_that_comes_to_another_process_replaces_no_acknowledged_one() {
    let bucket = S3Bucket::of_test(&format!("http://{}", bucket::serve()), bucket::KEY);
    let folder = TempDir::new().unwrap();
    let files = ["one", "two"].map(|name| self::files(&folder, name, Some(&bucket)));
    let id = "1@a".parse().unwrap();
    let mut parts = vec![append(&files[0], &[], "con").await];
    append(&files[1], &[], "com").await;
    parts.push(append(&files[1], &parts, "tent").await);
    for begin in 0..7 {
        let recording = super::FileOfClip::Recording(7, parts.clone());
        let content = files[1].content(&id, recording, begin).await.unwrap().unwrap();
        let rest = axum::body::to_bytes(content, 100).await.unwrap();
        assert_eq!(rest, "content"[begin as usize..]);
    }
    files[0].remove_recording(&id).await.unwrap();
    assert!(!files[1].has_recording(&id, &parts).await.unwrap());
    assert_eq!(bucket.list("clips/").await.unwrap(), Vec::<String>::new(), "nor is any other left");
}

#[tokio::test]
async fn a_part_that_a_kill_kept_from_the_database_comes_again() {
    let folder = TempDir::new().unwrap();
    let files = files(&folder, "one", None);
    let first = append(&files, &[], "con").await;
    append(&files, std::slice::from_ref(&first), "tented").await;
    append(&files, &[first], "tent").await;
    let announced = (7, gleaner_trust::sha256(b"content").to_string());
    let compared = files.compare(&"1@a".parse().unwrap(), announced, Vec::new()).await.unwrap();
    assert_eq!(compared, Ok(()));
}

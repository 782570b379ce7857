use super::*;
use crate::folder::PART;
use crate::place::FilePlace;
use crate::records::{ChunkFiles, chunk};

#[tokio::test]
async fn a_chunk_that_was_interrupted_leaves_a_file_that_is_removed() {
    let recorded = Recorded::start().await;
    recorded.append("events", 0..100).await;
    let expected = recorded.all(STREAMS).await;
    let (store, of) = (&recorded.cloud.store, (CAR, "events"));
    let lines = store.oldest_lines(of, SIZES).await.unwrap();
    let (made, file) = chunk::encode(of, &lines).unwrap();
    store.note_chunk_file(&made.sha256).await.unwrap();
    recorded.cloud.chunks.keep(&made.sha256, file).await.unwrap();
    // Killed here: the records are still in rows.
    assert_eq!(recorded.all(STREAMS).await, expected);
    remove_old(&recorded.cloud, 3600).await.unwrap();
    assert_eq!(recorded.files().len(), 1, "it may still be made");
    remove_old(&recorded.cloud, 0).await.unwrap();
    assert_eq!(recorded.files().len(), 0);
    // One that was only stopped goes on now.
    assert!(!store.pack(of, &made).await.unwrap(), "its file is not there any more");
    assert_eq!(recorded.all(STREAMS).await, expected);
}

#[tokio::test]
async fn a_chunk_of_which_only_a_note_or_a_part_was_written_is_forgotten() {
    let recorded = Recorded::start().await;
    recorded.append("events", 0..100).await;
    let expected = recorded.all(STREAMS).await;
    let store = &recorded.cloud.store;
    store.note_chunk_file(&"0".repeat(64)).await.unwrap();
    let folder = recorded.folder.path().join("data/records");
    std::fs::write(folder.join(format!("{}.7.{PART}", "0".repeat(64))), "half").unwrap();
    // The next process opens the folder.
    ChunkFiles::new(FilePlace::open(folder, None, "").unwrap());
    assert_eq!(recorded.files().len(), 0);
    remove_old(&recorded.cloud, 0).await.unwrap();
    assert!(store.unneeded_chunk_files(0).await.unwrap().is_empty());
    assert!(pack(&recorded.cloud, SIZES).await.unwrap() > 5);
    assert_eq!(recorded.all(STREAMS).await, expected);
}

#[tokio::test]
async fn a_removal_that_was_interrupted_is_counted_once_and_goes_on() {
    let recorded = Recorded::start().await;
    recorded.append("events", 0..100).await;
    pack(&recorded.cloud, SIZES).await.unwrap();
    let (cloud, store) = (&recorded.cloud, &recorded.cloud.store);
    store.note_arrivals_on(now() / 86_400 - 40).await.unwrap();
    recorded.append("events", 100..103).await;
    let (left, files) = (recorded.all(STREAMS).await.split_off(100), recorded.files().len());
    assert!(files > 5);
    assert!(!store.expire_records(30).await.unwrap());
    // Killed here: entries and rows are gone, and the files are there.
    assert_eq!((recorded.all(STREAMS).await, recorded.files().len()), (left.clone(), files));
    // The next process is killed between the removal of a file and that of its note.
    let unneeded = store.unneeded_chunk_files(3600).await.unwrap();
    assert_eq!(unneeded.len(), files);
    cloud.chunks.remove(&unneeded[0]).await.unwrap();
    for _ in 0..2 {
        remove_old(cloud, 3600).await.unwrap();
        assert_eq!((recorded.all(STREAMS).await, recorded.files().len()), (left.clone(), 0));
        let gaps = store.removed(CAR, STREAMS, 0).await.unwrap();
        let gap: StreamLine = serde_json::from_str(&gaps[0]).unwrap();
        assert_eq!((gaps.len(), &gap.record["records"]), (1, &json!(100)));
    }
    assert!(store.unneeded_chunk_files(3600).await.unwrap().is_empty());
}

#[tokio::test]
async fn a_stream_that_cannot_be_packed_keeps_no_other_one_from_it() {
    let recorded = Recorded::start().await;
    recorded.append("events", 0..100).await;
    recorded.append(BRAKE, 0..50).await;
    let (events, brake) = (recorded.all(STREAMS).await, recorded.all([BRAKE; 2]).await);
    // Whatever chunk of the longer stream is made, the index has another one at its place.
    let obstacle = "INSERT INTO chunks (vehicle, stream, first_arrival, last_arrival, first_seq,
                    last_seq, first_time, last_time, level, records, bytes, stored_bytes, sha256)
                    SELECT vehicle, stream, arrival, arrival, seq, seq, 0, 0, 0, 1, 1, 1, 'none'
                    FROM records WHERE stream = 'events'";
    let (cloud, store) = (&recorded.cloud, &recorded.cloud.store);
    store.execute(obstacle).await;
    let made = pack(cloud, SIZES).await.unwrap();
    assert!(made > 2, "{made} chunks of the other stream");
    assert_eq!(recorded.all([BRAKE; 2]).await, brake);
    store.execute("DELETE FROM chunks WHERE sha256 = 'none'").await;
    assert_eq!(recorded.all(STREAMS).await, events);
    assert!(pack(cloud, SIZES).await.unwrap() > made);
    assert_eq!(recorded.all(STREAMS).await, events);
    // The failure has left a file that no chunk has.
    remove_old(cloud, 0).await.unwrap();
    let chunks: usize = recorded.files().len();
    assert!(pack(cloud, SIZES).await.unwrap() == 0 && chunks > 7);
    assert_eq!(recorded.all([BRAKE; 2]).await, brake);
}

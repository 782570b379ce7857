use std::time::Duration;

use tokio::time::timeout;

use super::*;
use crate::records::search::SEARCHES;

#[tokio::test]
async fn damage_of_a_single_long_record_is_shown_whatever_is_searched() {
    let recorded = Recorded::start().await;
    recorded.append_long(BRAKE, 0, 4000).await;
    assert_eq!(pack(&recorded.cloud, SIZES).await.unwrap(), 1, "it is a chunk of its own");
    assert_eq!(recorded.all([BRAKE; 2]).await.len(), 1);
    std::fs::write(&recorded.files()[0], "another").unwrap();
    for query in ["text=no such text", "kind=decision", "lambda=brake"] {
        let found = recorded.found_lines(search(query)).await;
        assert_eq!(found.len(), 1, "{query}");
        assert_eq!((&*found[0].kind, found[0].seq), ("damaged", 0), "{query}");
    }
    let lines = recorded.all([BRAKE; 2]).await;
    assert!(lines.len() == 1 && lines[0].contains("its bytes were changed"), "{lines:?}");
    assert_eq!(recorded.back([BRAKE; 2], 1).await, lines);
}

#[tokio::test]
async fn a_record_that_is_too_long_to_search_is_found_by_its_length() {
    let recorded = Recorded::start().await;
    recorded.append(BRAKE, 0..3).await;
    recorded.append_long(BRAKE, 3, 256 << 10).await;
    recorded.append(BRAKE, 4..6).await;
    for is_packed in [false, true] {
        if is_packed {
            assert!(pack(&recorded.cloud, SIZES).await.unwrap() > 0);
        }
        for (query, seqs) in [
            ("text=wheel", vec![5, 4, 0, 2, 1, 0]),
            ("text=wheel&limit=1", vec![5, 4, 0, 2, 1, 0]),
            ("text=no such text", vec![0]),
        ] {
            let found = recorded.found_lines(search(query)).await;
            assert_eq!(found.iter().map(|it| it.seq).collect::<Vec<_>>(), seqs, "{query}");
            let long = found.iter().find(|it| it.kind == "large").unwrap();
            let text = long.record["text"].as_str().unwrap();
            assert!(text.contains("a record of 262") && text.len() < 200, "{text}");
        }
    }
}

#[tokio::test]
async fn a_third_search_waits_until_one_of_two_has_ended() {
    let recorded = Recorded::start().await;
    recorded.append("events", 0..3).await;
    let turns = SEARCHES.acquire_many(2).await.unwrap();
    let third = recorded.found(search("text=wheel"));
    tokio::pin!(third);
    assert!(timeout(Duration::from_millis(100), third.as_mut()).await.is_err());
    drop(turns);
    assert_eq!(third.await, [2, 1, 0]);
}

use super::*;

#[tokio::test]
async fn a_clock_that_is_set_removes_nothing_and_ages_are_measured() {
    let (_folder, store) = store().await;
    let epoch = connected(&store, "car-7").await;
    let (wall, start) = (now(), store.age_now());
    // At noon of the next day, so that no day ends between the looks.
    let noon = DAY_S - start % DAY_S + DAY_S / 2;
    let look = async |up_s, wall| {
        let clock = store.count_age_at(noon + up_s, noon + wall).await.unwrap();
        store.note_arrivals().await.unwrap();
        assert!(!store.expire_records(30).await.unwrap());
        clock - start - noon
    };
    store.append("car-7", epoch, batch(1, 0..2), KEPT).await.unwrap();
    look(60, wall + 60).await;
    store.append("car-7", epoch, batch(1, 2..4), KEPT).await.unwrap();
    let clip = "INSERT INTO clips (seq, vehicle, name, facts, from_ns, to_ns, bytes, sha256,
                thumbnail, score, state, part_time) VALUES
                (1, 'car-7', 'a', '', 0, 0, 1, '', '', 0, 'stored', CAST($1 AS BIGINT))";
    store.execute_with(clip, &[&wall.to_string()]).await;
    store.execute("UPDATE clip_policy SET keep_s = 2592000").await;
    // 33 days ahead, decades behind, and right again.
    for (up_s, wall) in [(120, wall + 33 * DAY_S), (180, 0), (240, wall + 400 * DAY_S)] {
        assert!(look(up_s, wall).await <= up_s + 1);
        assert!(!store.expire_clips().await.unwrap());
    }
    assert!(look(300, wall + 300).await <= 301);
    assert_eq!(rows(&store, "car-7").await.len(), 4);
    // The notes go on, and a month that was measured makes records and clips too old.
    look(300 + DAY_S, wall + DAY_S).await;
    store.append("car-7", epoch, batch(1, 4..5), KEPT).await.unwrap();
    assert!(look(300 + 31 * DAY_S, wall).await >= 31 * DAY_S);
    store.expire_clips().await.unwrap();
    assert_eq!(rows(&store, "car-7").await, ["line 2", "line 3", "line 4"]);
    assert_eq!(store.clip_counts().await.unwrap().stored, 0);
}

#[tokio::test]
async fn the_time_without_a_process_counts_for_three_days_and_once() {
    let (folder, store) = store().await;
    let wall = now();
    let clock = store.count_age_at(200, wall).await.unwrap();
    let start = async || CloudStore::open(&address(&folder).await).await.unwrap();
    let (one, other, month) = (start().await, start().await, wall + 30 * DAY_S);
    // It only looks at first: a process that ends soon, again and again, changes nothing.
    for up_s in [60, 120] {
        assert!(one.count_age_at(up_s, month).await.unwrap() <= clock + up_s + 1);
    }
    let after = one.count_age_at(160, month).await.unwrap();
    assert!((after - clock - 160 - 3 * DAY_S).abs() < 9, "{after} {clock}");
    // The other one finds that one counts, and does not count the time again.
    assert_eq!(other.count_age_at(160, wall + 400 * DAY_S).await.unwrap(), after);
    assert_eq!(one.count_age_at(170, month).await.unwrap(), after + 10);
    // A clock that is behind takes nothing back.
    let next = start().await;
    assert!(next.count_age_at(160, 0).await.unwrap() >= after);
}

#[tokio::test]
async fn the_notes_of_a_clock_that_was_ahead_are_dropped() {
    let (folder, store) = store().await;
    let day = now() / DAY_S;
    let epoch = connected(&store, "car-7").await;
    store.append("car-7", epoch, batch(1, 0..2), KEPT).await.unwrap();
    store.note_arrivals_on(day + 33).await.unwrap();
    // As an earlier version has left it.
    store.execute("DELETE FROM age_clock").await;
    let store = CloudStore::open(&address(&folder).await).await.unwrap();
    store.note_arrivals().await.unwrap();
    store.count_age_at(32 * DAY_S, now()).await.unwrap();
    assert!(!store.expire_records(30).await.unwrap());
    assert!(rows(&store, "car-7").await.is_empty(), "they are noted and removed in time");
}

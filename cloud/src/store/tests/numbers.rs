use super::super::links::DeploymentState;
use super::NUMBER_MAX as MAX;
use super::*;

fn renamed(batch: StreamBatch, line: &str) -> StreamBatch {
    let lines = batch.lines.into_iter().map(|(seq, mark, _)| (seq, mark, format!("{line} {seq}")));
    StreamBatch { lines: lines.collect(), cursor: batch.cursor }
}

#[tokio::test]
async fn a_number_that_the_database_cannot_hold_is_refused_by_its_name() {
    let (_folder, store) = store().await;
    let epoch = connected(&store, "car-7").await;
    let append = async |life, next| {
        let mut batch = batch(1, 0..1);
        (batch.cursor.life, batch.cursor.next) = (life, next);
        store.append("car-7", epoch, batch, KEPT).await.map_err(|error| error.reason())
    };
    for large in [MAX + 1, i64::MAX as u64, i64::MAX as u64 + 1, u64::MAX] {
        let largest = format!("cannot be {large}: the largest number is {MAX}");
        let refused = append(large, 1).await.unwrap_err();
        assert_eq!(refused, format!("`life` of stream `events` {largest}"));
        let refused = append(1, large).await.unwrap_err();
        assert_eq!(refused, format!("`next` of a batch of records {largest}"));
        let report = report(json!({}), json!([]));
        let handled = VehicleReport { handled: large, ..report.clone() };
        let state = DeploymentState { release: large, state: "running", ..Default::default() };
        let states = [(("a".to_owned(), String::new()), state)].into();
        let release = VehicleReport { states, ..report };
        for (report, name) in [(handled, "applied desired state"), (release, "release of `a`")] {
            let refused = store.report("car-7", epoch, report).await.unwrap_err().reason();
            assert!(refused.contains(&format!("{name} cannot be {large}")), "{refused}");
        }
    }
    assert!(append(1, 0).await.is_err() && lines(&store).await.is_empty());
    assert_eq!(append(MAX, MAX).await.unwrap().next, MAX);
    // The next life is always possible.
    assert_eq!(append(MAX + 1, 1).await.unwrap().life, MAX + 1);
    assert!(append(MAX + 3, 1).await.is_err());
}

#[tokio::test]
async fn a_vehicle_that_is_enrolled_after_a_revocation_begins_new_streams() {
    let (_folder, store) = store().await;
    let thief = connected(&store, "car-7").await;
    let of_thief = renamed(batch(MAX, 0..51), "thief");
    assert_eq!(store.append("car-7", thief, of_thief, KEPT).await.unwrap().next, 51);
    store.execute("INSERT INTO clip_vehicles (vehicle, position) VALUES ('car-7', 'z')").await;
    let cursor = async |certificate: &str| {
        enrolled(&store, "car-7", certificate).await;
        let (epoch, mut all) =
            store.connect("car-7", certificate, &Hello::default()).await.unwrap();
        (epoch, all.remove(0))
    };
    let again = cursor("again").await.1;
    assert_eq!((again.life, again.next), (MAX, 51), "without a revocation, nothing begins");
    store.revoke("ann", "car-7").await.unwrap();
    let (epoch, new) = cursor("new").await;
    let expected = Cursor { stream: "events".to_owned(), life: MAX + 1, ..Cursor::default() };
    assert_eq!(new, expected);
    let ack = store.append("car-7", epoch, batch(new.life, 0..10), KEPT).await.unwrap();
    assert_eq!((ack.life, ack.next), (MAX + 1, 10));
    let stored = rows(&store, "car-7").await;
    assert_eq!(stored.len(), 61, "what is acknowledged is stored, and the thief's stay");
    assert_eq!(stored[60], "line 9");
    let orders = store.clip_orders("car-7", ClipBounds::DEFAULT).await.unwrap();
    assert_eq!(orders.cursor, None, "it announces all its clips");
    assert!(store.append("car-7", epoch, batch(MAX, 51..52), KEPT).await.is_err());
}

#[tokio::test]
async fn a_record_that_is_not_inserted_is_not_acknowledged() {
    let (_folder, store) = store().await;
    let (epoch, other) = (connected(&store, "car-7").await, connected(&store, "car-8").await);
    store.append("car-7", epoch, batch(1, 0..3), KEPT).await.unwrap();
    // The position was lost, and the records were not.
    store.execute("UPDATE streams SET next = 0").await;
    let (refused, stored) = tokio::join!(
        store.append("car-7", epoch, renamed(batch(1, 2..4), "other"), KEPT),
        store.append("car-8", other, batch(1, 0..3), KEPT),
    );
    let refused = refused.unwrap_err().reason();
    assert_eq!(refused, "a record has the number of another one that is stored");
    assert_eq!((lines(&store).await.len(), stored.unwrap().next), (3, 3));
}

//! Checks that a ring gives the answers of `rules/cases`, without a lock.

use std::collections::BTreeMap;
use std::ops::ControlFlow;

use gleaner_buffers::{HeapRegion, Pool, RingCounts, ring};
use serde_json::{Value, json};

#[test]
fn a_ring_answers_as_in_the_cases_of_the_rules() {
    let cases: Vec<Value> =
        serde_json::from_str(include_str!("../../../../rules/cases/ring.json")).unwrap();
    for case in &cases {
        let [depth, hold, max_size] =
            ["depth", "hold", "max_size"].map(|key| case["given"][key].as_u64().unwrap() as usize);
        let slots = depth + hold + 1;
        let region =
            HeapRegion::zeroed(Pool::<i64>::bytes_needed(slots, max_size).unwrap()).unwrap();
        let (mut writer, reader) =
            ring(Pool::new(region, slots, max_size).unwrap(), depth).unwrap();
        let (mut held, mut found) = (BTreeMap::new(), Vec::new());
        for (n, call) in case["calls"].as_array().unwrap().iter().enumerate() {
            let given = call[1].as_u64().unwrap_or_default();
            let answer = match call[0].as_str().unwrap() {
                "push" => {
                    if let Ok(draft) = writer.draft(given as usize) {
                        // A sample's time is its position.
                        writer.publish(draft, reader.head() as i64).unwrap();
                    }
                    Value::Null
                }
                "hold" => json!(reader.get(given).map(|lease| held.insert(given, lease)).is_some()),
                "let go" => {
                    held.remove(&given);
                    Value::Null
                }
                "counts" => {
                    let RingCounts { received, overwritten, no_slot, too_big } = reader.counts();
                    json!([received, overwritten, no_slot, too_big])
                }
                asked => {
                    let since = if asked == "since" { call[1].as_i64().unwrap() } else { i64::MIN };
                    let most = if asked == "since" { 99 } else { given as usize };
                    reader.newest_while(most, |at_ns| *at_ns > since, &mut found);
                    let mut seen = Vec::new();
                    let is_since = |at_ns: &i64| *at_ns > since;
                    reader.visit_while_before(u64::MAX, most, is_since, |position, _, _| {
                        seen.insert(0, Some(position));
                        ControlFlow::Continue(())
                    });
                    let found: Vec<_> = found.drain(..).map(|lease| lease.position()).collect();
                    assert_eq!(seen, found, "{}: call {n}, {call}", case["name"]);
                    json!(found)
                }
            };
            let wanted = call.as_array().unwrap().last().unwrap();
            assert_eq!(&answer, wanted, "{}: call {n}, {call}", case["name"]);
        }
    }
}

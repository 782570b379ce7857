//! Rings of the fake host: depth, held samples and counts.

use gleaner_sdk::testing::Message;
use gleaner_sdk::{Error, input};

use super::lambda::{Handler, imu, load, on_event};

fn x(value: f64) -> Message {
    Message::new().with("x", value)
}

#[test]
fn a_lambda_reads_at_most_depth_samples_oldest_first() {
    let mut run = on_event(imu("depth = 3", ""), |sample| {
        let imu = input("imu")?;
        let x = imu.field("x")?;
        let column = imu.column(&x, 100)?;
        let seq = sample.identity().seq;
        let first = seq.saturating_sub(2).max(1);
        assert_eq!(column.values, (first..=seq).map(|n| n as f64).collect::<Vec<_>>());
        assert_eq!(column.at_ns, (first..=seq).map(|n| 10 * n as i64).collect::<Vec<_>>());
        assert_eq!(imu.column(&x, 1)?.values, [seq as f64]);
        assert_eq!(imu.column_since(&x, 10 * seq as i64 - 10)?.values, [seq as f64]);
        assert_eq!(imu.last(2).map(|sample| sample.identity().seq).next_back(), Some(seq));
        assert_eq!(imu.since(0).len(), column.len());
        assert_eq!(imu.newest().unwrap().number(&x)?, seq as f64);
        Ok(())
    });
    for n in 1..=5 {
        run.deliver("imu", 10 * n, x(n as f64)).unwrap();
    }
    assert_eq!((run.decisions().len(), run.faults().next()), (5, None));
    let counts = run.counts("imu").unwrap();
    assert_eq!((counts.received, counts.overwritten, counts.lost), (5, 2, None));
}

#[test]
fn held_samples_stay_and_new_ones_are_refused_if_no_cell_is_free() {
    // There are 2 + 1 + 1 cells: once the lambda holds four, the ring refuses samples, so none
    // wakes the lambda.
    let mut run = load(imu("depth = 2\nhold = 1", ""), |_| {
        let mut held = Vec::new();
        Ok(Handler::Event(Box::new(move |sample| {
            held.push(sample);
            let seqs = held.iter().map(|sample| sample.identity().seq);
            assert!(seqs.eq(1..=held.len() as u64));
            Ok(())
        })))
    });
    let run = run.as_mut().unwrap();
    for n in 0..10 {
        run.deliver("imu", n, x(0.0)).unwrap();
    }
    let counts = run.counts("imu").unwrap();
    assert_eq!((run.decisions().len(), counts.received, counts.no_slot), (4, 4, 6));
    assert_eq!(run.faults().next(), None);
}

#[test]
fn a_fault_releases_the_samples_that_the_lambda_held() {
    let mut run = load(imu("depth = 2\nhold = 1", ""), |_| {
        let mut held = Vec::new();
        Ok(Handler::Event(Box::new(move |sample| {
            held.push(sample);
            if held.len() == 4 { Err(Error::new("full")) } else { Ok(()) }
        })))
    });
    let run = run.as_mut().unwrap();
    for n in 0..12 {
        run.deliver("imu", n, x(0.0)).unwrap();
    }
    assert_eq!((run.faults().count(), run.counts("imu").unwrap().no_slot), (3, 0));
}

#[test]
fn a_message_that_is_too_large_is_counted_and_wakes_no_lambda() {
    let mut run = on_event(imu("max_size = \"8 B\"", ""), |_| Ok(()));
    assert!(run.deliver("imu", 1, Message::new().cdr(vec![0; 4 + 9])).unwrap().is_empty());
    assert!(
        run.deliver("imu", 2, Message::new().with("name", "more than eight")).unwrap().is_empty()
    );
    assert_eq!(run.deliver("imu", 3, Message::new().cdr(vec![0; 4 + 8])).unwrap().len(), 1);
    assert_eq!(run.counts("imu").unwrap().too_big, 2);
}

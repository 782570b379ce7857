//! Triggers at the configured times, so that the windows are known.

use gleaner_sdk::{Config, Error, Lambda, Result, Sample, event, now_ns, start, stop};

struct Alarm {
    first_ns: Option<i64>,
    events: Vec<i64>,
    starts: Vec<i64>,
    stops: Vec<i64>,
}

impl Lambda for Alarm {
    fn init(config: &Config) -> Result<Self> {
        let times = |key: &str| times(config.text(key)?);
        Ok(Self {
            first_ns: None,
            events: times("event_s")?,
            starts: times("start_s")?,
            stops: times("stop_s")?,
        })
    }

    fn on_event(&mut self, _sample: Sample) -> Result<()> {
        let first = *self.first_ns.get_or_insert(now_ns());
        let passed = now_ns() - first;
        if due(&mut self.events, passed) {
            event("alarm", passed as f64 / 1e9).send()?;
        }
        if due(&mut self.starts, passed) {
            start("alarm").send()?;
        }
        if due(&mut self.stops, passed) {
            stop("alarm")?;
        }
        Ok(())
    }
}

/// Parses times into ns, sorted with the earliest last.
fn times(text: &str) -> Result<Vec<i64>> {
    let seconds =
        text.split(',').filter(|part| !part.is_empty()).map(|part| part.trim().parse::<f64>());
    let times = seconds.map(|second| second.map(|second| (second * 1e9) as i64));
    let mut times: Vec<_> = times
        .collect::<core::result::Result<_, _>>()
        .map_err(|error| Error::new(error.to_string()))?;
    times.sort_by_key(|time| std::cmp::Reverse(*time));
    Ok(times)
}

/// Returns whether the next of `times` is due, and removes it then.
fn due(times: &mut Vec<i64>, passed: i64) -> bool {
    let is_due = times.last().is_some_and(|time| passed >= *time);
    if is_due {
        times.pop();
    }
    is_due
}

gleaner_sdk::lambda!(Alarm);

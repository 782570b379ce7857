//! Completes `summary.json` of a lambda with the counts of ingress, recorder and earlier processes.
//!
//! Each process counts only its own events, and `gleaner-shim` writes only those of one process.

use std::path::Path;
use std::time::Instant;

use gleaner_base::{Exit, Failure, PlainFile, write_atomically};
use gleaner_lambda::results::SUMMARY_MAX;
use gleaner_protocol::ingress::IngressStatus;
use gleaner_protocol::link::RecorderStatus;
use gleaner_protocol::{LiveStatus, NetworkStatus};

use crate::recent_wakes::RecentWakes;

/// Sums of the counts of all ingresses and all recorders of a run.
#[derive(Default)]
pub(crate) struct RunCounts {
    network: Option<NetworkStatus>,
    /// True if this is the sum of several ingresses.
    has_several_ingresses: bool,
    recorder: Option<Box<RecorderStatus>>,
}

impl RunCounts {
    /// Adds the last statuses of an ingress and of a recorder.
    pub(crate) fn add(
        &mut self,
        ingress: Option<Box<IngressStatus>>,
        recorder: Option<Box<RecorderStatus>>,
    ) {
        let network = ingress.and_then(|ingress| ingress.health.network);
        self.has_several_ingresses |= network.is_some() && self.network.is_some();
        self.network = match (network, self.network.take()) {
            (Some(last), Some(before)) => Some(NetworkStatus {
                socket_drops: last.socket_drops.saturating_add(before.socket_drops),
                filtered: last.filtered.saturating_add(before.filtered),
                ..last
            }),
            (last, before) => last.or(before),
        };
        self.recorder = match (recorder, self.recorder.take()) {
            (Some(last), Some(before)) => Some(Box::new(last.after(&before))),
            (last, before) => last.or(before),
        };
    }

    /// Returns whether the summary that a process of a lambda has written lacks some of these.
    fn has_more(&self) -> bool {
        self.recorder.is_some() || self.has_several_ingresses
    }

    /// Returns the counts of the recorder for a summary. The network is counted once, with the
    /// lambda, and warnings about a thousand topics could exceed the maximum size of a summary.
    fn recorder(&self) -> Option<Box<RecorderStatus>> {
        let mut recorder = self.recorder.clone()?;
        recorder.network = None;
        recorder.topics.iter_mut().for_each(|topic| topic.qos_warnings.clear());
        Some(recorder)
    }
}

/// Sum of the counts of ended processes of a lambda.
#[derive(Default)]
pub(crate) struct EarlierCounts {
    live: Option<LiveStatus>,
    /// Those of the last minutes, with the current process.
    pub(crate) recent: RecentWakes,
    /// Wakes during which their process ended, so that it did not count them.
    lost_wakes: u64,
}

impl EarlierCounts {
    /// Notes the counts of the current process, `last`.
    pub(crate) fn observe(&mut self, last: &LiveStatus) {
        if let Some(all) = self.with(Some(last)) {
            self.recent.add(all.wake_counts(), Instant::now());
        }
    }

    /// Adds the last status of an ended process. If it failed, up to a second of counts is missing.
    pub(crate) fn add(&mut self, last: Option<LiveStatus>, has_lost_wake: bool) {
        self.lost_wakes += u64::from(has_lost_wake);
        self.live = match (last, self.live.take()) {
            (Some(last), Some(before)) => Some(last.after(&before)),
            (last, before) => last.or(before),
        };
    }

    /// Returns the counts with those of the current process, `last`.
    pub(crate) fn with(&self, last: Option<&LiveStatus>) -> Option<LiveStatus> {
        match (last, &self.live) {
            (Some(last), Some(before)) => Some(last.clone().after(before)),
            (last, before) => last.or(before.as_ref()).cloned(),
        }
    }

    /// Adds the last process and writes the sum. Writes nothing if there are only counts of one
    /// successful lambda process, which the shim has written.
    pub(crate) fn complete(
        self,
        last: Option<LiveStatus>,
        counts: &RunCounts,
        out: &Path,
    ) -> Result<(), Failure> {
        let Self { live, lost_wakes, .. } = self;
        let recording = counts.recorder();
        // Not the path in the report, which comes from the lambda's process.
        let path = out.join("summary.json");
        let last =
            last.map(|last| LiveStatus { unwritten: last.unwritten.max(unwritten(&path)), ..last });
        let sum = match (last, live) {
            (Some(last), Some(before)) => last.after(&before),
            (None, Some(before)) => before,
            (Some(last), None) if lost_wakes > 0 || counts.has_more() => last,
            _ => return Ok(()),
        };
        let sum = LiveStatus {
            faults: sum.faults.saturating_add(lost_wakes),
            // Each process reports the counts of the ingress since the start of the ingress.
            network: counts.network.clone().unwrap_or(sum.network),
            recording,
            ..sum
        };
        let mut text = serde_json::to_vec_pretty(&sum).expect("counts are plain data");
        text.push(b'\n');
        if text.len() as u64 > SUMMARY_MAX.bytes() {
            let failure = Failure::new(
                Exit::Internal,
                format!("`{}` lacks the counts of the recorder", path.display()),
            );
            return Err(
                failure.with_help("use fewer topics in one lambda: a summary has at most 4 MiB")
            );
        }
        write_atomically(&path, &text).map_err(|error| {
            Failure::caused_by(Exit::Internal, format!("cannot write `{}`", path.display()), &error)
        })
    }
}

/// Returns the number of lines that the shim could not write. Only the shim counts those after the
/// last report.
fn unwritten(summary: &Path) -> u64 {
    let text = PlainFile::result(summary, SUMMARY_MAX).and_then(PlainFile::read_whole).ok();
    text.and_then(|text| serde_json::from_slice::<LiveStatus>(&text).ok())
        .map_or(0, |written| written.unwritten)
}

#[cfg(test)]
mod tests {
    use std::fs;

    use gleaner_lambda::manifest::LambdaKind;
    use gleaner_protocol::RecordingCounts;
    use gleaner_protocol::ingress::Health;

    use super::*;

    fn live(wakes: u64, unwritten: u64) -> LiveStatus {
        let status = LiveStatus::new("l", "1.0.0", LambdaKind::Wasm, "o".into());
        LiveStatus { wakes, unwritten, ..status }
    }

    fn recorder(disk_suppressed: u64) -> Option<Box<RecorderStatus>> {
        let recording = RecordingCounts { disk_suppressed, ..RecordingCounts::default() };
        let network = Some(NetworkStatus { socket_drops: 99, ..NetworkStatus::default() });
        Some(Box::new(RecorderStatus { recording, network, ..RecorderStatus::default() }))
    }

    fn ingress(socket_drops: u64) -> Option<Box<IngressStatus>> {
        let network = Some(NetworkStatus { socket_drops, ..NetworkStatus::default() });
        let health = Health { network, dead: None };
        Some(Box::new(IngressStatus { health, ..IngressStatus::default() }))
    }

    /// Returns the sum of the statuses of these processes.
    fn counts(
        all: impl IntoIterator<Item = (Option<Box<IngressStatus>>, Option<Box<RecorderStatus>>)>,
    ) -> RunCounts {
        let mut counts = RunCounts::default();
        all.into_iter().for_each(|(ingress, recorder)| counts.add(ingress, recorder));
        counts
    }

    /// Returns `summary.json` after `complete`, if the shim has written `before`.
    fn completed(before: &LiveStatus, complete: impl FnOnce(&Path)) -> LiveStatus {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("summary.json");
        fs::write(&path, serde_json::to_vec(before).unwrap()).unwrap();
        complete(folder.path());
        serde_json::from_slice(&fs::read(&path).unwrap()).unwrap()
    }

    #[test]
    fn the_counts_of_the_recorder_are_added_to_those_of_the_shim() {
        let summary = completed(&live(5, 3), |out| {
            let counts = counts([(None, recorder(7))]);
            EarlierCounts::default().complete(Some(live(5, 1)), &counts, out).unwrap();
        });
        assert_eq!((summary.wakes, summary.unwritten), (5, 3));
        assert_eq!(summary.recording.unwrap().recording.disk_suppressed, 7);
    }

    #[test]
    fn the_summary_of_the_shim_stays_if_there_is_nothing_to_add() {
        let summary = completed(&live(5, 3), |out| {
            let counts = counts([(ingress(4), None)]);
            EarlierCounts::default().complete(Some(live(5, 1)), &counts, out).unwrap();
        });
        assert_eq!(summary, live(5, 3));
    }

    #[test]
    fn ingresses_are_summed_up_for_a_process_that_has_seen_them_all() {
        let summary = completed(&live(5, 0), |out| {
            let counts = counts([(ingress(4), None), (ingress(30), None)]);
            EarlierCounts::default().complete(Some(live(5, 0)), &counts, out).unwrap();
        });
        assert_eq!((summary.wakes, summary.network.socket_drops), (5, 34));
    }

    #[test]
    fn recorders_are_summed_up_even_if_their_lambda_reported_nothing() {
        let summary = completed(&live(5, 3), |out| {
            let mut earlier = EarlierCounts::default();
            earlier.add(Some(live(10, 0)), false);
            earlier.add(None, true);
            let counts = counts([1, 20, 300].map(|count| (None, recorder(count))));
            earlier.complete(Some(live(5, 1)), &counts, out).unwrap();
        });
        assert_eq!((summary.wakes, summary.faults, summary.unwritten), (15, 1, 3));
        assert_eq!(summary.recording.unwrap().recording.disk_suppressed, 321);
    }

    #[test]
    fn losses_of_the_network_are_counted_once_for_several_processes_and_per_ingress() {
        let summary = completed(&live(5, 0), |out| {
            let with_drops = |wakes, socket_drops| {
                let network = NetworkStatus { socket_drops, ..NetworkStatus::default() };
                LiveStatus { network, ..live(wakes, 0) }
            };
            let mut earlier = EarlierCounts::default();
            earlier.add(Some(with_drops(1, 3)), false);
            earlier.add(Some(with_drops(1, 3)), false);
            let counts = counts([(ingress(3), recorder(0)), (ingress(40), recorder(0))]);
            earlier.complete(Some(with_drops(1, 40)), &counts, out).unwrap();
        });
        assert_eq!((summary.wakes, summary.network.socket_drops), (3, 43));
        assert_eq!(summary.recording.unwrap().network, None);
    }
}

//! The counts of the models over all processes of a service: those of a process begin at 0.

use std::collections::BTreeMap;

use gleaner_protocol::inference::{InferenceReport, LoadedModel, TryLoad};

/// Sums of the counts of processes that have ended, and the last reports of the current one.
#[derive(Default)]
pub(super) struct ModelTotals {
    ended: BTreeMap<TryLoad, LoadedModel>,
    current: BTreeMap<TryLoad, LoadedModel>,
}

impl ModelTotals {
    /// Adds the counts of earlier processes to those of a report.
    pub(super) fn add_to(&mut self, report: &mut InferenceReport) {
        match report {
            InferenceReport::Starting | InferenceReport::Ready | InferenceReport::Try(_) => {}
            InferenceReport::Model(model) => self.add_earlier(model),
            InferenceReport::Status(status) => {
                status.models.iter_mut().for_each(|model| self.add_earlier(model));
            }
            InferenceReport::Ended(status) => {
                status.models.iter_mut().for_each(|model| self.add_earlier(model));
                // Those that were not needed again since.
                self.end_process();
                let keys: Vec<TryLoad> = status.models.iter().map(key).collect();
                let others = self.ended.iter().filter(|(key, _)| !keys.contains(key));
                status.models.extend(others.map(|(_, model)| model.clone()));
            }
        }
    }

    /// Keeps the counts of the current process, which has ended.
    pub(super) fn end_process(&mut self) {
        for (key, mut model) in std::mem::take(&mut self.current) {
            if let Some(earlier) = self.ended.get(&key) {
                add(&mut model, earlier);
            }
            self.ended.insert(key, model);
        }
    }

    fn add_earlier(&mut self, model: &mut LoadedModel) {
        let key = key(model);
        let before = self.current.insert(key.clone(), model.clone());
        // A model that no lambda used for a while is loaded again, and counts from 0.
        if let Some(before) = before.filter(|before| requests(before) > requests(model)) {
            let ended = self.ended.entry(key.clone());
            ended.and_modify(|ended| add(ended, &before)).or_insert(before);
        }
        if let Some(earlier) = self.ended.get(&key) {
            add(model, earlier);
        }
    }
}

fn key(model: &LoadedModel) -> TryLoad {
    let LoadedModel { sha256, providers, threads, .. } = model.clone();
    TryLoad { sha256, providers, threads }
}

fn requests(model: &LoadedModel) -> u64 {
    model.runs + model.shared + model.failed
}

fn add(to: &mut LoadedModel, earlier: &LoadedModel) {
    let LoadedModel { runs, shared, failed, run_ns, .. } = earlier;
    to.runs += runs;
    to.shared += shared;
    to.failed += failed;
    to.run_ns = to.run_ns.saturating_add(*run_ns);
}

#[cfg(test)]
mod tests {
    use gleaner_protocol::inference::{InferenceStatus, ModelState};

    use super::*;

    fn model(path: &str, runs: u64) -> LoadedModel {
        LoadedModel {
            sha256: path.repeat(64),
            path: path.to_owned(),
            threads: 1,
            state: ModelState::Ready,
            runtime: "rten".to_owned(),
            load_ns: 1,
            runs,
            failed: 1,
            run_ns: runs * 10,
            ..LoadedModel::default()
        }
    }

    fn status(models: Vec<LoadedModel>) -> InferenceStatus {
        InferenceStatus { models, ..InferenceStatus::default() }
    }

    #[test]
    fn counts_go_on_after_an_end_of_the_process_and_a_removed_model_keeps_its_own() {
        let mut totals = ModelTotals::default();
        let shown = |totals: &mut ModelTotals, mut report: InferenceReport| {
            totals.add_to(&mut report);
            match report {
                InferenceReport::Status(status) | InferenceReport::Ended(status) => {
                    status.models.iter().map(|it| (it.runs, it.failed, it.run_ns)).collect()
                }
                _ => Vec::new(),
            }
        };
        let reported = |models| InferenceReport::Status(status(models));
        let one = |runs| reported(vec![model("a", runs)]);
        assert_eq!(shown(&mut totals, one(3)), [(3, 1, 30)]);
        assert_eq!(shown(&mut totals, reported(vec![model("a", 5), model("b", 7)]))[1].0, 7);
        totals.end_process();
        assert_eq!(shown(&mut totals, one(1)), [(6, 2, 60)]);
        assert_eq!(shown(&mut totals, one(4)), [(9, 2, 90)]);
        assert_eq!(shown(&mut totals, one(0)), [(9, 3, 90)], "it was loaded again");
        let last = InferenceReport::Ended(status(vec![model("a", 2)]));
        assert_eq!(shown(&mut totals, last), [(11, 3, 110), (7, 1, 70)]);
    }
}

//! The models that are refused: those that ended the process several times, each in use alone.
//!
//! An end of the process counts against a model only if no other one was in use. If several were,
//! none is charged; each of the next processes begins with a time in which it uses one at a time,
//! so that a further end has one cause.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use gleaner_protocol::inference::ModelFile;

use super::INFERENCE;

/// Ends of the process after which what caused them is refused.
pub(super) const ENDS_MAX: usize = 3;

/// Time for which an end counts: a model that fails more rarely goes on.
const COUNTED: Duration = Duration::from_secs(24 * 3600);

/// First time for which models are used one at a time. Each further end of several models doubles
/// it, so that a model that fails only beside others cannot end the process again and again.
const APART: Duration = Duration::from_secs(60);

/// The ends so far, by the digest of the model and, if it ran, the identity of the lambda.
#[derive(Default)]
pub(super) struct Blame {
    ends: BTreeMap<String, Vec<Instant>>,
    refused: BTreeMap<String, String>,
    apart: Duration,
}

impl Blame {
    /// Counts an end of a process by the models `in_use`, each with its note; there are none if it
    /// was ended from outside. Returns why the only one is refused now, if so.
    pub(super) fn ended(
        &mut self,
        in_use: &[(String, ModelFile)],
        reason: &str,
        now: Instant,
    ) -> Option<String> {
        if in_use.len() > 1 {
            self.apart = self.apart.saturating_mul(2).max(APART);
        }
        let [(culprit, model)] = in_use else { return None };
        let ends = self.ends.entry(culprit.clone()).or_default();
        ends.retain(|at| now.duration_since(*at) < COUNTED);
        ends.push(now);
        if ends.len() < ENDS_MAX {
            return None;
        }
        let how = match culprit.split_once(' ') {
            Some((_, lambda)) => format!("only this ran, for lambda `{lambda}`"),
            None => "only this was loaded".to_owned(),
        };
        let refusal = refusal(model, &format!("{ENDS_MAX} times while {how}"), reason);
        self.refused.insert(culprit.clone(), refusal.clone());
        Some(refusal)
    }

    /// Returns the time for which the next process uses models one at a time.
    pub(super) fn apart_for(&self) -> Duration {
        self.apart
    }

    /// Returns why the lambda of this identity must not use a model.
    pub(super) fn refusal(&self, sha256: &str, lambda: &str) -> Option<&String> {
        let of_lambda = || self.refused.get(&format!("{sha256} {lambda}"));
        self.refused.get(sha256).or_else(of_lambda)
    }
}

/// Returns why a model is refused after the process has `ended` in this way.
pub(super) fn refusal(model: &ModelFile, ended: &str, reason: &str) -> String {
    let ModelFile { path, sha256, .. } = model;
    let digits = sha256.get(..8).unwrap_or(sha256);
    format!(
        "model `{path}` (SHA-256 {digits}...) is refused: {INFERENCE} ended {ended}; the last \
         time: {reason}; correct the model; the same file is used again after a restart of \
         Gleaner only"
    )
}

#[cfg(test)]
mod tests {
    use gleaner_protocol::inference::ModelEngine;

    use super::*;

    fn end(blame: &mut Blame, in_use: &[&str], now: Instant) -> Option<String> {
        let (sha256, path, engine) = ("1".repeat(64), "m.onnx".to_owned(), ModelEngine::None);
        let model = ModelFile { sha256, path, engine };
        let in_use: Vec<_> = in_use.iter().map(|it| ((*it).to_owned(), model.clone())).collect();
        blame.ended(&in_use, "SIGABRT", now)
    }

    #[test]
    fn what_is_alone_at_three_ends_of_a_day_is_refused_for_its_lambda_only() {
        let (mut blame, now) = (Blame::default(), Instant::now());
        for at in [now, now, now + COUNTED, now + COUNTED] {
            assert_eq!(end(&mut blame, &["a hostile"], at), None);
        }
        let refusal = end(&mut blame, &["a hostile"], now + COUNTED).unwrap();
        let begin = "model `m.onnx` (SHA-256 11111111...) is refused: gleaner-inference ended 3";
        assert!(refusal.starts_with(begin), "{refusal}");
        assert_eq!(blame.refusal("a", "hostile"), Some(&refusal));
        assert_eq!(blame.refusal("a", "victim"), None, "it uses the same file");
        (0..3).for_each(|_| drop(end(&mut blame, &["a"], now)));
        assert!(blame.refusal("a", "victim").is_some_and(|it| it.contains("loaded")));
    }

    #[test]
    fn of_two_in_use_none_is_charged_and_they_are_used_apart_longer_each_time() {
        let (mut blame, now, both) = (Blame::default(), Instant::now(), ["a", "b victim"]);
        for doubled in [1, 2, 4, 8, 16] {
            assert_eq!(end(&mut blame, &both, now), None);
            assert_eq!(blame.apart_for(), APART * doubled);
        }
        for none in [&[], &both[..1], &both[..1]] {
            assert_eq!(end(&mut blame, none, now), None);
        }
        assert!(end(&mut blame, &both[..1], now).is_some());
        assert_eq!(blame.apart_for(), APART * 16, "the next processes begin so, too");
        assert_eq!(blame.refusal("b", "victim"), None);
    }
}

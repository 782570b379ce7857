//! The models that are refused: those that ended the process several times, each in use alone.
//!
//! An end of the process counts against a model, and the lambda that ran it, only if no other one
//! was in use. If several were, none is charged; each of the next processes begins with a time in
//! which it uses one at a time, so that a further end has one cause.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use gleaner_protocol::inference::{ModelEngine, ModelFile};

use super::INFERENCE;

/// Ends of the process after which what caused them is refused.
pub(super) const ENDS_MAX: usize = 3;

/// Time for which an end counts: a model that fails more rarely goes on.
const COUNTED: Duration = Duration::from_secs(24 * 3600);

/// First time for which models are used one at a time. Each further end of several models doubles
/// it, so that a model that fails only beside others cannot end the process again and again.
const APART: Duration = Duration::from_secs(60);

/// The ends so far, by the digest of the model and, if it ran, a space and the identity of the
/// lambda; and by these two alone.
#[derive(Default)]
pub(super) struct Blame {
    ends: BTreeMap<String, Vec<Instant>>,
    refused: BTreeMap<String, String>,
    apart: Duration,
}

impl Blame {
    /// Charges the end of a process, if it `is_fault`, to the model that alone was in use by its
    /// notes. Returns the reason with these models, which `model` finds by their digests, and why
    /// one is refused from now on.
    pub(super) fn charge(
        &mut self,
        notes: Vec<String>,
        model: impl Fn(&str) -> Option<ModelFile>,
        mut reason: String,
        is_fault: bool,
    ) -> (String, Option<String>) {
        let is_short = matches!(&notes[..], [note] if note.ends_with('\n'));
        let known = |note: String| {
            let sha256 = note.get(..64).unwrap_or_default().to_owned();
            let (path, engine) = ("of a lambda that has ended".to_owned(), ModelEngine::None);
            let model = model(&sha256).unwrap_or(ModelFile { sha256, path, engine });
            (note.trim_end().to_owned(), model)
        };
        let in_use: Vec<_> = notes.into_iter().map(known).collect();
        for (index, (note, model)) in in_use.iter().enumerate() {
            let begin = if index == 0 { ", while it" } else { " and" };
            let verb = if note.contains(' ') { "ran" } else { "loaded" };
            reason += &format!("{begin} {verb} `{}`", model.path);
        }
        let charged = if is_fault && !is_short { &in_use[..] } else { &[] };
        let refusal = self.ended(charged, &reason, Instant::now());
        if is_fault && is_short {
            reason += ": others had left it too little memory: none is charged";
        }
        if charged.len() > 1 {
            let seconds = self.apart_for().as_secs();
            reason += &format!(": none is charged; for {seconds} s, one runs at a time");
        }
        (reason, refusal)
    }

    /// Counts an end of a process by the models `in_use`, each with its note; there are none if it
    /// was ended from outside. Returns why the only one is refused now, if so.
    fn ended(
        &mut self,
        in_use: &[(String, ModelFile)],
        reason: &str,
        now: Instant,
    ) -> Option<String> {
        if in_use.len() > 1 {
            self.apart = self.apart.saturating_mul(2).max(APART);
        }
        let [(culprit, model)] = in_use else { return None };
        let mut is_refused = |culprit: &str| {
            let ends = self.ends.entry(culprit.to_owned()).or_default();
            ends.retain(|at| now.duration_since(*at) < COUNTED);
            ends.push(now);
            ends.len() >= ENDS_MAX
        };
        // It may have many models, each of which ends the process once.
        let of_lambda = culprit.find(' ').map(|at| &culprit[at..]).filter(|key| is_refused(key));
        let (key, how) = match (is_refused(culprit), culprit.split_once(' ')) {
            (true, Some((_, lambda))) => {
                (&**culprit, format!("only this ran, for lambda `{lambda}`"))
            }
            (true, None) => (&**culprit, "only this was loaded".to_owned()),
            (false, _) => {
                let key = of_lambda?;
                (key, format!("only models of lambda `{}` ran, all refused now", key.trim_start()))
            }
        };
        let refusal = refusal(model, &format!("{ENDS_MAX} times while {how}"), reason);
        self.refused.insert(key.to_owned(), refusal.clone());
        Some(refusal)
    }

    /// Returns the time for which the next process uses models one at a time.
    pub(super) fn apart_for(&self) -> Duration {
        self.apart
    }

    /// Returns why the lambda of this identity must not use a model.
    pub(super) fn refusal(&self, sha256: &str, lambda: &str) -> Option<&String> {
        let keys = [sha256.to_owned(), format!("{sha256} {lambda}"), format!(" {lambda}")];
        keys.iter().find_map(|key| self.refused.get(key))
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
    fn a_lambda_whose_models_end_the_process_one_after_another_is_refused_with_all_of_them() {
        let (mut blame, now) = (Blame::default(), Instant::now());
        for note in ["a hostile", "a victim", "b hostile", "b victim"] {
            assert_eq!(end(&mut blame, &[note], now), None);
        }
        let refusal = end(&mut blame, &["c hostile"], now).unwrap();
        assert!(refusal.contains("3 times while only models of lambda `hostile` ran"), "{refusal}");
        assert_eq!(blame.refusal("d", "hostile"), Some(&refusal), "it has not run yet");
        assert_eq!(blame.refusal("c", "victim"), None);
    }

    #[test]
    fn what_others_had_left_too_little_memory_is_not_charged() {
        let mut blame = Blame::default();
        let mut end = |note: &str| {
            let notes = vec![format!("{} {note}", "1".repeat(64))];
            blame.charge(notes, |_| None, "it ended".to_owned(), true)
        };
        let (reason, _) = end("victim\n");
        assert!(reason.contains("too little memory: none is charged"), "{reason}");
        assert!((0..9).all(|_| end("victim\n").1.is_none()));
        assert!((0..3).any(|_| end("hostile").1.is_some()));
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

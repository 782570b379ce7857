//! The steps from what a vehicle runs to what the cloud wants.

use std::collections::BTreeMap;

use gleaner_fleet::{Wanted, WantedProblem};
use gleaner_lambda::manifest::ItemName;

use crate::state::{Deployed, DesiredDeployment};

#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Step {
    /// Remove what the cloud deployed, and does not want any more.
    Remove(ItemName),
    /// Deploy it, and run its fallback if `rolls_back`.
    Deploy { id: ItemName, wish: DesiredDeployment, rolls_back: bool },
    /// Stop it.
    Stop(ItemName, DesiredDeployment),
    /// Run its fallback.
    RollBack(ItemName, DesiredDeployment),
    /// Start it again, unless it runs.
    Start(ItemName, DesiredDeployment),
}

impl Step {
    /// The deployment that it changes.
    pub(super) fn id(&self) -> &ItemName {
        match self {
            Step::Remove(id) | Step::Stop(id, _) | Step::RollBack(id, _) | Step::Start(id, _) => id,
            Step::Deploy { id, .. } => id,
        }
    }

    /// Returns whether something that runs ends by it.
    pub(super) fn takes_away(&self) -> bool {
        matches!(self, Step::Remove(_) | Step::Stop(..))
    }

    /// SHA-256 of the envelope that it concerns; empty for one that the cloud does not name.
    pub(super) fn envelope(&self) -> String {
        match self {
            Step::Remove(_) => String::new(),
            Step::Stop(_, wish)
            | Step::RollBack(_, wish)
            | Step::Start(_, wish)
            | Step::Deploy { wish, .. } => gleaner_base::excerpt(&wish.envelope),
        }
    }
}

/// Returns the steps, and the reasons why parts of the desired state are ignored.
///
/// A local deployment is never stopped or removed. A local change after the cloud's last wish for a
/// deployment stays until the cloud wants something else of it.
pub(super) fn plan(
    wanted: &[Wanted],
    deployed: &BTreeMap<ItemName, Deployed>,
) -> (Vec<Step>, Vec<WantedProblem>) {
    let (mut steps, mut ignored, mut named) = (Vec::new(), Vec::new(), Vec::new());
    for item in wanted {
        let Ok(id) = item.id.parse::<ItemName>() else {
            let deployment = gleaner_base::excerpt(&item.id);
            ignored.push(WantedProblem {
                deployment: deployment.clone(),
                envelope: gleaner_base::excerpt(&item.envelope),
                title: format!("invalid deployment id `{deployment}`"),
                ..WantedProblem::default()
            });
            continue;
        };
        let Wanted { envelope, is_wanted, rollback, start, .. } = item.clone();
        let wish = DesiredDeployment { envelope, is_wanted, rollback, start };
        let followed = deployed.get(&id).and_then(|it| it.cloud.as_ref());
        let same = followed.filter(|before| before.envelope == wish.envelope);
        let stays_stopped = !wish.is_wanted && same.is_some_and(|same| !same.is_wanted);
        let step = match (followed, same) {
            // A request for the fallback of a stopped one is followed at its start.
            _ if followed == Some(&wish) || stays_stopped => None,
            (_, Some(same)) if same.is_wanted && wish.is_wanted => {
                if wish.rollback > same.rollback {
                    Some(Step::RollBack(id.clone(), wish))
                } else {
                    (wish.start > same.start).then(|| Step::Start(id.clone(), wish))
                }
            }
            _ if wish.is_wanted => {
                let rolls_back = wish.rollback > same.map_or(0, |same| same.rollback);
                Some(Step::Deploy { id: id.clone(), wish, rolls_back })
            }
            (Some(_), _) => {
                let rollback = same.map_or(0, |same| same.rollback);
                Some(Step::Stop(id.clone(), DesiredDeployment { rollback, ..wish }))
            }
            // It never ran by the cloud, and is not to.
            (None, _) => None,
        };
        steps.extend(step);
        named.push(id);
    }
    let gone = deployed.iter().filter(|(id, it)| it.cloud.is_some() && !named.contains(id));
    let gone = gone.map(|(id, _)| Step::Remove(id.clone()));
    let mut steps: Vec<_> = gone.chain(steps).collect();
    // What ends does not wait for the files of what is new, and leaves its memory to that.
    steps.sort_by_key(|step| matches!(step, Step::Deploy { .. }));
    (steps, ignored)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(id: &str, envelope: &str, is_wanted: bool, rollback: u64) -> Wanted {
        Wanted { id: id.to_owned(), envelope: envelope.to_owned(), is_wanted, rollback, start: 0 }
    }

    fn wish(envelope: &str, is_wanted: bool, rollback: u64) -> DesiredDeployment {
        DesiredDeployment { envelope: envelope.to_owned(), is_wanted, rollback, start: 0 }
    }

    fn deployed(cloud: Option<DesiredDeployment>) -> Deployed {
        Deployed {
            envelope: String::new(),
            lambda: "x".parse().unwrap(),
            release: 1,
            attempt: 1,
            is_wanted: true,
            runs_fallback: false,
            is_proven: false,
            failed: None,
            history: Vec::new(),
            cloud,
        }
    }

    fn steps(wanted: &[Wanted], state: &[(&str, Option<DesiredDeployment>)]) -> Vec<Step> {
        let state = state.iter().map(|(id, cloud)| (id.parse().unwrap(), deployed(cloud.clone())));
        let (steps, ignored) = plan(wanted, &state.collect());
        assert_eq!(ignored, Vec::new());
        steps
    }

    fn id(id: &str) -> ItemName {
        id.parse().unwrap()
    }

    #[test]
    fn a_new_deployment_is_deployed_and_one_that_was_followed_is_left_alone() {
        let deploy = Step::Deploy { id: id("a"), wish: wish("1", true, 0), rolls_back: false };
        let new = [wanted("a", "1", true, 0)];
        assert_eq!(steps(&new, &[]), vec![deploy.clone()]);
        assert_eq!(steps(&new, &[("a", Some(wish("0", true, 2)))]), [deploy]);
        assert_eq!(steps(&new, &[("a", Some(wish("1", true, 0)))]), []);
        assert_eq!(steps(&[wanted("a", "1", false, 0)], &[]), []);
    }

    #[test]
    fn a_fallback_is_run_once_for_each_request() {
        let rolled = [("a", Some(wish("1", true, 1)))];
        assert_eq!(steps(&[wanted("a", "1", true, 1)], &rolled), []);
        let again = Step::RollBack(id("a"), wish("1", true, 2));
        assert_eq!(steps(&[wanted("a", "1", true, 2)], &rolled), [again]);
        let new = Step::Deploy { id: id("a"), wish: wish("1", true, 1), rolls_back: true };
        assert_eq!(steps(&[wanted("a", "1", true, 1)], &[]), [new]);
    }

    #[test]
    fn a_lambda_is_started_again_once_for_each_request() {
        let request = |start| Wanted { start, ..wanted("a", "1", true, 0) };
        let followed = |start| DesiredDeployment { start, ..wish("1", true, 0) };
        let started = |start| [("a", Some(followed(start)))];
        assert_eq!(steps(&[request(5)], &started(5)), []);
        let again = Step::Start(id("a"), followed(6));
        assert_eq!(steps(&[request(6)], &started(5)), [again]);
        assert_eq!(steps(&[request(4)], &started(5)), [], "of an older backup");
        let both = Wanted { start: 6, rollback: 1, ..request(6) };
        let rolled = DesiredDeployment { rollback: 1, ..followed(6) };
        assert_eq!(steps(&[both], &started(5)), [Step::RollBack(id("a"), rolled)]);
    }

    #[test]
    fn what_is_stopped_is_started_by_its_deployment() {
        let running = [("a", Some(wish("1", true, 0)))];
        let stop = Step::Stop(id("a"), wish("1", false, 0));
        assert_eq!(steps(&[wanted("a", "1", false, 0)], &running), std::slice::from_ref(&stop));
        let stopped = [("a", Some(wish("1", false, 0)))];
        let start = Step::Deploy { id: id("a"), wish: wish("1", true, 0), rolls_back: false };
        assert_eq!(steps(&[wanted("a", "1", true, 0)], &stopped), [start]);
        // Its fallback is requested at the stop or later: it is what starts.
        assert_eq!(steps(&[wanted("a", "1", false, 1)], &running), [stop]);
        assert_eq!(steps(&[wanted("a", "1", false, 1)], &stopped), []);
        let start = Step::Deploy { id: id("a"), wish: wish("1", true, 1), rolls_back: true };
        assert_eq!(steps(&[wanted("a", "1", true, 1)], &stopped), [start]);
    }

    #[test]
    fn what_ends_does_not_wait_for_what_is_new() {
        let wanted = [wanted("a", "1", true, 0), wanted("b", "1", false, 0)];
        let steps = steps(&wanted, &[("b", Some(wish("1", true, 0)))]);
        assert_eq!(steps.iter().map(Step::id).collect::<Vec<_>>(), [&id("b"), &id("a")]);
    }

    #[test]
    fn only_what_the_cloud_deployed_is_removed_and_stopped() {
        let state = [("a", Some(wish("1", true, 0))), ("local", None)];
        assert_eq!(steps(&[], &state), [Step::Remove(id("a"))]);
        assert_eq!(steps(&[wanted("local", "1", false, 0)], &[("local", None)]), []);
    }

    #[test]
    fn an_invalid_id_is_named() {
        let (steps, ignored) = plan(&[wanted("../x", "1", true, 0)], &BTreeMap::new());
        assert_eq!((steps, ignored.len()), (vec![], 1));
        assert_eq!(ignored[0].title, "invalid deployment id `../x`");
    }
}

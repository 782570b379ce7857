//! Decides what to start and to stop so that what runs becomes what is wanted.

use gleaner_protocol::supervision::{DesiredLambda, DesiredState};

/// A lambda that runs, waits, or is ending.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KnownLambda<'a> {
    /// The desired state by which it runs.
    pub lambda: &'a DesiredLambda,
    /// True if it was requested to end.
    pub is_leaving: bool,
}

/// A step towards the desired state.
#[derive(Debug, Clone, PartialEq)]
pub enum Action {
    Start(DesiredLambda),
    /// Request the lambda with this id to end.
    Stop(String),
}

/// Returns the steps from `known` towards `desired`. Repeat it when a lambda has left: one that
/// replaces another one starts only then, and always as the newest state wants it.
pub fn reconcile(desired: &DesiredState, known: &[KnownLambda<'_>]) -> Vec<Action> {
    let is_wanted = |known: &KnownLambda<'_>| desired.lambdas.contains(known.lambda);
    let stops = known.iter().filter(|known| !known.is_leaving && !is_wanted(known));
    let stops = stops.map(|known| Action::Stop(known.lambda.id.clone()));
    // The recorder and the clips know lambdas by their names.
    let is_free = |wanted: &&DesiredLambda| {
        known.iter().all(|it| it.lambda.id != wanted.id && it.lambda.name != wanted.name)
    };
    let starts = desired.lambdas.iter().filter(is_free).cloned().map(Action::Start);
    stops.chain(starts).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::random::XorShift64;

    fn lambda(id: &str, revision: &str) -> DesiredLambda {
        DesiredLambda {
            id: id.to_owned(),
            name: format!("name-{id}"),
            revision: revision.to_owned(),
            attempt: 1,
            ..DesiredLambda::default()
        }
    }

    fn desired(lambdas: &[DesiredLambda]) -> DesiredState {
        DesiredState { generation: 1, lambdas: lambdas.to_vec() }
    }

    fn known(lambda: &DesiredLambda, is_leaving: bool) -> KnownLambda<'_> {
        KnownLambda { lambda, is_leaving }
    }

    #[test]
    fn only_what_differs_is_touched() {
        let (a, b, b2, c) =
            (lambda("a", "1"), lambda("b", "1"), lambda("b", "2"), lambda("c", "1"));
        let wanted = desired(&[a.clone(), b2.clone(), c.clone()]);
        let actions = reconcile(&wanted, &[known(&a, false), known(&b, false)]);
        assert_eq!(actions, [Action::Stop("b".to_owned()), Action::Start(c)]);
        assert_eq!(
            reconcile(&desired(&[a.clone(), b2.clone()]), &[known(&a, false)]),
            [Action::Start(b2)]
        );
        assert_eq!(reconcile(&desired(&[]), &[known(&a, false)]), [Action::Stop("a".to_owned())]);
    }

    #[test]
    fn one_that_is_leaving_is_waited_for_even_if_it_is_wanted_again() {
        let (a, mut other) = (lambda("a", "1"), lambda("x", "1"));
        assert_eq!(reconcile(&desired(std::slice::from_ref(&a)), &[known(&a, true)]), []);
        other.name.clone_from(&a.name);
        assert_eq!(reconcile(&desired(&[other]), &[known(&a, true)]), [], "its name is in use");
    }

    /// States that change at random while lambdas take their time to leave: never do two run under
    /// one id or name, what stays wanted is never stopped, and in the end the last state runs.
    #[test]
    fn any_sequence_of_states_converges_to_the_last_one() {
        for seed in 1..=2000 {
            let mut random = XorShift64(seed);
            let mut wanted = desired(&[]);
            let mut runs: Vec<(DesiredLambda, bool)> = Vec::new();
            for step in 0..40 {
                let change = random.below(usize::MAX);
                if step < 30 && change.is_multiple_of(3) {
                    let ids = ["a", "b", "c", "d"].into_iter().filter(|_| random.below(2) == 0);
                    let ids: Vec<_> = ids.collect();
                    let of = |id: &&str| {
                        let revision = random.below(3);
                        lambda(id, &revision.to_string())
                    };
                    let lambdas: Vec<_> = ids.iter().map(of).collect();
                    wanted = DesiredState { generation: wanted.generation + 1, lambdas };
                }
                if step >= 30 || change % 5 < 2 {
                    runs.retain(|(_, is_leaving)| !is_leaving);
                }
                let before: Vec<_> = runs.iter().map(|(it, leaves)| known(it, *leaves)).collect();
                for action in reconcile(&wanted, &before) {
                    match action {
                        Action::Start(lambda) => {
                            let clashes = |(it, _): &(DesiredLambda, bool)| {
                                it.id == lambda.id || it.name == lambda.name
                            };
                            assert!(!runs.iter().any(clashes), "seed {seed}: {lambda:?}");
                            runs.push((lambda, false));
                        }
                        Action::Stop(id) => {
                            let run = runs.iter_mut().find(|(it, _)| it.id == id).expect("it runs");
                            assert!(!wanted.lambdas.contains(&run.0), "seed {seed}: {id}");
                            run.1 = true;
                        }
                    }
                }
            }
            let mut last: Vec<_> = runs.into_iter().map(|(lambda, _)| lambda).collect();
            last.sort_by(|a, b| a.id.cmp(&b.id));
            assert_eq!(last, wanted.lambdas, "seed {seed}");
        }
    }
}

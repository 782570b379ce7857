//! The vehicles of a cloud that a change of a deployment concerns, and the question before it.

use std::collections::BTreeMap;
use std::io::{self, IsTerminal};

use gleaner_base::{Exit, Failure, visible};
use gleaner_fleet::people::{VehicleState, VehicleSummary};
use gleaner_report::format::counted;
use serde_json::{Value, json};

use crate::output::print_error;
use crate::vehicle::{labels_in_words, print_lines};

/// Maximum number of vehicles of each kind that are named.
const NAMED_MAX: usize = 20;

/// Labels that a vehicle must have.
pub(super) type Selector = BTreeMap<String, String>;

/// The vehicles that a change concerns, by their names.
#[derive(Debug, Default, PartialEq)]
pub(super) struct FleetPlan {
    starts: Vec<String>,
    updates: Vec<String>,
    removes: Vec<String>,
    /// The action at those that lose it.
    removal: &'static str,
}

/// Returns whether a deployment with this selector is for a vehicle. The labels of one that has
/// never connected are unknown.
pub(super) fn selects(selector: &Selector, vehicle: &VehicleSummary) -> bool {
    matches!(vehicle.state, VehicleState::Online | VehicleState::Offline)
        && selector.iter().all(|(name, value)| vehicle.labels.get(name) == Some(value))
}

impl FleetPlan {
    /// Compares the vehicles that a deployment has, by the selectors of its releases, with those
    /// that it will have.
    pub(super) fn of_deployment(
        vehicles: &[VehicleSummary],
        before: &[&Selector],
        after: &Selector,
    ) -> Self {
        let mut plan = Self { removal: "is removed from", ..Self::default() };
        for vehicle in vehicles {
            let had = before.iter().any(|before| selects(before, vehicle));
            let kind = match (had, selects(after, vehicle)) {
                (false, true) => &mut plan.starts,
                (true, true) => &mut plan.updates,
                (true, false) => &mut plan.removes,
                (false, false) => continue,
            };
            kind.push(vehicle.name.clone());
        }
        plan
    }

    /// Names the vehicles that a deployment is taken from.
    pub(super) fn of_removal(
        vehicles: &[VehicleSummary],
        before: &[&Selector],
        removal: &'static str,
    ) -> Self {
        let had = |vehicle: &&VehicleSummary| before.iter().any(|it| selects(it, vehicle));
        let removed = vehicles.iter().filter(had);
        let removes = removed.map(|vehicle| vehicle.name.clone()).collect();
        Self { removes, removal, ..Self::default() }
    }

    pub(super) fn matches_any(&self) -> bool {
        self.kinds().iter().any(|(_, names)| !names.is_empty())
    }

    /// Returns whether it takes the deployment away from a vehicle.
    pub(super) fn removes(&self, vehicle: &str) -> bool {
        self.removes.iter().any(|name| name == vehicle)
    }

    /// Returns whether it concerns a vehicle.
    pub(super) fn names(&self, vehicle: &str) -> bool {
        self.kinds().iter().any(|(_, names)| names.iter().any(|name| name == vehicle))
    }

    pub(super) fn json(&self) -> Value {
        json!({ "starts": self.starts, "updates": self.updates, "removes": self.removes })
    }

    fn kinds(&self) -> [(&'static str, &Vec<String>); 3] {
        [
            ("starts on", &self.starts),
            ("is updated on", &self.updates),
            (self.removal, &self.removes),
        ]
    }

    /// Returns a line for each kind of change.
    fn lines(&self, id: &str) -> Vec<String> {
        let kinds = self.kinds().into_iter().filter(|(_, names)| !names.is_empty());
        let lines = kinds.map(|(what, names)| {
            let count = counted(names.len() as u64, "vehicle");
            let named = names.iter().take(NAMED_MAX).map(|name| visible(name));
            let mut named: Vec<_> = named.collect();
            if let Some(more @ 1..) = names.len().checked_sub(NAMED_MAX) {
                named.push(format!("{more} more"));
            }
            format!("`{id}` {what} {count}: {}", named.join(", "))
        });
        let lines: Vec<_> = lines.collect();
        match lines.is_empty() {
            true => vec![format!("no vehicle matches `{id}`")],
            false => lines,
        }
    }

    /// Prints it. If it takes something away, or matches no vehicle, goes on only after `yes`, or
    /// after an answer at the terminal.
    ///
    /// # Errors
    ///
    /// A failure without that: nothing has changed.
    pub(super) fn confirm(
        &self,
        id: &str,
        selector: &Selector,
        (yes, json): (bool, bool),
    ) -> Result<(), Failure> {
        let lines = self.lines(id);
        let is_harmless = self.matches_any() && self.removes.is_empty();
        if yes || is_harmless || (!json && is_agreed(&lines)?) {
            return if json { Ok(()) } else { print_lines(&lines) };
        }
        let (exit, why) = match self.matches_any() {
            false => (Exit::Differs, "no vehicle matches"),
            true => (Exit::Usage, "it takes the deployment away from vehicles"),
        };
        let mut failure = Failure::new(exit, format!("nothing was changed: {why}"));
        failure.causes = lines;
        if !self.matches_any() && !selector.is_empty() {
            failure.causes.push(format!("its labels are {}", labels_in_words(selector)));
        }
        Err(failure
            .with_help("`gleaner vehicles` shows all; with `--yes`, it is done all the same"))
    }
}

/// Asks at the terminal, if there is one; returns whether the answer was yes.
fn is_agreed(lines: &[String]) -> Result<bool, Failure> {
    if !io::stdin().is_terminal() || !io::stderr().is_terminal() {
        return Ok(false);
    }
    let failed = |error| Failure::caused_by(Exit::Internal, "cannot ask at the terminal", &error);
    print_error(&format!("{}\ntype `yes` to go on: ", lines.join("\n")));
    let mut answer = String::new();
    io::stdin().read_line(&mut answer).map_err(failed)?;
    Ok(answer.trim() == "yes")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vehicle(name: &str, state: VehicleState, site: &str) -> VehicleSummary {
        VehicleSummary { labels: selector(site), ..super::super::test_vehicle(name, state) }
    }

    fn selector(site: &str) -> Selector {
        [("site".to_owned(), site.to_owned())].into()
    }

    #[test]
    fn a_plan_names_the_vehicles_that_lose_the_deployment() {
        let vehicles = [
            vehicle("a", VehicleState::Online, "berlin"),
            vehicle("b", VehicleState::Offline, "paris"),
            vehicle("c", VehicleState::Revoked, "berlin"),
            vehicle("new", VehicleState::Invited, "berlin"),
        ];
        let plan = |before: Option<&Selector>, after| {
            FleetPlan::of_deployment(&vehicles, before.as_slice(), after).lines("x")
        };
        let (all, berlin, none) = (Selector::new(), selector("berlin"), selector("berln"));
        assert_eq!(plan(None, &all), ["`x` starts on 2 vehicles: a, b"]);
        assert_eq!(
            plan(Some(&all), &berlin),
            ["`x` is updated on 1 vehicle: a", "`x` is removed from 1 vehicle: b"]
        );
        assert_eq!(plan(Some(&all), &none), ["`x` is removed from 2 vehicles: a, b"]);
        assert_eq!(plan(Some(&none), &none), ["no vehicle matches `x`"]);
        let stopped = FleetPlan::of_removal(&vehicles, &[&selector("paris"), &none], "stops on");
        assert_eq!(stopped.lines("x"), ["`x` stops on 1 vehicle: b"]);
        let many: Vec<_> =
            (0..25).map(|n| vehicle(&format!("{n}"), VehicleState::Online, "s")).collect();
        let lines = FleetPlan::of_removal(&many, &[&all], "is removed from").lines("x");
        assert!(lines[0].ends_with("18, 19, 5 more"), "{lines:?}");
    }
}

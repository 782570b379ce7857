//! A recommendation of a kind of lambda, which follows from the costs that were measured.

use crate::markdown::number;
use crate::statistics::MeasuredDifference;

/// Least ratio that counts as a difference between the kinds: less depends on the machine.
const FACTOR: f64 = 1.25;
/// Least differences that a user could notice, in the units of the costs.
const MIN_US: f64 = 1.0;
const MIN_MB: f64 = 1.0;
const MIN_CALL_NS: f64 = 1000.0;
const MIN_START_MS: f64 = 10.0;
const MIN_RESTARTED_MS: f64 = 1.0;
const MIN_KILLED_S: f64 = 0.1;

/// Costs of isolation. What was not measured is `None`, and is left out of the recommendation.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct IsolationCosts {
    /// Wakes of the same lambdas.
    pub wakes: Vec<WakeCosts>,
    /// CPU time of the lambda's process per wake of live runs, in us, with their names.
    pub live_cpu_us: Vec<(String, KindValues)>,
    /// A host call, in ns.
    pub host_call_ns: KindValues,
    /// Memory of the processes of one lambda, in MB.
    pub first_lambda_mb: KindValues,
    /// Memory of a further lambda, in MB.
    pub further_lambda_mb: KindValues,
    /// Lifetime of a process with one wake, in ms.
    pub start_ms: KindValues,
    /// The wake after a trap or an exception, in ms.
    pub restarted_ms: KindValues,
    /// Time until a lambda is ready again after its process was killed, in s.
    pub killed_s: KindValues,
    /// Attacks on other lambdas.
    pub attacks: Option<AttackCounts>,
}

/// Medians for the kinds of lambdas, and for native code.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct KindValues {
    /// A native function in the runtime.
    pub native: Option<f64>,
    /// A component.
    pub wasm: Option<f64>,
    /// Python.
    pub python: Option<f64>,
}

/// Wakes of one lambda.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct WakeCosts {
    /// The lambda and its input.
    pub name: String,
    /// Time per wake in us.
    pub us: KindValues,
    /// A component with fuel and epochs, against one without.
    pub checks: Option<MeasuredDifference>,
}

/// Comparisons of a victim under attack with the same victim at rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct AttackCounts {
    /// All comparisons.
    pub compared: usize,
    /// Those in which the victim was not slower than by the noise of the machine.
    pub unseen: usize,
}

/// The kind that costs less.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum CheaperKind {
    Wasm,
    Python,
}

struct Criterion<'a> {
    name: &'a str,
    wasm: f64,
    python: f64,
    /// The least difference that a user could notice.
    least: f64,
}

impl IsolationCosts {
    /// Returns the sentences of the recommendation, the rules of when to take which kind last.
    pub fn recommendation(&self) -> Vec<String> {
        let mut sentences: Vec<String> = self.wakes.iter().flat_map(WakeCosts::sentences).collect();
        sentences.extend(self.live_cpu_us.iter().filter_map(|(name, values)| {
            values.sentence(&format!("{name}, a wake takes of the CPU"), "us")
        }));
        let costs = [
            ("A host call takes", self.host_call_ns, "ns"),
            ("The processes of one lambda take", self.first_lambda_mb, "MB"),
            ("Each further lambda of the same kind takes", self.further_lambda_mb, "MB"),
            ("A process that starts, wakes once and ends takes", self.start_ms, "ms"),
            ("After a trap or an exception, the next wake takes", self.restarted_ms, "ms"),
            ("After its process was killed, a lambda is ready again after", self.killed_s, "s"),
        ];
        sentences
            .extend(costs.iter().filter_map(|(what, values, unit)| values.sentence(what, unit)));
        sentences.extend(self.attacks.map(AttackCounts::sentence));
        sentences.extend(self.rules());
        sentences
    }

    /// Returns when to take which kind.
    fn rules(&self) -> Vec<String> {
        let wakes = self.wakes.iter().map(|wake| (wake.name.as_str(), wake.us, MIN_US));
        let live = self.live_cpu_us.iter().map(|(name, us)| (name.as_str(), *us, MIN_US));
        let others = [
            ("host calls", self.host_call_ns, MIN_CALL_NS),
            ("memory of the first lambda", self.first_lambda_mb, MIN_MB),
            ("memory", self.further_lambda_mb, MIN_MB),
            ("starts", self.start_ms, MIN_START_MS),
            ("recovery from a fault", self.restarted_ms, MIN_RESTARTED_MS),
            ("recovery from a kill", self.killed_s, MIN_KILLED_S),
        ];
        let all = wakes.chain(live).chain(others);
        let criteria: Vec<Criterion<'_>> = all
            .filter_map(|(name, values, least)| {
                let (wasm, python) = values.wasm.zip(values.python)?;
                Some(Criterion { name, wasm, python, least })
            })
            .collect();
        let of = |better: Option<CheaperKind>| {
            let names = criteria.iter().filter(|it| it.better() == better).map(|it| it.name);
            names.collect::<Vec<_>>()
        };
        let [wasm, python, equal] =
            [Some(CheaperKind::Wasm), Some(CheaperKind::Python), None].map(of);
        let mut rules = Vec::new();
        if !wasm.is_empty() {
            rules.push(format!("So take wasm where these matter: {}.", listed(&wasm)));
        }
        if !python.is_empty() {
            rules.push(format!("So take Python where these matter: {}.", listed(&python)));
        }
        if !equal.is_empty() {
            rules
                .push(format!("The kind makes no difference that counts for: {}.", listed(&equal)));
        }
        match (wasm.is_empty(), python.is_empty()) {
            (false, true) => rules.push(
                "Nothing that was measured favours Python by a difference that counts: take it for \
                 its libraries, if its costs fit."
                    .to_owned(),
            ),
            (true, false) => rules.push(
                "Nothing that was measured favours wasm by a difference that counts: take it for code that you do not trust, \
                 which Python does not confine as well."
                    .to_owned(),
            ),
            _ => {}
        }
        rules
    }
}

impl Criterion<'_> {
    /// Returns the kind that costs less; `None` if a user would not notice the difference.
    fn better(&self) -> Option<CheaperKind> {
        let (low, high) = (self.wasm.min(self.python), self.wasm.max(self.python));
        let is_seen = high >= FACTOR * low && high - low >= self.least;
        is_seen.then_some(if self.wasm < self.python {
            CheaperKind::Wasm
        } else {
            CheaperKind::Python
        })
    }
}

impl WakeCosts {
    fn sentences(&self) -> Vec<String> {
        let name = &self.name;
        let times = match self.us.native {
            Some(native) => self.us.wasm.zip(self.us.python).map(|(wasm, python)| {
                format!(
                    "{name}: {} us as a native function, {} us in wasm ({} times) and {} us in \
                     Python ({} times).",
                    number(native),
                    number(wasm),
                    number(wasm / native),
                    number(python),
                    number(python / native)
                )
            }),
            None => self.us.sentence(&format!("{name}:"), "us"),
        };
        let cost = self.us.wasm.zip(self.us.python).and_then(|(wasm, python)| {
            let (slower, more_us) = match python > wasm {
                true => ("Python", python - wasm),
                false => ("wasm", wasm - python),
            };
            // One percent of a core.
            let rate_hz = 1e4 / more_us;
            let is_different = wasm.max(python) >= FACTOR * wasm.min(python);
            is_different.then(|| {
                format!(
                    "The {} us more in {slower} are 1 % of a core at {} such wakes in a second.",
                    number(more_us),
                    number(rate_hz)
                )
            })
        });
        let checks = self.checks.filter(|checks| checks.interval.is_some());
        let checks = checks.map(|checks| match checks.is_seen() {
            true => format!(
                "Fuel and epochs change the time of this wake by {:+.0} %.",
                100.0 * (checks.ratio - 1.0)
            ),
            false => "A cost of fuel and epochs was not seen in it.".to_owned(),
        });
        let text: Vec<String> = [times, cost, checks].into_iter().flatten().collect();
        if text.is_empty() { Vec::new() } else { vec![text.join(" ")] }
    }
}

impl KindValues {
    /// Returns a sentence about both kinds, if both were measured.
    fn sentence(&self, what: &str, unit: &str) -> Option<String> {
        let (wasm, python) = self.wasm.zip(self.python)?;
        let native = self
            .native
            .map_or_else(String::new, |native| format!("; {} {unit} natively", number(native)));
        Some(format!(
            "{what} {} {unit} in wasm and {} {unit} in Python ({} times{native}).",
            number(wasm),
            number(python),
            number(python / wasm)
        ))
    }
}

impl AttackCounts {
    fn sentence(self) -> String {
        let Self { compared, unseen } = self;
        let seen = match compared - unseen {
            0 => "and in none it was seen".to_owned(),
            seen => format!("and in {seen} it was seen"),
        };
        format!(
            "A misbehaving lambda on another core could not be distinguished from the noise of this machine \
             in {unseen} of {compared} comparisons, {seen}."
        )
    }
}

fn listed(names: &[&str]) -> String {
    names.join("; ")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn both(wasm: f64, python: f64) -> KindValues {
        KindValues { native: None, wasm: Some(wasm), python: Some(python) }
    }

    fn wake(us: KindValues, checks: Option<MeasuredDifference>) -> IsolationCosts {
        let wakes = vec![WakeCosts { name: "IMU".to_owned(), us, checks }];
        IsolationCosts { wakes, ..IsolationCosts::default() }
    }

    fn text(costs: &IsolationCosts) -> String {
        costs.recommendation().join("\n")
    }

    #[test]
    fn what_was_not_measured_is_left_out() {
        assert_eq!(IsolationCosts::default().recommendation(), Vec::<String>::new());
        let half = KindValues { native: Some(1.0), wasm: Some(2.0), python: None };
        let mut costs = wake(half, None);
        costs.further_lambda_mb = KindValues { wasm: Some(2.0), ..KindValues::default() };
        assert_eq!(costs.recommendation(), Vec::<String>::new());
    }

    #[test]
    fn a_wake_is_compared_with_native_code() {
        let us = KindValues { native: Some(10.0), ..both(12.0, 62.0) };
        let said = text(&wake(us, None));
        assert!(
            said.starts_with(
                "IMU: 10.00 us as a native function, 12.00 us in wasm (1.20 times) and 62.00 us in \
                 Python (6.20 times). The 50.00 us more in Python are 1 % of a core at 200 such \
                 wakes in a second."
            ),
            "{said}"
        );
        assert!(text(&wake(both(60.0, 10.0), None)).contains("The 50.00 us more in wasm are"));
        assert!(!text(&wake(both(10.0, 11.0), None)).contains("of a core"));
    }

    #[test]
    fn a_cost_of_checks_is_stated_only_if_it_is_seen() {
        let values = |from: f64| (0..100).map(|n| from + f64::from(n % 10)).collect::<Vec<_>>();
        let seen = MeasuredDifference::between(&values(100.0), &values(150.0));
        let said = text(&wake(both(1.0, 2.0), seen));
        assert!(said.contains("Fuel and epochs change the time of this wake by +48 %."), "{said}");
        let same = MeasuredDifference::between(&values(100.0), &values(100.0));
        let said = text(&wake(both(1.0, 2.0), same));
        assert!(said.contains("A cost of fuel and epochs was not seen in it."), "{said}");
        let few = MeasuredDifference::between(&[1.0], &[1.0]);
        assert!(!text(&wake(both(1.0, 2.0), few)).contains("Fuel and epochs"));
        assert!(!text(&wake(both(1.0, 2.0), few)).contains("fuel and epochs"));
    }

    #[test]
    fn the_rules_follow_from_the_numbers() {
        let mut costs = wake(both(10.0, 40.0), None);
        costs.further_lambda_mb = both(2.0, 15.0);
        costs.killed_s = both(1.1, 1.2);
        let said = text(&costs);
        assert!(said.contains("Each further lambda of the same kind takes 2.00 MB in wasm and 15"));
        assert!(said.contains("So take wasm where these matter: IMU; memory."), "{said}");
        assert!(said.contains("makes no difference that counts for: recovery from a kill."));
        assert!(said.contains("Nothing that was measured favours Python"), "{said}");

        // Three times as long, and less than a millisecond.
        costs.restarted_ms = both(0.3, 0.1);
        costs.live_cpu_us.push(("IMU, live".to_owned(), both(80.0, 200.0)));
        let said = text(&costs);
        assert!(said.contains("IMU, live, a wake takes of the CPU 80.00 us in wasm and 200 us in"));
        assert!(said.contains("take wasm where these matter: IMU; IMU, live; memory."), "{said}");
        assert!(said.contains("for: recovery from a fault; recovery from a kill."), "{said}");

        costs.start_ms = both(100.0, 50.0);
        let said = text(&costs);
        assert!(said.contains("So take Python where these matter: starts."), "{said}");
        assert!(!said.contains("Nothing that was measured"), "{said}");

        let said = text(&wake(both(40.0, 10.0), None));
        assert!(said.contains("So take Python where these matter: IMU."), "{said}");
        assert!(said.contains("Nothing that was measured favours wasm"), "{said}");

        let equal = text(&wake(both(10.0, 10.0), None));
        assert!(!equal.contains("So take") && !equal.contains("Nothing that"), "{equal}");
    }

    #[test]
    fn attacks_are_counted() {
        let of = |compared, unseen| {
            let attacks = Some(AttackCounts { compared, unseen });
            text(&IsolationCosts { attacks, ..IsolationCosts::default() })
        };
        assert!(of(52, 49).contains("in 49 of 52 comparisons, and in 3 it was seen."));
        assert!(of(4, 4).contains("in 4 of 4 comparisons, and in none it was seen."));
    }
}

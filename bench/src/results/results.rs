//! The results of one run of a benchmark, and their file.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io;
use std::path::Path;

use gleaner_base::{Exit, Failure, write_atomically};
use serde::{Deserialize, Serialize};

use crate::figure::Figure;
use crate::machine::Machine;

/// Version of the format of the JSON file.
const FORMAT: u32 = 2;

/// Facts that differ between the parts of a run that was resumed.
const CHANGING: [&str; 4] = ["load before", "load after", "measured", "options"];

/// Name of the file in the folder of a benchmark.
const FILE: &str = "results.json";

/// The measurements of one run of a benchmark.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct BenchResults {
    format: u32,
    /// The benchmark, as in `cargo xtask bench NAME`.
    pub bench: String,
    /// True for a smoke test: its values are not meaningful.
    pub is_quick: bool,
    /// False as long as the benchmark runs, and if it was ended or failed.
    pub is_complete: bool,
    /// The machine on which it ran.
    pub machine: Machine,
    /// Rows with a value for each run.
    pub figures: Vec<Figure>,
    /// Series that are compared with each other.
    pub groups: Vec<SeriesGroup>,
    /// Quantities that grow with others.
    pub growths: Vec<Growth>,
    /// Sentences that a reader needs to understand the tables.
    pub notes: Vec<String>,
}

/// Series under the same conditions.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SeriesGroup {
    /// The conditions.
    pub name: String,
    /// The unit of all values.
    pub unit: String,
    /// Names of the series that the others are compared with; one that is absent is ignored.
    pub bases: Vec<String>,
    /// The series.
    pub series: Vec<Series>,
}

/// Measurements of one kind, in the order in which they were made.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Series {
    /// The measured thing, for example one side of a comparison.
    pub name: String,
    /// Facts about it, for example its socket buffer.
    pub details: BTreeMap<String, String>,
    /// Numbers of messages; `None` if there were none to count.
    pub reception: Option<Reception>,
    /// All values.
    pub values: Vec<f64>,
    /// Numbers of values of each turn, in their order; none for a single turn.
    pub turns: Vec<usize>,
    /// Costs by name and unit, with a value for each turn.
    pub costs: BTreeMap<String, Vec<f64>>,
    /// Reasons why the values mean nothing; none for valid ones.
    pub invalid: Vec<String>,
}

/// Numbers of messages that were sent and answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reception {
    /// Number of messages that were sent.
    pub sent: u64,
    /// Number of those that were answered.
    pub answered: u64,
}

/// Curves over a common quantity, as the CPU time over the number of lambdas.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Growth {
    /// The measured quantity, and its conditions.
    pub name: String,
    /// The quantity that is set, in plural: `lambdas`.
    pub of: String,
    /// The unit of what is measured.
    pub unit: String,
    /// The curves.
    pub curves: Vec<GrowthCurve>,
}

/// A curve.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GrowthCurve {
    /// Its name.
    pub name: String,
    /// Pairs of the number that was set, and the measured value.
    pub points: Vec<[f64; 2]>,
}

impl BenchResults {
    /// Returns empty results of `bench` on this machine.
    pub fn new(bench: &str, is_quick: bool) -> Self {
        let mut machine = Machine::of_this();
        machine.add_load("load before");
        Self { format: FORMAT, bench: bench.to_owned(), is_quick, machine, ..Self::default() }
    }

    /// Returns whether all goals are met. They do not count in a quick run.
    pub fn is_good(&self) -> bool {
        self.is_quick || self.figures.iter().all(Figure::is_met)
    }

    /// Renames the results in `folder`, if there are some, to `previous.json`.
    ///
    /// # Errors
    ///
    /// A file that cannot be renamed.
    pub fn keep_previous(folder: &Path) -> Result<(), Failure> {
        match fs::rename(folder.join(FILE), folder.join("previous.json")) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                let message = format!("cannot rename `{}`", folder.join(FILE).display());
                Err(Failure::caused_by(Exit::Internal, message, &error)
                    .with_help("choose a folder that can be written: --out DIR"))
            }
            _ => Ok(()),
        }
    }

    /// Returns the facts of the machine, and of what is measured, that differ from those of an
    /// earlier part of the run; its load and the time may.
    pub fn changed_facts(&self, earlier: &Self) -> Vec<String> {
        let facts = |results: &Self| {
            let facts = results.machine.facts.clone().into_iter();
            facts.filter(|(name, _)| !CHANGING.contains(&name.as_str())).collect::<BTreeMap<_, _>>()
        };
        let (now, before) = (facts(self), facts(earlier));
        let names: BTreeSet<&String> = now.keys().chain(before.keys()).collect();
        let value = |facts: &BTreeMap<String, String>, name| {
            facts.get(name).map_or("unknown", String::as_str).to_owned()
        };
        names
            .into_iter()
            .filter(|name| now.get(*name) != before.get(*name))
            .map(|name| format!("{name}: {}, before {}", value(&now, name), value(&before, name)))
            .collect()
    }

    /// Writes `results.json` into `folder`, which it creates. Values that are not numbers, for
    /// which JSON has no form, are left out.
    ///
    /// # Errors
    ///
    /// A file that cannot be written.
    pub fn store(&self, folder: &Path) -> Result<(), Failure> {
        let path = folder.join(FILE);
        let mut measured = self.clone();
        for series in measured.groups.iter_mut().flat_map(|group| &mut group.series) {
            series.retain_finite();
            series.costs.values_mut().for_each(|values| values.retain(|value| value.is_finite()));
        }
        for curve in measured.growths.iter_mut().flat_map(|growth| &mut growth.curves) {
            curve.points.retain(|point| point.iter().all(|number| number.is_finite()));
        }
        let json = serde_json::to_vec(&measured).expect("results are plain data");
        fs::create_dir_all(folder).and_then(|()| write_atomically(&path, &json)).map_err(|error| {
            let message = format!("cannot write `{}`", path.display());
            Failure::caused_by(Exit::Internal, message, &error)
                .with_help("choose a folder that can be written: --out DIR")
        })
    }

    /// Reads the results in `folder`.
    ///
    /// # Errors
    ///
    /// A file that cannot be read, or has another format.
    pub fn read(folder: &Path) -> Result<Self, Failure> {
        let path = folder.join(FILE);
        let failed = |error: &dyn std::error::Error| {
            let message = format!("cannot read the results `{}`", path.display());
            Failure::caused_by(Exit::Usage, message, error)
                .with_help("name a folder that a benchmark of this version has written")
        };
        let text = fs::read(&path).map_err(|error| failed(&error))?;
        let results: Self = serde_json::from_slice(&text).map_err(|error| failed(&error))?;
        if results.format == FORMAT {
            return Ok(results);
        }
        let message = format!(
            "`{}` has format {}; this program reads {FORMAT}",
            path.display(),
            results.format
        );
        Err(Failure::new(Exit::Usage, message).with_help("measure again into another folder"))
    }
}

impl Series {
    /// Keeps the values that are numbers, and their turns.
    fn retain_finite(&mut self) {
        let mut values = self.values.iter();
        for turn in &mut self.turns {
            *turn = values.by_ref().take(*turn).filter(|value| value.is_finite()).count();
        }
        self.values.retain(|value| value.is_finite());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    #[test]
    fn results_are_stored_and_read_without_what_was_not_measured() {
        let folder = TestFolder::new();
        let mut results = BenchResults::new("rtt", false);
        results.figures.push(Figure::at_most("wake", "us", 20.0, &[18.0, f64::NAN]));
        let costs = [("CPU".to_owned(), vec![f64::NAN, 2.0])].into();
        let values = vec![1.0, f64::INFINITY, 3.0];
        let turns = vec![2, 1];
        let series = Series { name: "bare".to_owned(), values, turns, costs, ..Series::default() };
        results.groups.push(SeriesGroup { series: vec![series], ..SeriesGroup::default() });
        let points = vec![[1.0, 2.0], [2.0, f64::NAN]];
        let curves = vec![GrowthCurve { name: "wasm".to_owned(), points }];
        let [name, of, unit] = ["CPU", "lambdas", "%"].map(str::to_owned);
        results.growths.push(Growth { name, of, unit, curves });
        results.store(&folder.path("deep/er")).unwrap();
        let read = BenchResults::read(&folder.path("deep/er")).unwrap();
        results.groups[0].series[0].values = vec![1.0, 3.0];
        results.groups[0].series[0].turns = vec![1, 1];
        results.groups[0].series[0].costs.insert("CPU".to_owned(), vec![2.0]);
        results.growths[0].curves[0].points.truncate(1);
        assert_eq!(read, results);
        assert!(!read.is_good() && read.figures[0].values == [Some(18.0), None]);
    }

    #[test]
    fn a_run_goes_on_only_on_the_same_machine_and_revision() {
        let mut before = BenchResults::new("rtt", false);
        let now = before.clone();
        before.machine.add("load before", Some("9".to_owned()));
        assert_eq!(now.changed_facts(&before), [""; 0]);
        before.machine.add("revision", Some("abc".to_owned()));
        before.machine.facts.remove("kernel");
        let changed = now.changed_facts(&before);
        assert!(changed[0].starts_with("kernel: ") && changed[0].ends_with(", before unknown"));
        assert_eq!(changed[1..], ["revision: unknown, before abc"]);
    }

    #[test]
    fn other_files_are_refused_with_the_reason() {
        let folder = TestFolder::new();
        let refused = || BenchResults::read(folder.root()).unwrap_err().to_string();
        assert!(refused().contains(FILE));
        fs::write(folder.path(FILE), "{}").unwrap();
        assert!(refused().contains("missing field"));
        let mut later = serde_json::to_value(BenchResults::new("rtt", true)).unwrap();
        later["format"] = 3.into();
        fs::write(folder.path(FILE), later.to_string()).unwrap();
        assert!(refused().contains("has format 3"));
    }
}

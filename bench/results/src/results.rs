//! The results of one run of a benchmark, and their files.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use gleaner_base::{Exit, Failure, write_atomically};
use serde::{Deserialize, Serialize};

use crate::figure::Figure;
use crate::growth::Growth;
use crate::machine::Machine;
use crate::statistics::Summary;

/// Version of the format of the JSON file.
const FORMAT: u32 = 1;

/// The measurements of one run of a benchmark.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct BenchResults {
    format: u32,
    /// The benchmark, as in `cargo xtask bench NAME`.
    pub bench: String,
    /// True for a smoke test: its values are not meaningful.
    pub is_quick: bool,
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
    /// Sentences that follow from the numbers, for a reader who has to decide.
    #[serde(default)]
    pub recommendation: Vec<String>,
}

/// Series under the same conditions.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct SeriesGroup {
    /// The conditions.
    pub name: String,
    /// The unit of all values.
    pub unit: String,
    /// Name of the series that the others are compared with.
    pub base: Option<String>,
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
}

/// Numbers of messages that were sent and answered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub struct Reception {
    /// Number of messages that were sent.
    pub sent: u64,
    /// Number of those that were answered.
    pub answered: u64,
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

    /// Writes `results.json`, `results.md` and `report.html` into `folder`, which it creates.
    ///
    /// # Errors
    ///
    /// A file that cannot be written.
    pub fn store(&self, folder: &Path) -> Result<(), Failure> {
        let failed = |path: &Path, error| {
            let message = format!("cannot write `{}`", path.display());
            Failure::caused_by(Exit::Internal, message, &error)
                .with_help("choose a folder that can be written: --out DIR")
        };
        fs::create_dir_all(folder).map_err(|error| failed(folder, error))?;
        let json = serde_json::to_vec(&self.measured()).expect("results are plain data");
        let files =
            [("results.json", json), ("results.md", self.to_markdown().into_bytes())].into_iter();
        for (name, content) in files.chain([("report.html", self.to_html().into_bytes())]) {
            let path = folder.join(name);
            write_atomically(&path, &content).map_err(|error| failed(&path, error))?;
        }
        Ok(())
    }

    /// Returns the results without values that are no numbers, for which JSON has no form.
    fn measured(&self) -> Self {
        let mut measured = self.clone();
        for series in measured.groups.iter_mut().flat_map(|group| &mut group.series) {
            series.values.retain(|value| value.is_finite());
        }
        for curve in measured.growths.iter_mut().flat_map(|growth| &mut growth.curves) {
            curve.points.retain(|point| point.iter().all(|number| number.is_finite()));
        }
        measured
    }

    /// Reads the results in a file or a folder. A folder with a folder for each of several runs has
    /// one value for each run, its median, in the order of their names: values of a run are not
    /// independent of each other, as the speed of the machine differs between runs.
    ///
    /// # Errors
    ///
    /// A file that cannot be read, or has no such results, or those of another benchmark than the
    /// first.
    pub fn read(path: &Path) -> Result<Self, Failure> {
        let own = path.join("results.json");
        let mut runs = match fs::read_dir(path) {
            Ok(entries) if !own.is_file() => {
                entries.flatten().map(|entry| entry.path().join("results.json")).collect()
            }
            Ok(_) => vec![own.clone()],
            Err(_) => vec![path.to_owned()],
        };
        runs.retain(|run| run.is_file());
        runs.sort();
        let Some((first, others)) = runs.split_first() else {
            return Self::read_file(if path.is_dir() { &own } else { path });
        };
        let mut all = Self::read_file(first)?;
        if !others.is_empty() {
            all.keep_medians();
        }
        for run in others {
            let mut other = Self::read_file(run)?;
            other.keep_medians();
            if (&other.bench, other.is_quick) != (&all.bench, all.is_quick) {
                let message = format!("`{}` is no run of the same benchmark", run.display());
                return Err(Failure::new(Exit::Usage, message)
                    .with_help("compare runs of one benchmark, all of them quick or none"));
            }
            all.add_run(other);
        }
        Ok(all)
    }

    /// Keeps the median of each row and series, as one value.
    fn keep_medians(&mut self) {
        for figure in &mut self.figures {
            let values: Vec<f64> = figure.values.iter().copied().flatten().collect();
            figure.values = vec![Summary::of(&values).map(|summary| summary.median)];
        }
        for series in self.groups.iter_mut().flat_map(|group| &mut group.series) {
            series.values = Summary::of(&series.values).iter().map(|it| it.median).collect();
        }
    }

    /// Adds the values of another run to the rows and series of the same name.
    fn add_run(&mut self, run: Self) {
        for figure in run.figures {
            let is_it = |own: &&mut Figure| (&own.name, &own.unit) == (&figure.name, &figure.unit);
            match self.figures.iter_mut().find(is_it) {
                Some(own) => own.values.extend(figure.values),
                None => self.figures.push(figure),
            }
        }
        for group in run.groups {
            let is_it =
                |own: &&mut SeriesGroup| (&own.name, &own.unit) == (&group.name, &group.unit);
            let Some(own) = self.groups.iter_mut().find(is_it) else {
                self.groups.push(group);
                continue;
            };
            for series in group.series {
                match own.series.iter_mut().find(|own| own.name == series.name) {
                    Some(own) => own.values.extend(series.values),
                    None => own.series.push(series),
                }
            }
        }
    }

    fn read_file(path: &Path) -> Result<Self, Failure> {
        let failed = |error: &dyn std::error::Error| {
            let message = format!("cannot read the results `{}`", path.display());
            Failure::caused_by(Exit::Usage, message, error).with_help(
                "name a folder with results, or the results.json in it; revisions are compared \
                     with a third argument, the name of a benchmark",
            )
        };
        let text = fs::read(path).map_err(|error| failed(&error))?;
        let results: Self = serde_json::from_slice(&text).map_err(|error| failed(&error))?;
        if results.format != FORMAT {
            let message = format!(
                "`{}` has format {}; this program reads {FORMAT}",
                path.display(),
                results.format
            );
            return Err(Failure::new(Exit::Usage, message)
                .with_help("measure again, or compare with the program that wrote it"));
        }
        Ok(results)
    }
}

impl SeriesGroup {
    /// Returns the series that the others are compared with.
    pub fn base(&self) -> Option<&Series> {
        let base = self.base.as_ref()?;
        self.series.iter().find(|series| series.name == *base)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::growth::GrowthCurve;
    use gleaner_test_support::TestFolder;

    /// Results with a table and a comparison; `shift` is added to the times of wasm.
    pub(crate) fn example(shift: f64) -> BenchResults {
        let series = |name: &str, from: f64| Series {
            name: name.to_owned(),
            details: [("stack".to_owned(), "RustDDS <1>".to_owned())].into(),
            reception: Some(Reception { sent: 201, answered: 200 }),
            values: (0..200).map(|n| from + f64::from((n * 37) % 100) / 100.0).collect(),
        };
        let mut results = BenchResults::new("rtt", false);
        results.figures.push(Figure::at_most("wake", "us", 20.0, &[18.0, 19.0, 21.0]));
        results.groups.push(SeriesGroup {
            name: "IMU | 100 Hz".to_owned(),
            unit: "ms".to_owned(),
            base: Some("bare".to_owned()),
            series: vec![series("bare", 1.0), series("wasm", 1.5 + shift)],
        });
        results.notes.push("A note.".to_owned());
        results.recommendation.push("Take one.".to_owned());
        results
    }

    #[test]
    fn results_with_values_that_were_not_measured_can_be_read() {
        let folder = TestFolder::new();
        let mut results = example(0.0);
        results.groups[0].series[0].values.push(f64::NAN);
        let points = vec![[1.0, 2.0], [2.0, f64::INFINITY]];
        let curves = vec![GrowthCurve { name: "wasm".to_owned(), points }];
        let [name, of, unit] = ["CPU", "lambdas", "%"].map(str::to_owned);
        results.growths.push(Growth { name, of, unit, curves });
        results.store(folder.root()).unwrap();
        let read = BenchResults::read(folder.root()).unwrap();
        assert_eq!(read.groups[0].series[0].values.len(), 200);
        assert_eq!(read.growths[0].curves[0].points, [[1.0, 2.0]]);
    }

    #[test]
    fn several_runs_are_read_as_one() {
        let folder = TestFolder::new();
        let path = folder.path("base");
        let mut other = example(0.5);
        other.figures.push(Figure::without_goal("new", "s", &[1.0]));
        for (name, run) in [("002", &other), ("001", &example(0.0))] {
            run.store(&path.join(name)).unwrap();
        }
        let all = BenchResults::read(&path).unwrap();
        assert_eq!(all.figures.len(), 2);
        assert_eq!(all.figures[0].values, [Some(19.0); 2]);
        let wasm = &all.groups[0].series[1].values;
        assert!(wasm.len() == 2 && (wasm[1] - wasm[0] - 0.5).abs() < 1e-9, "{wasm:?}");
        other.bench = "scale".to_owned();
        other.store(&path.join("003")).unwrap();
        let error = BenchResults::read(&path).unwrap_err().to_string();
        assert!(error.contains("003") && error.contains("same benchmark"), "{error}");
        let error = BenchResults::read(folder.root()).unwrap_err().to_string();
        assert!(error.contains("results.json"), "{error}");
    }

    #[test]
    fn results_are_stored_and_read_again() {
        let folder = TestFolder::new();
        let results = example(0.0);
        let path = folder.path("deep/er");
        results.store(&path).unwrap();
        assert_eq!(BenchResults::read(&path).unwrap(), results);
        assert_eq!(BenchResults::read(&path.join("results.json")).unwrap(), results);
        let page = fs::read_to_string(path.join("report.html")).unwrap();
        assert!(page.contains("RustDDS \\u003c1\\u003e") && !page.contains("RustDDS <1>"));
        let text = fs::read_to_string(path.join("results.md")).unwrap();
        assert!(text.contains("| bare | 200 of 201 | 1.00 |"), "{text}");
        assert!(text.contains("| wasm | 1.33"), "{text}");
        assert!(text.ends_with("- A note.\n\n## Recommendation\n\n- Take one.\n"), "{text}");
    }

    #[test]
    fn other_files_are_refused_with_the_reason() {
        let folder = TestFolder::new();
        let path = folder.path("results.json");
        assert!(BenchResults::read(&path).unwrap_err().to_string().contains("results.json"));
        fs::write(&path, "{}").unwrap();
        assert!(BenchResults::read(&path).unwrap_err().to_string().contains("missing field"));
        let mut later = serde_json::to_value(example(0.0)).unwrap();
        later["format"] = 2.into();
        fs::write(&path, later.to_string()).unwrap();
        assert!(BenchResults::read(&path).unwrap_err().to_string().contains("has format 2"));
    }
}

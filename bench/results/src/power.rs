//! The power that the machine takes, where it has sensors: energy counters of x86 processors (RAPL,
//! which only root may read on most systems), and the sensors of the rails of a Jetson (INA3221).
//! It is never estimated.

use std::fs;
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Interval of reading sensors of momentary values.
const INTERVAL: Duration = Duration::from_millis(200);

/// The sensors that this process may read.
#[derive(Debug, Default)]
pub struct PowerMeter {
    counters: Vec<EnergyCounter>,
    rails: Vec<Rail>,
}

#[derive(Debug)]
struct EnergyCounter {
    name: String,
    /// In uJ.
    file: PathBuf,
    /// Value at which it starts again, in uJ.
    range: u64,
}

/// A rail with sensors of its voltage and current.
#[derive(Debug)]
struct Rail {
    name: String,
    /// In mV.
    voltage: PathBuf,
    /// In mA.
    current: PathBuf,
}

impl PowerMeter {
    /// Finds the sensors of this machine.
    pub fn of_this_machine() -> Self {
        Self::below(Path::new("/sys/class"))
    }

    fn below(class: &Path) -> Self {
        let mut meter = Self::default();
        for zone in folders(&class.join("powercap")) {
            // `intel-rapl:0` is a processor, `intel-rapl:0:1` a part of it.
            let is_whole = zone.to_string_lossy().matches(':').count() == 1;
            let file = zone.join("energy_uj");
            if let (true, Some(name), Some(range), Some(_)) = (
                is_whole,
                text(&zone.join("name")),
                number(&zone.join("max_energy_range_uj")),
                number(&file),
            ) {
                meter.counters.push(EnergyCounter { name, file, range });
            }
        }
        for chip in folders(&class.join("hwmon")) {
            if text(&chip.join("name")).as_deref() != Some("ina3221") {
                continue;
            }
            for channel in 1..=3 {
                let name = text(&chip.join(format!("in{channel}_label")));
                let [voltage, current] =
                    ["in", "curr"].map(|what| chip.join(format!("{what}{channel}_input")));
                if let (Some(name), Some(_), Some(_)) = (name, number(&voltage), number(&current)) {
                    meter.rails.push(Rail { name, voltage, current });
                }
            }
        }
        meter
    }

    /// Returns whether there is a sensor.
    pub fn is_available(&self) -> bool {
        !self.counters.is_empty() || !self.rails.is_empty()
    }

    /// Waits for `time`, and calls `look` with the elapsed time now and then. Returns the mean
    /// power meanwhile of each part that has a sensor, in W.
    pub fn watch(&self, time: Duration, mut look: impl FnMut(Duration)) -> Vec<(String, f64)> {
        let began = Instant::now();
        let energy = || -> Vec<Option<u64>> {
            self.counters.iter().map(|counter| number(&counter.file)).collect()
        };
        let before = energy();
        let mut watts: Vec<Vec<f64>> = vec![Vec::new(); self.rails.len()];
        loop {
            let left = time.saturating_sub(began.elapsed());
            if left.is_zero() {
                break;
            }
            sleep(left.min(INTERVAL));
            look(began.elapsed());
            for (values, rail) in watts.iter_mut().zip(&self.rails) {
                values.extend(rail.watts());
            }
        }
        let seconds = began.elapsed().as_secs_f64();
        let counters = self.counters.iter().zip(before.into_iter().zip(energy()));
        let of_counters = counters.filter_map(|(counter, (before, after))| {
            let used = counter.between(before?, after?);
            Some((counter.name.clone(), used as f64 / 1e6 / seconds))
        });
        let of_rails = self.rails.iter().zip(&watts).filter(|(_, values)| !values.is_empty());
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        of_counters
            .chain(of_rails.map(|(rail, values)| (rail.name.clone(), mean(values))))
            .collect()
    }
}

impl EnergyCounter {
    /// Energy from one value to a later one, in uJ. It starts again less than once in a minute.
    fn between(&self, before: u64, after: u64) -> u64 {
        if after < before { (self.range - before.min(self.range)) + after } else { after - before }
    }
}

impl Rail {
    fn watts(&self) -> Option<f64> {
        Some(number(&self.voltage)? as f64 * number(&self.current)? as f64 / 1e6)
    }
}

/// The folders in `folder`, in the order of their names.
fn folders(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut folders: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    folders.sort();
    folders
}

fn text(file: &Path) -> Option<String> {
    Some(fs::read_to_string(file).ok()?.trim().to_owned())
}

fn number(file: &Path) -> Option<u64> {
    text(file)?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    #[test]
    fn power_is_read_from_counters_and_rails() {
        let class = TestFolder::new();
        for (file, content) in [
            ("powercap/intel-rapl:0/name", "package-0\n"),
            ("powercap/intel-rapl:0/max_energy_range_uj", "1000000\n"),
            ("powercap/intel-rapl:0/energy_uj", "900000\n"),
            ("powercap/intel-rapl:0:0/name", "core\n"),
            ("powercap/intel-rapl:0:0/max_energy_range_uj", "1000000\n"),
            ("powercap/intel-rapl:0:0/energy_uj", "5\n"),
            ("hwmon/hwmon1/name", "ina3221\n"),
            ("hwmon/hwmon1/in1_label", "VDD_IN\n"),
            ("hwmon/hwmon1/in1_input", "5000\n"),
            ("hwmon/hwmon1/curr1_input", "1500\n"),
            ("hwmon/hwmon1/in2_label", "not connected\n"),
            ("hwmon/hwmon2/name", "coretemp\n"),
        ] {
            class.write(file, content);
        }
        let meter = PowerMeter::below(class.root());
        assert!(meter.is_available());
        let mut looks = 0;
        let energy = class.path("powercap/intel-rapl:0/energy_uj");
        let watts = meter.watch(Duration::from_millis(250), |_| {
            looks += 1;
            fs::write(&energy, "100000\n").unwrap();
        });
        assert!(looks >= 2, "{looks}");
        let [(package, power), (rail, rail_power)] = &watts[..] else { panic!("{watts:?}") };
        assert_eq!((package.as_str(), rail.as_str(), *rail_power), ("package-0", "VDD_IN", 7.5));
        // 0.2 J in 0.25 s or more.
        assert!(*power > 0.0 && *power <= 0.8, "{power}");
    }

    #[test]
    fn without_sensors_there_is_no_power() {
        let meter = PowerMeter::below(TestFolder::new().root());
        assert!(!meter.is_available());
        assert_eq!(meter.watch(Duration::from_millis(1), |_| {}), []);
    }
}

//! The energy that the machine takes, where it has sensors: energy counters of x86 processors
//! (RAPL, which only root may read on most systems), and the sensors of the rails of a Jetson
//! (INA3221). It is never estimated.

use std::path::PathBuf;
use std::thread::sleep;
use std::time::{Duration, Instant};

use crate::machine::{files, number, sysfs, text};

/// Interval of reading sensors of momentary values. A reading of one rail takes some 1 ms of I2C.
const INTERVAL: Duration = Duration::from_millis(100);

/// The sensors that this process may read.
#[derive(Debug, Default)]
pub struct EnergyMeter {
    counters: Vec<EnergyCounter>,
    rails: Vec<Rail>,
}

/// The energy of a part of the machine.
#[derive(Debug, Clone, PartialEq)]
pub struct PartEnergy {
    /// The part, as its sensor names it.
    pub part: String,
    /// In J.
    pub joules: f64,
    /// The mean power in W.
    pub watts: f64,
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

/// A measurement that has begun.
struct Measuring<'a> {
    meter: &'a EnergyMeter,
    began: Duration,
    counted: Vec<Option<u64>>,
    rails: Vec<RailEnergy>,
}

/// The power of a rail over time, by the trapezoidal rule.
#[derive(Default)]
struct RailEnergy {
    last: Option<(Duration, f64)>,
    joules: f64,
}

impl EnergyMeter {
    /// Finds the sensors of this machine.
    pub fn of_this_machine() -> Self {
        Self::below(sysfs())
    }

    fn below(sysfs: PathBuf) -> Self {
        let mut meter = Self::default();
        for zone in files(&sysfs.join("class/powercap")) {
            // `intel-rapl:0` is a processor, `intel-rapl:0:1` a part of it.
            let name = zone.file_name().unwrap_or_default().to_string_lossy().into_owned();
            // `intel-rapl-mmio:0` is the same processor by another way.
            let is_whole = name.matches(':').count() == 1 && !name.contains("mmio");
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
        for chip in files(&sysfs.join("class/hwmon")) {
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

    /// Waits for `time`, and calls `look` with the elapsed time now and then. Returns the energy
    /// meanwhile of each part that has a sensor.
    pub fn watch(&self, time: Duration, mut look: impl FnMut(Duration)) -> Vec<PartEnergy> {
        let began = Instant::now();
        let mut measuring = self.begin(Duration::ZERO);
        loop {
            let left = time.saturating_sub(began.elapsed());
            if left.is_zero() {
                return measuring.end(began.elapsed());
            }
            sleep(left.min(INTERVAL));
            look(began.elapsed());
            measuring.sample(began.elapsed());
        }
    }

    fn begin(&self, at: Duration) -> Measuring<'_> {
        let counted = self.counters.iter().map(|counter| number(&counter.file)).collect();
        let rails = self.rails.iter().map(|_| RailEnergy::default()).collect();
        let mut measuring = Measuring { meter: self, began: at, counted, rails };
        measuring.sample(at);
        measuring
    }
}

impl Measuring<'_> {
    fn sample(&mut self, at: Duration) {
        for (energy, rail) in self.rails.iter_mut().zip(&self.meter.rails) {
            let Some(watts) = rail.watts() else { continue };
            if let Some((before, watts_before)) = energy.last {
                let seconds = at.saturating_sub(before).as_secs_f64();
                energy.joules += seconds * f64::midpoint(watts_before, watts);
            }
            energy.last = Some((at, watts));
        }
    }

    fn end(self, at: Duration) -> Vec<PartEnergy> {
        let span = at.saturating_sub(self.began).as_secs_f64();
        let counters = self.meter.counters.iter().zip(&self.counted);
        let of_counters = counters.filter_map(|(counter, before)| {
            let used = counter.between((*before)?, number(&counter.file)?);
            Some((counter.name.clone(), used as f64 / 1e6, span))
        });
        let rails = self.meter.rails.iter().zip(&self.rails);
        let of_rails = rails.filter_map(|(rail, energy)| {
            // Of the time between its first and its last reading.
            let measured = energy.last?.0.saturating_sub(self.began).as_secs_f64();
            Some((rail.name.clone(), energy.joules, measured))
        });
        let all = of_counters.chain(of_rails).filter(|(.., seconds)| *seconds > 0.0);
        all.map(|(part, joules, seconds)| PartEnergy { part, joules, watts: joules / seconds })
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

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    fn rail(sysfs: &TestFolder, watts: f64) {
        sysfs.write("class/hwmon/hwmon1/name", "ina3221\n");
        sysfs.write("class/hwmon/hwmon1/in1_label", "VDD_IN\n");
        sysfs.write("class/hwmon/hwmon1/in1_input", "5000\n");
        sysfs.write("class/hwmon/hwmon1/curr1_input", &format!("{:.0}\n", watts * 1e6 / 5000.0));
        sysfs.write("class/hwmon/hwmon1/in2_label", "not connected\n");
        sysfs.write("class/hwmon/hwmon2/name", "coretemp\n");
    }

    #[test]
    fn a_rail_whose_power_rises_and_pulses_has_its_energy_within_one_percent() {
        let sysfs = TestFolder::new();
        // Rises from 5 W to 15 W in 10 s: 100 J. Then a pulse of 40 W in each second, 0.3 s long,
        // over 10 W, for 10 s: 190 J.
        let power = |ms: u64| match ms {
            0..10_000 => 5.0 + ms as f64 / 1000.0,
            _ if ms % 1000 < 300 => 40.0,
            _ => 10.0,
        };
        rail(&sysfs, power(0));
        let meter = EnergyMeter::below(sysfs.path(""));
        let mut measuring = meter.begin(Duration::from_secs(3));
        let mut ms = 0;
        while ms < 20_000 {
            // A reading was late now and then, by 150 ms, while the power rose.
            ms += if ms < 10_000 && ms % 1000 == 500 { 250 } else { 50 };
            rail(&sysfs, power(ms));
            measuring.sample(Duration::from_secs(3) + Duration::from_millis(ms));
        }
        let [energy] = &measuring.end(Duration::from_secs(23))[..] else { panic!() };
        assert_eq!(energy.part, "VDD_IN");
        assert!((energy.joules - 290.0).abs() < 2.9, "{energy:?}");
        assert!((energy.watts - energy.joules / 20.0).abs() < 1e-9, "{energy:?}");
    }

    #[test]
    fn a_counter_that_starts_again_has_its_energy() {
        let sysfs = TestFolder::new();
        for (file, content) in [
            ("intel-rapl:0/name", "package-0\n"),
            ("intel-rapl:0/max_energy_range_uj", "1000000\n"),
            ("intel-rapl:0/energy_uj", "900000\n"),
            ("intel-rapl:0:0/name", "core\n"),
            ("intel-rapl:0:0/max_energy_range_uj", "1000000\n"),
            ("intel-rapl:0:0/energy_uj", "5\n"),
            ("intel-rapl-mmio:0/name", "package-0\n"),
            ("intel-rapl-mmio:0/max_energy_range_uj", "1000000\n"),
            ("intel-rapl-mmio:0/energy_uj", "5\n"),
        ] {
            sysfs.write(&format!("class/powercap/{file}"), content);
        }
        let meter = EnergyMeter::below(sysfs.path(""));
        let measuring = meter.begin(Duration::ZERO);
        sysfs.write("class/powercap/intel-rapl:0/energy_uj", "100000\n");
        let part = "package-0".to_owned();
        let energy = PartEnergy { part, joules: 0.2, watts: 0.1 };
        assert_eq!(measuring.end(Duration::from_secs(2)), [energy]);
        let mut looks = 0;
        assert_eq!(meter.watch(Duration::from_millis(1), |_| looks += 1).len(), 1);
        assert!(looks > 0);
    }

    #[test]
    fn without_sensors_there_is_no_energy() {
        let meter = EnergyMeter::below(TestFolder::new().path(""));
        assert!(!meter.is_available());
        assert_eq!(meter.watch(Duration::from_millis(1), |_| {}), []);
    }
}

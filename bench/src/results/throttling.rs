//! Signs that the machine slows its cores down, since they are hot or take too much power: what was
//! measured meanwhile is invalid.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use crate::machine::{files, number, sysfs, text};

/// Counters of throttling, the state of cooling, temperature and clock at one moment.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Throttling {
    counts: BTreeMap<String, u64>,
    /// States of devices that cool by lower clocks; 0 is no cooling.
    cooling: BTreeMap<String, u64>,
    /// The temperature of the hottest zone, in degrees Celsius.
    pub temperature: Option<f64>,
    /// The lowest clock of a core, in MHz.
    pub clock_mhz: Option<f64>,
}

impl Throttling {
    /// Reads the state of this machine.
    pub fn now() -> Self {
        Self::below(&sysfs())
    }

    fn below(sysfs: &Path) -> Self {
        let cores = files(&sysfs.join("devices/system/cpu"));
        let mut state = Self::default();
        for core in &cores {
            for kind in ["core", "package"] {
                state.count(core, &format!("thermal_throttle/{kind}_throttle_count"));
            }
        }
        // Over-current of a Jetson.
        for chip in files(&sysfs.join("class/hwmon")) {
            (1..=3).for_each(|number| state.count(&chip, &format!("oc{number}_event_cnt")));
        }
        for device in files(&sysfs.join("class/thermal")) {
            let kind = text(&device.join("type")).unwrap_or_default();
            let slows = ["cpu", "Processor", "throttle"].iter().any(|word| kind.contains(word));
            if let Some(level) = number(&device.join("cur_state")).filter(|_| slows) {
                state.cooling.insert(format!("{kind} ({})", name(&device)), level);
            }
        }
        let highest = |values: Vec<u64>| values.into_iter().max();
        let zones = files(&sysfs.join("class/thermal"));
        let hottest = highest(zones.iter().filter_map(|zone| number(&zone.join("temp"))).collect());
        state.temperature = hottest.map(|millidegrees| millidegrees as f64 / 1000.0);
        let clock = |core: &PathBuf| number(&core.join("cpufreq/scaling_cur_freq"));
        state.clock_mhz = cores.iter().filter_map(clock).min().map(|khz| khz as f64 / 1000.0);
        state
    }

    fn count(&mut self, folder: &Path, file: &str) {
        if let Some(count) = number(&folder.join(file)) {
            self.counts.insert(format!("{}/{file}", name(folder)), count);
        }
    }

    /// Returns the reasons why what was measured since `earlier` is invalid.
    pub fn since(&self, earlier: &Self) -> Vec<String> {
        let counts = self.counts.iter().filter_map(|(name, count)| {
            let grown = count.saturating_sub(*earlier.counts.get(name)?);
            (grown > 0).then(|| format!("throttled {grown} times ({name})"))
        });
        let cooling = self.cooling.iter().filter_map(|(name, level)| {
            let highest = *level.max(earlier.cooling.get(name).unwrap_or(level));
            (highest > 0).then(|| format!("slowed down by {name}, level {highest}"))
        });
        counts.chain(cooling).collect()
    }
}

fn name(folder: &Path) -> String {
    folder.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use gleaner_test_support::TestFolder;

    #[test]
    fn counters_that_grow_and_active_cooling_are_reasons() {
        let sysfs = TestFolder::new();
        let core = "devices/system/cpu/cpu0";
        let count = format!("{core}/thermal_throttle/core_throttle_count");
        for (file, content) in [
            (count.as_str(), "7\n"),
            ("devices/system/cpu/cpu0/cpufreq/scaling_cur_freq", "1510400\n"),
            ("devices/system/cpu/cpu1/cpufreq/scaling_cur_freq", "729600\n"),
            ("class/hwmon/hwmon3/oc1_event_cnt", "0\n"),
            ("class/thermal/thermal_zone0/type", "cpu-thermal\n"),
            ("class/thermal/thermal_zone0/temp", "61500\n"),
            ("class/thermal/thermal_zone1/temp", "48000\n"),
            ("class/thermal/cooling_device0/type", "pwm-fan\n"),
            ("class/thermal/cooling_device0/cur_state", "3\n"),
            ("class/thermal/cooling_device1/type", "thermal-cpufreq-0\n"),
            ("class/thermal/cooling_device1/cur_state", "0\n"),
        ] {
            sysfs.write(file, content);
        }
        let before = Throttling::below(sysfs.root());
        assert_eq!((before.temperature, before.clock_mhz), (Some(61.5), Some(729.6)));
        assert_eq!(before.since(&before), [""; 0]);
        sysfs.write(&count, "9\n");
        sysfs.write("class/hwmon/hwmon3/oc1_event_cnt", "1\n");
        sysfs.write("class/thermal/cooling_device1/cur_state", "2\n");
        let after = Throttling::below(sysfs.root());
        let reasons = [
            "throttled 2 times (cpu0/thermal_throttle/core_throttle_count)",
            "throttled 1 times (hwmon3/oc1_event_cnt)",
            "slowed down by thermal-cpufreq-0 (cooling_device1), level 2",
        ];
        assert_eq!(after.since(&before), reasons);
    }
}

//! Fuzzes manifests. An input is the text of a manifest.

use gleaner_base::{ByteSize, Explain, Failure, format_duration, parse_duration};
use gleaner_lambda::manifest::{ConfigSet, ConfigValue, Limits, Manifest, ScheduleSpec, bounds};

use crate::budget;

/// Memory budget: parsed TOML takes a multiple of its text.
const MEMORY: usize = 32 << 20;

/// Longest error message about a manifest: a few lists of names, each name cut to 80 characters.
const MESSAGE_MAX: usize = 64 << 10;

/// Parses the text. An accepted manifest is within all bounds; the error of a rejected one can be
/// printed safely.
pub fn check(data: &[u8]) -> bool {
    let Ok(text) = std::str::from_utf8(data) else { return false };
    match budget::within(MEMORY, || Manifest::parse(text, "lambda.toml")) {
        Ok(manifest) => {
            accepted(&manifest);
            assert_eq!(Manifest::parse(text, "lambda.toml").ok(), Some(manifest), "parsed again");
            true
        }
        Err(error) => {
            let _ = error.exit();
            let shown = budget::within(MEMORY, || Failure::from(error).to_string());
            assert!(shown.len() <= MESSAGE_MAX, "a message of {} bytes", shown.len());
            let is_escape = |character: char| character.is_control() && character != '\n';
            assert!(!shown.contains(is_escape), "a message with control characters: {shown:?}");
            false
        }
    }
}

fn accepted(manifest: &Manifest) {
    assert!(
        manifest.inputs.len() <= bounds::ITEMS_MAX && manifest.models.len() <= bounds::ITEMS_MAX
    );
    assert!(manifest.config.len() <= bounds::ITEMS_MAX);
    let memory = manifest.inputs.iter().map(|input| input.memory().bytes()).sum::<u64>();
    assert!(memory <= bounds::INPUTS_MEMORY_MAX.bytes(), "{memory} bytes of inputs");
    match &manifest.schedule {
        ScheduleSpec::Event { .. } => {
            assert!(manifest.event_input().is_some(), "woken by an input that does not exist")
        }
        ScheduleSpec::Periodic { period } => {
            assert!(bounds::PERIOD.contains(period) && reads_back(*period))
        }
    }
    for input in &manifest.inputs {
        assert!(manifest.input(input.name.as_str()) == Some(input), "two inputs with one name");
        assert!(input.depth >= 1 && input.slots() > input.depth);
        assert_eq!(input.max_size.to_string().parse::<ByteSize>().ok(), Some(input.max_size));
        assert_eq!(input.decoded_size.is_some(), input.type_name.is_compressed_image());
    }
    if let Some(record) = &manifest.record {
        assert!(!record.topics.is_empty() && record.topics.len() <= bounds::ITEMS_MAX);
        assert!(
            [record.preroll, record.postroll, record.cooldown, record.max_length]
                .into_iter()
                .all(reads_back)
        );
    }
    assert!(
        (Limits::MIN.fuel..=Limits::MAX.fuel).contains(&manifest.limits.fuel)
            && reads_back(manifest.limits.deadline)
    );
    config(manifest);
    let json = manifest.to_json();
    assert_eq!(json["input"].as_array().map(Vec::len), Some(manifest.inputs.len()));
}

fn reads_back(duration: std::time::Duration) -> bool {
    parse_duration(&format_duration(duration)) == Ok(duration)
}

/// Checks that a default is a valid value of its item, also when it is parsed from its own text.
fn config(manifest: &Manifest) {
    let set = ConfigSet::resolve(manifest, &[]).expect("nothing is set");
    assert_eq!(set.len(), manifest.config.len());
    for (item, (name, value)) in manifest.config.iter().zip(set) {
        assert_eq!((item.name.as_str(), &item.default), (name.as_str(), &value));
        if let ConfigValue::Float(number) = value {
            assert!(number.is_finite(), "{number}");
        }
        assert_eq!(item.accept(&value.to_string()).ok(), Some(value), "{name}");
    }
}

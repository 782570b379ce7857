//! The part of the run that has reached the cloud: each event, trigger and clip that the vehicle
//! recorded.

use std::collections::BTreeMap;

use gleaner_base::Failure;
use gleaner_fleet::clips::FleetClip;
use gleaner_lambda::{Clip, Decision};
use gleaner_protocol::vehicle_api::StreamLine;
use gleaner_report::format::counted;

use super::demo_vehicle::{DemoVehicle, NAME, file};
use crate::steps::parsed;

/// Number of records that are read of a lambda: far more than a run has.
const RECORDS: &str = "100000";

/// Waits until the cloud has all triggers of these lambdas, and all clips with their thumbnails;
/// prints them, and fetches the files of the clips from the cloud. They are then in the folder
/// `cloud-clips`.
pub(super) fn run(vehicle: &DemoVehicle, ids: &[String], recorded: &[Clip]) -> Result<(), Failure> {
    println!("\nin the cloud, of {NAME}:");
    for id in ids {
        let local = triggers(vehicle, id, &[])?;
        vehicle.look_until(&format!("the triggers of `{id}` in the cloud"), || {
            Ok((triggers(vehicle, id, &["--on", NAME])? == local).then_some(()))
        })?;
        let labels = local.iter().map(|(label, count)| format!("{label} {count}"));
        let labels = labels.collect::<Vec<_>>().join(", ");
        println!("  {id:<21} triggers: {}", if labels.is_empty() { "none" } else { &labels });
    }
    let clips = vehicle.look_until("the clips and their thumbnails in the cloud", || {
        let clips: Vec<FleetClip> =
            parsed(&vehicle.gleaner(&["clips", "--json"])?, "gleaner clips")?;
        let is_shown = |clip: &FleetClip| clip.has_thumbnail || clip.facts.thumbnail.is_none();
        Ok((clips.len() == recorded.len() && clips.iter().all(is_shown)).then_some(clips))
    })?;
    let images = clips.iter().filter(|clip| clip.has_thumbnail).count();
    println!("  {}, {}", counted(clips.len() as u64, "clip"), counted(images as u64, "thumbnail"));
    let ids: Vec<String> = clips.iter().map(|clip| clip.id.to_string()).collect();
    let to = file("cloud-clips");
    let mut pull = vec!["clips", "pull", "--timeout", "1min", "--json", "--to", &to];
    pull.extend(ids.iter().map(String::as_str));
    vehicle.gleaner(&pull)?;
    Ok(())
}

/// Returns how many triggers of each label the records of a lambda have.
fn triggers(
    vehicle: &DemoVehicle,
    id: &str,
    on: &[&str],
) -> Result<BTreeMap<String, usize>, Failure> {
    let lines = vehicle.gleaner(&[&["logs", id, "--json", "-n", RECORDS], on].concat())?;
    let mut labels = BTreeMap::new();
    for line in lines.lines() {
        let line: StreamLine = parsed(line, "gleaner logs")?;
        if line.kind == "decision" {
            let decision: Decision = parsed(&line.record.to_string(), "gleaner logs")?;
            for trigger in decision.triggers {
                *labels.entry(trigger.label).or_default() += 1;
            }
        }
    }
    Ok(labels)
}

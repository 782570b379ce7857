//! `gleaner clips export`: the files of clips, and a table of their events.

use std::io::Write;
use std::path::Path;

use gleaner_base::{Exit, Failure, safe_file};
use gleaner_fleet::UnfinishedFile;
use gleaner_fleet::clips::{ClipMoment, ClipState, FleetClip};
use rustix::fs::{CWD, RenameFlags, renameat_with};
use serde_json::{Value, json};

use super::download::ClipTarget;
use super::{CLIPS, query};
use crate::args::ExportArgs;
use crate::cloud::{client, list, show};

/// The table, in the folder of an export. `gleaner_fleet.export` in Python reads it.
pub(super) const TABLE: &str = "events.jsonl";

pub(super) fn export(args: &ExportArgs) -> Result<Exit, Failure> {
    let client = client()?;
    let (stored, others): (Vec<FleetClip>, Vec<_>) =
        list::all::<FleetClip>(&client, CLIPS, &query(&args.filter))?
            .into_iter()
            .partition(|clip| clip.state == ClipState::Stored);
    let table = args.to.join(TABLE);
    let failed = |error: std::io::Error| {
        let action = format!("cannot write `{}`", table.display());
        Failure::caused_by(Exit::Usage, action, &error)
            .with_help("an export needs a folder without a table: choose another one with --to DIR")
    };
    safe_file::folder(&args.to).map_err(failed)?;
    if table.symlink_metadata().is_ok() {
        return Err(failed(std::io::ErrorKind::AlreadyExists.into()));
    }
    let mut rows = Vec::new();
    for clip in &stored {
        let file = ClipTarget::of(&args.to, clip)?.fetch(&client)?;
        let file = file.strip_prefix(&args.to).unwrap_or(&file).to_owned();
        rows.extend(clip.facts.moments.iter().map(|moment| row(clip, moment, &file)));
    }
    // Last: an export that was interrupted goes on with the files that it has.
    // Another export may have written its own table meanwhile.
    let part = args.to.join(format!("{TABLE}.{}.part", std::process::id()));
    let mut file = safe_file::create(&part).map_err(failed)?;
    let lines: String = rows.iter().map(|row| format!("{row}\n")).collect();
    let written = file
        .write_all(lines.as_bytes())
        .and_then(|()| file.sync_all())
        .and_then(|()| Ok(renameat_with(CWD, &part, CWD, &table, RenameFlags::NOREPLACE)?));
    drop(UnfinishedFile(part));
    written.map_err(failed)?;
    let wanted = others.iter().filter(|clip| clip.state != ClipState::Gone).count();
    let result = json!({ "table": table, "clips": stored.len(), "events": rows.len(),
                         "not_in_the_cloud": others.len(), "gone": others.len() - wanted });
    show(args.json, &result, |_| {
        let (clips, events) = (stored.len(), rows.len());
        let mut text = format!("wrote {clips} clips and {events} events: {}\n", table.display());
        if !others.is_empty() {
            let gone = others.len() - wanted;
            text += &format!(
                "{wanted} more clips are on their vehicles: `gleaner clips pull ID`; {gone} are \
                 gone\n"
            );
        }
        text
    })
}

fn row(clip: &FleetClip, moment: &ClipMoment, file: &Path) -> Value {
    let facts = &clip.facts;
    let lambda = facts.lambdas.iter().find(|lambda| lambda.name == moment.lambda);
    json!({
        "label": moment.label,
        "kind": moment.kind,
        "score": moment.score,
        "attributes": moment.attributes,
        "source": moment.source,
        "vehicle": clip.id.vehicle(),
        "lambda": moment.lambda,
        "version": lambda.map(|it| &it.version),
        "deployment": lambda.and_then(|it| it.deployment.as_ref()),
        "revision": lambda.and_then(|it| it.revision.as_ref()),
        "clip": file,
        "at_ns": moment.at_ns,
        "offset_s": moment.at_ns.saturating_sub(facts.from_ns) as f64 / 1e9,
        "length_s": facts.to_ns.saturating_sub(facts.from_ns) as f64 / 1e9,
        "is_complete": facts.incomplete.is_empty() && !facts.is_recovered,
        "sha256": facts.sha256,
    })
}

//! `gleaner clips`: clips of the vehicles of a cloud.
//!
//! `download` fetches a file into a folder, and `export` does so for many, with a table.

mod download;
mod export;

use std::collections::{BTreeMap, BTreeSet};
use std::thread::sleep;
use std::time::{Duration, Instant};

use gleaner_base::{ByteSize, Exit, Failure, visible};
use gleaner_fleet::clips::{ClipId, ClipPolicy, ClipState, ClipUsage, FleetClip};
use serde_json::{Value, json};

use self::download::ClipTarget;
use super::{client, list, show};
use crate::args::{ClipFilterArgs, ClipsArgs, ClipsCommand, PolicyArgs, PullArgs, RemoveClipsArgs};
use crate::output::print_error;
use crate::render::{or_dash, table};

/// Interval of looks whether a vehicle has sent a clip.
const INTERVAL: Duration = Duration::from_secs(2);
const CLIPS: &str = "/v1/clips";

pub(super) fn clips(args: &ClipsArgs) -> Result<Exit, Failure> {
    match &args.command {
        None => {
            let clips: Vec<FleetClip> =
                list::first(&client()?, CLIPS, &query(&args.filter), args.last)?;
            show(args.json, &clips, |clips| text(clips))
        }
        Some(ClipsCommand::Pull(pull)) => self::pull(pull),
        Some(ClipsCommand::Export(export)) => export::export(export),
        Some(ClipsCommand::Remove(remove)) => self::remove(remove),
        Some(ClipsCommand::Policy(policy)) => self::policy(policy),
    }
}

/// Removes clips, each as far as it can be.
///
/// # Errors
///
/// The failure of a clip, or a failure that names all that stay, with the worst exit code.
fn remove(args: &RemoveClipsArgs) -> Result<Exit, Failure> {
    let client = client()?;
    let (mut removed, mut failures) = (Vec::new(), Vec::new());
    for id in &args.ids {
        match client.delete(&path(id)) {
            Ok(()) => removed.push(id.to_string()),
            Err(failure) => failures.push((id, failure)),
        }
    }
    let shown = show(args.json, &json!({ "removed": removed }), |_| {
        removed.iter().map(|id| format!("removed {id}\n")).collect()
    });
    let Some(exit) = failures.iter().map(|(_, failure)| failure.exit).max_by_key(|it| it.code())
    else {
        return shown;
    };
    if let [_] = &*args.ids {
        return Err(failures.remove(0).1);
    }
    shown?;
    let message = format!("{} of {} clips stay in the cloud", failures.len(), args.ids.len());
    let help = "`gleaner clips` lists all clips, with their states";
    let mut all = Failure::new(exit, message).with_help(help);
    for (id, Failure { message, causes, .. }) in failures {
        let reason = std::iter::once(message).chain(causes).collect::<Vec<_>>().join(": ");
        all.causes.push(format!("`{id}`: {reason}"));
    }
    Err(all)
}

fn query(filter: &ClipFilterArgs) -> Vec<(&'static str, String)> {
    let values = [
        ("vehicle", filter.vehicle.clone()),
        ("lambda", filter.lambda.clone()),
        ("label", filter.label.clone()),
        ("from_ns", filter.since.map(list::since)),
    ];
    values.into_iter().filter_map(|(key, value)| Some((key, value?))).collect()
}

fn path(id: &ClipId) -> String {
    format!("{CLIPS}/{id}")
}

fn text(clips: &[FleetClip]) -> String {
    if clips.is_empty() {
        return "there are no such clips\n".to_owned();
    }
    let head = ["id", "time", "length", "size", "labels", "score", "state"];
    let rows = clips.iter().map(|clip| {
        let facts = &clip.facts;
        let mut labels: Vec<_> = facts.moments.iter().map(|it| visible(&it.label)).collect();
        labels.sort();
        labels.dedup();
        let scores = facts.moments.iter().filter_map(|it| it.score);
        let state = match clip.state {
            ClipState::Uploading => {
                let percent = clip.received * 100 / facts.bytes.max(1);
                format!("uploading, {percent} %")
            }
            state => state.as_str().to_owned(),
        };
        [
            clip.id.to_string(),
            super::date(u64::try_from(facts.from_ns / 1_000_000_000).unwrap_or(0)),
            format!("{:.1}s", facts.to_ns.saturating_sub(facts.from_ns) as f64 / 1e9),
            format!("{:.1} MiB", facts.bytes as f64 / (1 << 20) as f64),
            if labels.is_empty() { "-".to_owned() } else { labels.join(", ") },
            or_dash(scores.reduce(f64::max), |score| format!("{score:.2}")),
            state,
        ]
    });
    table(&head, rows, &[2, 3, 5])
}

fn policy(args: &PolicyArgs) -> Result<Exit, Failure> {
    let client = client()?;
    let mut policy: ClipPolicy = client.get("/v1/clips/policy")?;
    if let Some(upload) = args.upload {
        let day_bytes = args.budget.map_or(policy.day_bytes, ByteSize::bytes);
        let keep_s = args.keep.map_or(policy.keep_s, |keep| keep.as_secs());
        let keep_bytes = args.keep_size.map_or(policy.keep_bytes, ByteSize::bytes);
        policy = ClipPolicy { upload, day_bytes, keep_s, keep_bytes };
        let body = serde_json::to_vec(&policy).expect("a policy is plain data");
        client.put("/v1/clips/policy", body)?;
    }
    let usage: ClipUsage = client.get("/v1/clips/usage")?;
    show(args.json, &json!({ "policy": policy, "usage": usage }), |_| {
        let ClipPolicy { upload, day_bytes, keep_s, keep_bytes } = &policy;
        let budget = ByteSize::new(*day_bytes);
        let mut text =
            format!("vehicles send clips: {}; each at most {budget} a day\n", upload.as_str());
        let bounds = [
            (*keep_s > 0).then(|| format!("at most {} h", keep_s / 3600)),
            (*keep_bytes > 0).then(|| format!("at most {}", ByteSize::new(*keep_bytes))),
        ];
        let bounds: Vec<_> = bounds.into_iter().flatten().collect();
        let kept = if bounds.is_empty() { "without a bound".to_owned() } else { bounds.join(", ") };
        let ClipUsage { stored, bytes, removed, removed_bytes, disk_bytes } = &usage;
        let [bytes, removed_bytes, disk] = [*bytes, *removed_bytes, *disk_bytes].map(ByteSize::new);
        text += &format!(
            "the cloud keeps clips: {kept}\n\
             in the cloud: {stored} clips, {bytes}; removed: {removed} clips, {removed_bytes}\n\
             on its disk, with thumbnails, entries and unfinished files: {disk}\n"
        );
        text
    })
}

fn pull(args: &PullArgs) -> Result<Exit, Failure> {
    let client = client()?;
    let ids: BTreeSet<&ClipId> = args.ids.iter().collect();
    let wanted = ids.iter().map(|id| client.post(&format!("{}/pull", path(id)), &json!({})));
    let wanted = wanted.collect::<Result<Vec<FleetClip>, _>>()?;
    if args.no_wait {
        return show(args.json, &wanted, |clips| text(clips));
    }
    let mut waiting: Vec<(&ClipId, FleetClip)> = ids.into_iter().zip(wanted).collect();
    let until = Instant::now() + args.timeout;
    let mut files: Vec<Value> = Vec::new();
    let mut shown = BTreeMap::new();
    loop {
        let mut left = Vec::new();
        for (id, clip) in waiting {
            match clip.state {
                ClipState::Stored => {
                    let file = ClipTarget::of(&args.to, &clip)?.fetch(&client)?;
                    let file = file.display().to_string();
                    files.push(json!({ "id": id, "file": file, "sha256": clip.facts.sha256 }));
                }
                ClipState::Gone | ClipState::Failed => {
                    let reason = clip.reason.as_deref().map(visible).unwrap_or_default();
                    let state = clip.state.as_str();
                    let causes = vec![format!("it is {state}: {reason}")];
                    let message = format!("clip `{id}` cannot be fetched");
                    return Err(Failure { causes, ..Failure::new(Exit::Differs, message) }
                        .with_help("choose another clip: `gleaner clips`"));
                }
                state => {
                    let progress = (state, clip.received);
                    if shown.insert(id, progress) != Some(progress) && !args.json {
                        let (received, bytes) = (clip.received, clip.facts.bytes);
                        let state = state.as_str();
                        print_error(&format!("{id}: {state}, {received} of {bytes} bytes\n"));
                    }
                    left.push(id);
                }
            }
        }
        if left.is_empty() {
            break;
        }
        if Instant::now() >= until {
            let message = format!("{} clips have not come yet", left.len());
            return Err(Failure::new(Exit::Differs, message).with_help(
                "they stay wanted: check `gleaner vehicles` and the budget, `gleaner clips \
                 policy`, and run this again",
            ));
        }
        sleep(INTERVAL);
        let looked = left.into_iter().map(|id| Ok((id, client.get(&path(id))?)));
        waiting = looked.collect::<Result<_, Failure>>()?;
    }
    show(args.json, &files, |files| {
        let files = files.iter().filter_map(|file| file["file"].as_str());
        let lines = files.map(|file| {
            format!("{file}\n  gleaner verify {file} --trust VEHICLES    # its signature\n")
        });
        lines.collect()
    })
}

//! `gleaner keys`, `gleaner publish` and the signatures of clips: print the results of
//! `gleaner-trust`.

use std::path::Path;
use std::sync::Arc;

use gleaner_base::{Exit, Explain, Failure, UtcTime, safe_file, visible};
use gleaner_report::format::{counted, size};
use gleaner_supervisor::ClipSigning;
use gleaner_trust::{
    ClipRefusal, PublicKey, Published, Release, SecretKey, SignedClip, SignedLambda,
    TrustedVehicles, VehicleName, verify_clip,
};
use serde_json::{Value, json};

use crate::args::{KeysArgs, KeysCommand, PublishArgs, SignArgs};
use crate::output;
use crate::render::Paint;
use crate::since_1970;

pub(crate) fn keys(command: &KeysCommand) -> Result<Exit, Failure> {
    match command {
        KeysCommand::New(args) => {
            let key = SecretKey::generate()?;
            key.create_file(&args.file)?;
            show(args, &key.public(), "created ")
        }
        KeysCommand::Show(args) => show(args, &SecretKey::load(&args.file)?.public(), ""),
    }
}

fn show(args: &KeysArgs, key: &PublicKey, done: &str) -> Result<Exit, Failure> {
    let (file, id) = (args.file.display(), key.id());
    let shown = json!({ "file": file.to_string(), "public": key, "id": id });
    output::show(args.json, &shown, |_| {
        format!("{done}{file}\n  public key: {key}\n  key id:     {id}\n")
    })
}

pub(crate) fn publish(args: &PublishArgs) -> Result<Exit, Failure> {
    let key = SecretKey::load(&args.key)?;
    let out = args.out.clone().unwrap_or_else(|| args.lambda.join("revision.json"));
    // No vehicle compares this time.
    let created = since_1970().as_secs();
    let release = Release { lambda: &args.lambda, out: &out, release: args.release, created };
    let published = gleaner_trust::publish(&release, &key)?;
    let shown = json_of(&published, &key.public(), &out);
    output::show(args.json, &shown, |_| text_of(&published, &out))
}

/// Returns how the clips of a run are signed. The key is checked before anything is started.
pub(crate) fn of_clips(args: &SignArgs) -> Result<Option<ClipSigning>, Failure> {
    let Some(path) = &args.sign else { return Ok(None) };
    let (_, key) = SecretKey::open(path)?;
    let vehicle = match &args.vehicle_name {
        Some(name) => name.clone(),
        None => VehicleName::of_machine().map_err(|reason| {
            let failure = Failure::new(Exit::Usage, "this machine has no name for signatures");
            Failure { causes: vec![reason], ..failure }
                .with_help("name the vehicle: --vehicle-name NAME")
        })?,
    };
    Ok(Some(ClipSigning { key: Arc::new(key), vehicle: vehicle.to_string() }))
}

/// Checks that one of the vehicles in the file `trust` signed the clip.
pub(crate) fn check_clip(clip: &Path, trust: &Path) -> Result<SignedClip, Failure> {
    let vehicles = TrustedVehicles::load(trust)?;
    let signed = safe_file::read_named(clip)
        .map_err(|source| ClipRefusal::Read { source })
        .and_then(|file| verify_clip(file, &vehicles));
    signed.map_err(|refusal| {
        let message = format!("clip `{}` is not accepted", clip.display());
        Failure { exit: refusal.exit(), ..Failure::because(message, &refusal) }
    })
}

pub(crate) fn clip_text(signed: &SignedClip, paint: Paint) -> String {
    let SignedClip { statement, key } = signed;
    let lambda = |lambda: &SignedLambda| format!("{} {}", lambda.name, lambda.version);
    let lambdas = statement.lambdas.iter().map(lambda).collect::<Vec<_>>().join(", ");
    let time = UtcTime::of(i64::try_from(statement.created).unwrap_or(i64::MAX));
    let by = format!("signed by {} (key {}) at {time}", statement.vehicle, &key.as_str()[..16]);
    let messages = counted(statement.messages, "message");
    let recovered = if statement.recovered { ", recovered after a crash" } else { "" };
    let name = visible(&statement.clip);
    format!("{name}: {}: {lambdas}, {messages}{recovered}\n", paint.green(&by))
}

/// Returns the JSON object about a signed clip, with the members of `more`.
pub(crate) fn clip_json(signed: &SignedClip, more: Value) -> Value {
    let SignedClip { statement, key } = signed;
    let mut object = json!({ "signature": { "key": key, "statement": statement } });
    if let (Value::Object(object), Value::Object(more)) = (&mut object, more) {
        object.extend(more);
    }
    object
}

fn text_of(Published { revision, digest, unchanged }: &Published, out: &Path) -> String {
    let files = counted(revision.files.len() as u64, "file");
    format!(
        "{} {} ({} {}, release {}, {files}, {})\n  revision: {digest}\n",
        if *unchanged { "unchanged" } else { "published" },
        out.display(),
        revision.name,
        revision.version,
        revision.release,
        size(revision.files.iter().map(|file| file.bytes).sum())
    )
}

fn json_of(
    Published { revision, digest, unchanged }: &Published,
    key: &PublicKey,
    out: &Path,
) -> Value {
    json!({
        "lambda": revision.name,
        "version": revision.version,
        "release": revision.release,
        "revision": digest,
        "key": key.id(),
        "out": out.display().to_string(),
        "files": revision.files.len(),
        "bytes": revision.files.iter().map(|file| file.bytes).sum::<u64>(),
        "unchanged": unchanged,
    })
}

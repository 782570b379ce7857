//! `gleaner keys` and `gleaner publish`: print the results of `gleaner-trust`.

use std::path::Path;
use std::time::{SystemTime, UNIX_EPOCH};

use gleaner_base::{Exit, Failure};
use gleaner_report::format::{counted, size};
use gleaner_trust::{PublicKey, Published, Release, SecretKey};
use serde_json::json;

use crate::args::{KeysArgs, KeysCommand, PublishArgs};
use crate::render::json_line;
use crate::stdout::print;

/// Runs `gleaner keys`.
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
    print(&if args.json {
        json_line(&json!({ "file": file.to_string(), "public": key, "id": id }))
    } else {
        format!("{done}{file}\n  public key: {key}\n  key id:     {id}\n")
    })?;
    Ok(Exit::Ok)
}

/// Runs `gleaner publish`.
pub(crate) fn publish(args: &PublishArgs) -> Result<Exit, Failure> {
    let key = SecretKey::load(&args.key)?;
    let out = args.out.clone().unwrap_or_else(|| args.lambda.join("revision.json"));
    // A clock before 1970 counts as 1970; no vehicle compares this time.
    let created = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default().as_secs();
    let release = Release { lambda: &args.lambda, out: &out, release: args.release, created };
    let published = gleaner_trust::publish(&release, &key)?;
    let shown = if args.json { json_of } else { text_of };
    print(&shown(&published, &key.public(), &out))?;
    Ok(Exit::Ok)
}

fn text_of(
    Published { revision, digest, unchanged }: &Published,
    _: &PublicKey,
    out: &Path,
) -> String {
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
) -> String {
    json_line(&json!({
        "lambda": revision.name,
        "version": revision.version,
        "release": revision.release,
        "revision": digest,
        "key": key.id(),
        "out": out.display().to_string(),
        "files": revision.files.len(),
        "bytes": revision.files.iter().map(|file| file.bytes).sum::<u64>(),
        "unchanged": unchanged,
    }))
}

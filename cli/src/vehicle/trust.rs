//! `gleaner trust`: signs and installs trust roots.

use std::path::Path;

use gleaner_base::{Exit, Failure, PlainFile, write_atomically};
use gleaner_trust::{
    Floors, LambdaPattern, Payload, PublicKey, RootKeys, ScopedKey, SecretKey, TrustRoot,
    first_root, next_root, seal,
};
use serde_json::json;

use super::client::VehicleClient;
use crate::args::{TrustArgs, TrustCommand, TrustInstallArgs};
use crate::output::show;
use crate::since_1970;

pub(crate) fn trust(command: &TrustCommand) -> Result<Exit, Failure> {
    match command {
        TrustCommand::New(args) => new(args),
        TrustCommand::Install(args) => install(args),
    }
}

fn new(args: &TrustArgs) -> Result<Exit, Failure> {
    let load = |path: &Path| SecretKey::load(path).map_err(Failure::from);
    let keys: Vec<SecretKey> = args.root.iter().map(|it| load(it)).collect::<Result<_, _>>()?;
    let former: Vec<SecretKey> = args.former.iter().map(|it| load(it)).collect::<Result<_, _>>()?;
    let before = args.after.as_ref().map(|path| read(path)).transpose()?;
    let opened = before.as_ref().map(|it| first_root(it, &Floors::default())).transpose();
    let current = opened.map_err(|it| Failure::because("cannot use the former trust root", &it))?;
    let created = since_1970().as_secs();
    let root = TrustRoot {
        version: current.as_ref().map_or(0, |current| current.version) + 1,
        created,
        expires: created.saturating_add(args.expires.as_secs()),
        root: RootKeys {
            threshold: keys.len(),
            keys: keys.iter().map(SecretKey::public).collect(),
        },
        publishers: args.publisher.iter().map(|it| scoped(it)).collect::<Result<_, _>>()?,
        deployers: args.deployer.iter().map(|it| scoped(it)).collect::<Result<_, _>>()?,
    };
    let signers: Vec<&SecretKey> = keys.iter().chain(&former).collect();
    let refused = |refusal| Failure::because("a vehicle would refuse the trust root", &refusal);
    let envelope = seal(&root, &signers).map_err(refused)?;
    match &current {
        Some(current) => next_root(current, &envelope).map_err(|refusal| {
            refused(refusal).with_help("name the root keys of the former one with --former FILE")
        })?,
        None => first_root(&envelope, &Floors::default()).map_err(refused)?,
    };
    write_atomically(&args.file, &envelope).map_err(|error| {
        Failure::caused_by(Exit::Usage, format!("cannot write `{}`", args.file.display()), &error)
    })?;
    let (file, version) = (args.file.display(), root.version);
    show(args.json, &json!({ "file": file.to_string(), "version": version }), |_| {
        format!("signed {file} (trust root {version})\n")
    })
}

fn install(args: &TrustInstallArgs) -> Result<Exit, Failure> {
    let client = VehicleClient::new(&args.vehicle)?;
    client.put("/v1/trust", read(&args.file)?)?;
    show(args.vehicle.json, &client.status()?.trust, |trust| {
        format!("installed trust root {}\n", trust.as_ref().map_or(0, |trust| trust.version))
    })
}

pub(super) fn read(path: &Path) -> Result<Vec<u8>, Failure> {
    PlainFile::named(path, TrustRoot::MAX).and_then(PlainFile::read_whole).map_err(|error| {
        Failure::caused_by(Exit::Usage, format!("cannot read `{}`", path.display()), &error)
            .with_help("`gleaner trust new FILE` signs one")
    })
}

/// Parses `[PATTERN=]KEY`: a key file or a public key in base64.
fn scoped(text: &str) -> Result<ScopedKey, Failure> {
    // A public key ends with `=`, and has none before its end.
    let split = text.split_once('=').filter(|(_, rest)| !rest.is_empty() && *rest != "=");
    let (pattern, key) = split.unwrap_or(("*", text));
    let pattern: LambdaPattern =
        pattern.parse().map_err(|error: String| Failure::new(Exit::Usage, error))?;
    let key = match key.parse::<PublicKey>() {
        Ok(key) => key,
        Err(_) => SecretKey::load(Path::new(key))?.public(),
    };
    Ok(ScopedKey { key, lambdas: vec![pattern], labels: Default::default() })
}

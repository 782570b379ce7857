//! `gleaner deploy`, `rollback`, `start`, `stop` and `remove`: change what runs on a vehicle, and
//! wait.

use std::collections::BTreeMap;
use std::str::FromStr;
use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{Exit, Failure, PlainFile, format_duration, in_one_line, visible};
use gleaner_fleet::people::{FleetDeployRequest, ReportedRelease};
use gleaner_lambda::layout::FILE_MAX;
use gleaner_lambda::manifest::{ConfigSet, ConfigValue, ItemName, Sha256};
use gleaner_lambda::{BuildDir, Manifest};
use gleaner_protocol::supervision::{LambdaPhase, LambdaStatus};
use gleaner_protocol::vehicle_api::{Changed, DeployReply, DeploymentStatus, MissingObject};
use gleaner_report::format::counted;
use gleaner_trust::{
    Deployment, Grants, Payload, Revision, SecretKey, check_files, seal, sha256,
    unverified_revision,
};
use serde_json::json;

use super::client::VehicleClient;
use super::former::{Fallback, Former, changes};
use crate::args::{ChangeArgs, DeployArgs, VehicleArgs};
use crate::output::{print, print_json, show};
use crate::since_1970;

const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Number of times that files are sent: another deployment may remove some in between.
const ROUNDS: u32 = 5;

pub(crate) struct LocalRevision {
    envelope: String,
    revision: Revision,
    pub(crate) digest: Sha256,
    build: BuildDir,
    manifest: Manifest,
}

/// A deployment that is about to be signed.
pub(crate) struct NextDeployment {
    pub(crate) deployment: Deployment,
    changes: Vec<String>,
}

pub(crate) struct SentDeployment {
    attempt: u64,
    /// SHA-256 of its envelope.
    pub(crate) envelope: String,
}

pub(crate) fn deploy(args: &DeployArgs) -> Result<Exit, Failure> {
    let key = SecretKey::load(&args.key)?;
    let local = LocalRevision::load(args)?;
    let client = VehicleClient::new(&args.vehicle)?;
    let status = client.status()?;
    let id = local.id(args);
    let before = status.deployments.iter().find(|deployment| deployment.id == id);
    let failed = before.map(|before| (has_failed(before).into(), 1));
    let next = local.next(&client, args, &key, failed)?;
    let release = before.map(|before| before.release).or(status.removed.get(&id).copied());
    let reported = ReportedRelease { vehicle: status.vehicle, release: release.unwrap_or(0) };
    next.announce(args, Some(&reported))?;
    let sent = local.deploy(&client, args, &next.deployment, &key)?;
    wait(&client, &args.vehicle, &id, sent.attempt, args.timeout)
}

/// Returns whether the revision of a deployment has failed, also one without a fallback.
fn has_failed(it: &DeploymentStatus) -> bool {
    let lambda = it.status.as_ref().filter(|lambda| lambda.attempt >= it.attempt);
    let is_faulty = |lambda: &LambdaStatus| !it.is_proven && lambda.recent.faulty().is_some();
    let has_failed = |lambda| is_faulty(lambda) || lambda.phase == LambdaPhase::Quarantined;
    it.runs_fallback || lambda.is_some_and(has_failed)
}

/// Runs `gleaner rollback`, `gleaner start` and `gleaner stop`.
pub(crate) fn change(args: &ChangeArgs, change: &str) -> Result<Exit, Failure> {
    let (client, path) = (VehicleClient::new(&args.vehicle)?, path(&args.id)?);
    let Changed { attempt } = client.post(&format!("{path}/{change}"), &json!({}))?;
    match change {
        "stop" => wait_for_end(&client, args, "stopped"),
        _ => wait(&client, &args.vehicle, &args.id, attempt, args.timeout),
    }
}

pub(crate) fn remove(args: &ChangeArgs) -> Result<Exit, Failure> {
    let client = VehicleClient::new(&args.vehicle)?;
    client.delete(&path(&args.id)?)?;
    wait_for_end(&client, args, "removed")
}

/// Returns the path of a deployment in requests.
pub(crate) fn path(id: &str) -> Result<String, Failure> {
    checked_id(id).map(|id| format!("/v1/deployments/{id}"))
}

/// Returns an id that can be one of a deployment.
pub(super) fn checked_id(id: &str) -> Result<&str, Failure> {
    if id.parse::<ItemName>().is_err() {
        let id = gleaner_base::excerpt(id);
        return Err(Failure::new(Exit::Usage, format!("invalid deployment id `{id}`"))
            .with_help("`gleaner status` lists them"));
    }
    Ok(id)
}

impl NextDeployment {
    /// Prints what it changes.
    ///
    /// # Errors
    ///
    /// A failure if `reported` is a release as high as this one: a vehicle accepts only a higher
    /// one, and who signs decides which.
    pub(crate) fn announce(
        &self,
        args: &DeployArgs,
        reported: Option<&ReportedRelease>,
    ) -> Result<(), Failure> {
        let Deployment { id, release, .. } = &self.deployment;
        let higher = reported.filter(|it| args.release.is_none() && it.release >= *release);
        if let Some(ReportedRelease { vehicle, release: reported }) = higher {
            let message = format!("this would be release {release} of `{id}`");
            let vehicle = visible(vehicle);
            let cause = format!("{vehicle} reports release {reported}, and refuses lower ones");
            return Err(Failure { causes: vec![cause], ..Failure::new(Exit::Denied, message) }
                .with_help("choose the number yourself: `--release N`"));
        }
        if args.vehicle.json { Ok(()) } else { print_lines(&self.changes) }
    }
}

impl LocalRevision {
    pub(crate) fn load(args: &DeployArgs) -> Result<Self, Failure> {
        let path = args.revision.clone().unwrap_or_else(|| args.lambda.join("revision.json"));
        let read = PlainFile::named(&path, Revision::MAX).and_then(PlainFile::read_whole);
        let bytes = read.map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("cannot read `{}`", path.display()), &error)
                .with_help("sign the build first: `gleaner publish DIR --key publisher.pem`")
        })?;
        let (revision, digest) = unverified_revision(&bytes).map_err(|refusal| {
            Failure::because(format!("cannot use `{}`", path.display()), &refusal)
        })?;
        let build = BuildDir::of(&args.lambda);
        check_files(&revision, &build).map_err(|error| {
            let name = &revision.name;
            Failure::because(format!("the build of `{name}` is not the published one"), &error)
                .with_help("build and publish it again: `gleaner publish DIR --key publisher.pem`")
        })?;
        let manifest = Manifest::load(build.path())?;
        let envelope = String::from_utf8(bytes).expect("an envelope is JSON");
        Ok(Self { envelope, revision, digest, build, manifest })
    }

    pub(crate) fn id(&self, args: &DeployArgs) -> String {
        args.id.clone().unwrap_or_else(|| self.revision.name.to_string())
    }

    /// Returns the deployment of this revision. `failed` is the number of vehicles on which the
    /// former one has failed, and of all that have it. Everything in it is of the options, of
    /// manifests, or of what deployers signed.
    ///
    /// # Errors
    ///
    /// A failure if an option is not valid, or the former one cannot be verified.
    pub(crate) fn next(
        &self,
        client: &VehicleClient,
        args: &DeployArgs,
        key: &SecretKey,
        failed: Option<(u64, u64)>,
    ) -> Result<NextDeployment, Failure> {
        check_once("--label", &args.label)?;
        check_once("--set", &args.set)?;
        let id = self.id(args);
        let of = (&*id, &self.revision.name);
        let former = failed.map(|_| Former::fetch(client, args, key, of)).transpose()?.flatten();
        let former = former.as_ref();
        let failed = failed.unwrap_or_default();
        let named = args.fallback.as_deref().filter(|named| *named != "none");
        let named = named.map(|digest| parse::<Sha256>("--fallback", digest)).transpose()?;
        let fallback = Fallback::choose(args, named.as_ref(), (former, failed), &self.digest);
        check_order(&self.revision, former)?;
        let label = |text: &String| {
            let (name, value) = text.split_once('=').unwrap_or((text, ""));
            Ok((parse("--label", name)?, value.to_owned()))
        };
        let manifests =
            std::iter::once(&self.manifest).chain(fallback.and_then(|it| it.manifest()));
        let created = since_1970().as_secs();
        let newest = former.map_or(0, |former| former.deployment.release);
        let deployment = Deployment {
            id: parse("--id", &id)?,
            // One that is too high is refused by its format.
            release: args.release.unwrap_or(newest.saturating_add(1)),
            selector: args.label.iter().map(label).collect::<Result<_, Failure>>()?,
            revision: self.digest.clone(),
            fallback: fallback.map(|fallback| fallback.digest.clone()),
            config: config(&self.manifest, &args.set)?,
            grants: grants(manifests),
            created,
            expires: created.saturating_add(args.expires.as_secs()),
        };
        let mut changes = changes(&deployment, former, fallback);
        let has_own = former.is_some_and(|former| former.deployment.fallback.is_some());
        // A revision that failed on some vehicles only may still be the fallback.
        if failed.0 > 0 && args.fallback.is_none() && fallback.is_some() == has_own {
            let on = match args.fleet {
                true => format!(" on {}", counted(failed.0, "vehicle")),
                false => String::new(),
            };
            let end = if has_own { "" } else { " and has none" };
            changes[0] += &format!(", as the one before failed{on}{end}");
        }
        Ok(NextDeployment { deployment, changes })
    }

    /// Signs a deployment and sends it with all missing files.
    pub(crate) fn deploy(
        &self,
        client: &VehicleClient,
        args: &DeployArgs,
        deployment: &Deployment,
        key: &SecretKey,
    ) -> Result<SentDeployment, Failure> {
        let sealed = seal(deployment, &[key])
            .map_err(|refusal| Failure::because("cannot sign the deployment", &refusal))?;
        let envelope = sha256(&sealed).to_string();
        // Without waves, it is the request that a vehicle takes.
        let request = FleetDeployRequest {
            deployment: String::from_utf8(sealed).expect("an envelope is JSON"),
            revisions: vec![self.envelope.clone()],
            waves: args.waves.plan(),
        };
        let (mut sent, mut rounds, mut failed) = (0, 0, None);
        let attempt = loop {
            match client.create("/v1/deployments", &request)? {
                DeployReply::Accepted { attempt, .. } => break attempt,
                DeployReply::Missing { objects } if rounds < ROUNDS => {
                    // Another deployment of this id may have brought the file meanwhile: then it
                    // is refused, and not missing any more.
                    match objects.iter().try_for_each(|object| self.send(client, object)) {
                        Err(it) if !matches!(it.exit, Exit::Usage | Exit::Unreachable) => {
                            return Err(it);
                        }
                        done => failed = done.err(),
                    }
                    (sent, rounds) = (sent.max(objects.len()), rounds + 1);
                }
                DeployReply::Missing { objects } => {
                    if let Some(failure) = failed {
                        return Err(failure);
                    }
                    let (receiver, count) =
                        (client.receiver(), counted(objects.len() as u64, "file"));
                    let message = format!("{receiver} lacks {count} although all were sent");
                    return Err(Failure::new(Exit::Internal, message)
                        .with_help("another deployment may have come between: try again"));
                }
            }
        };
        if !args.vehicle.json {
            let Revision { name, version, .. } = &self.revision;
            let (release, files) = (deployment.release, counted(sent as u64, "file"));
            print(&format!(
                "deployed {name} {version} as `{}` (release {release}, {files} sent)\n",
                deployment.id
            ))?;
        }
        Ok(SentDeployment { attempt, envelope })
    }

    fn send(&self, client: &VehicleClient, object: &MissingObject) -> Result<(), Failure> {
        let file = self.revision.files.iter().find(|file| file.sha256 == *object.sha256);
        let Some(file) = file else {
            let (receiver, sha256) = (client.receiver(), &object.sha256);
            let message = format!("{receiver} lacks the file {sha256} of the fallback");
            return Err(Failure::new(Exit::Usage, message)
                .with_help("deploy with `--fallback none`, or deploy the fallback first"));
        };
        let path = file.path.as_path();
        let opened = PlainFile::inside(self.build.path(), path, FILE_MAX).map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("cannot open `{}`", file.path), &error)
        })?;
        client.put_file(&format!("/v1/objects/{}", object.sha256), opened.into_file())
    }
}

/// Returns the rights that the manifests of a revision and of its fallback ask for.
fn grants<'m>(manifests: impl Iterator<Item = &'m Manifest>) -> Grants {
    let mut grants = Grants::default();
    for manifest in manifests {
        let inputs = manifest.inputs.iter().map(|input| &input.topic);
        let recorded = manifest.record.iter().flat_map(|record| &record.topics);
        grants.topics.extend(inputs.chain(recorded).cloned());
        grants.models.extend(manifest.models.iter().map(|model| model.name.clone()));
        grants.record |= manifest.record.is_some();
    }
    grants.topics.sort();
    grants.topics.dedup();
    grants.models.sort();
    grants.models.dedup();
    grants
}

/// Refuses a revision that vehicles refuse, since they have accepted a newer one.
fn check_order(revision: &Revision, former: Option<&Former>) -> Result<(), Failure> {
    let newest = former.and_then(Former::revision).map_or(0, |newest| newest.release);
    if revision.release >= newest {
        return Ok(());
    }
    let Revision { name, release, .. } = revision;
    let message =
        format!("`{name}` has release {release}, and release {newest} was deployed before");
    Err(Failure::new(Exit::Usage, message)
        .with_help("publish this build with a higher one: `gleaner publish DIR --release N`"))
}

/// Refuses a name with two values: the first one would be lost.
fn check_once(option: &str, assignments: &[String]) -> Result<(), Failure> {
    let name = |text: &String| text.split('=').next().unwrap_or_default().to_owned();
    let mut names: Vec<_> = assignments.iter().map(name).collect();
    names.sort_unstable();
    let twice = names.windows(2).find(|pair| pair[0] == pair[1]);
    twice.map_or(Ok(()), |pair| {
        let message = format!("`{option}` has two values for `{}`", visible(&pair[0]));
        Err(Failure::new(Exit::Usage, message).with_help("name it once"))
    })
}

fn config(manifest: &Manifest, set: &[String]) -> Result<BTreeMap<ItemName, ConfigValue>, Failure> {
    let pairs = set.iter().map(|text| {
        let (name, value) = text.split_once('=').unwrap_or((text, ""));
        (name.trim().to_owned(), value.to_owned())
    });
    let pairs: Vec<_> = pairs.collect();
    let values = ConfigSet::resolve(manifest, &pairs)?;
    let is_set = |name: &String| pairs.iter().any(|(key, _)| key == name);
    let set = values.into_iter().filter(|(name, _)| is_set(name));
    set.map(|(name, value)| Ok((parse("--set", &name)?, value))).collect()
}

/// Prints lines of what is about to be signed or changed.
pub(crate) fn print_lines(lines: &[String]) -> Result<(), Failure> {
    print(&lines.iter().map(|line| format!("{line}\n")).collect::<String>())
}

fn parse<T: FromStr>(option: &str, text: &str) -> Result<T, Failure> {
    text.parse().map_err(|_| {
        let text = gleaner_base::excerpt(text);
        Failure::new(Exit::Usage, format!("`{text}` is not valid for {option}"))
    })
}

/// Waits until the lambda runs, for the attempt or a later one.
fn wait(
    client: &VehicleClient,
    args: &VehicleArgs,
    id: &str,
    requested: u64,
    timeout: Duration,
) -> Result<Exit, Failure> {
    let started = Instant::now();
    loop {
        let status = client.status()?;
        let Some(deployment) = status.deployments.iter().find(|it| it.id == *id) else {
            let message = format!("deployment `{id}` was removed meanwhile");
            return Err(Failure::new(Exit::Differs, message));
        };
        if let Some(refused) = &deployment.refused {
            let failure = Failure::new(Exit::Denied, format!("deployment `{id}` is refused"));
            return Err(Failure { causes: vec![refused.clone()], ..failure });
        }
        // Of a fallback that is about to start, the attempt is a later one.
        let attempt = requested.max(deployment.attempt);
        let newer = |lambda: &&LambdaStatus| lambda.attempt >= attempt;
        let lambda = deployment.status.as_ref().filter(newer);
        match lambda.map(|lambda| lambda.phase) {
            Some(LambdaPhase::Running) => {
                // Another attempt than the one that was requested: the fallback took its place.
                let has_failed = deployment.attempt > requested;
                return running(args, deployment, started.elapsed(), has_failed);
            }
            Some(LambdaPhase::Quarantined) => {
                let message = format!("deployment `{id}` does not run, and is not started again");
                let causes = lambda.and_then(|it| it.last_end.clone()).into_iter().collect();
                let failure = Failure { causes, ..Failure::new(Exit::LambdaFaulted, message) };
                return Err(failure.with_help(format!(
                    "repair the lambda and deploy it again, or `gleaner start {id}`; \
                     `gleaner logs {id}` shows its log"
                )));
            }
            _ => {}
        }
        if started.elapsed() >= timeout {
            let seconds = format_duration(timeout);
            let message = format!("deployment `{id}` does not run after {seconds}");
            let phase = lambda.map(|it| format!("it is {}", it.phase.as_str()));
            let end = lambda.and_then(|it| it.last_end.as_deref()).map(in_one_line);
            // A lambda waits for it, and has no reason of its own.
            let ingress = status.supervisor.as_ref().map(|supervisor| &supervisor.ingress);
            let ingress = ingress.filter(|ingress| !ingress.is_ready);
            let ingress = ingress.and_then(|it| it.last_end.as_deref()).map(in_one_line);
            let causes = phase.into_iter().chain(end).chain(ingress).collect();
            return Err(Failure { causes, ..Failure::new(Exit::Differs, message) }
                .with_help("it goes on: `gleaner status` and `gleaner events` show it"));
        }
        thread::sleep(POLL_INTERVAL);
    }
}

/// Shows the revision that runs. It is a failure if the fallback was taken as the revision
/// `has_failed`; a rollback that a user requested is none.
fn running(
    args: &VehicleArgs,
    deployment: &DeploymentStatus,
    after: Duration,
    has_failed: bool,
) -> Result<Exit, Failure> {
    let DeploymentStatus { id, revision, fallback, failed, runs_fallback, .. } = deployment;
    let fallback = fallback.as_ref().filter(|_| *runs_fallback);
    let version = &fallback.unwrap_or(revision).version;
    let reason = failed.as_deref().filter(|_| fallback.is_some());
    let text = match reason {
        Some(reason) => format!("running its fallback {version}: {}\n", in_one_line(reason)),
        None => format!("running {version} after {} ms\n", after.as_millis()),
    };
    match reason.filter(|_| has_failed) {
        None => show(args.json, deployment, |_| text),
        Some(reason) => {
            if args.json {
                print_json(deployment)?;
            }
            let message = format!("deployment `{id}` runs its fallback {version}");
            let causes = vec![format!("{} failed: {reason}", revision.version)];
            let help = "repair the lambda and deploy it again";
            Err(Failure { causes, ..Failure::new(Exit::LambdaFaulted, message) }
                .with_help(format!("{help}; `gleaner logs {id}` shows its log")))
        }
    }
}

fn wait_for_end(client: &VehicleClient, args: &ChangeArgs, done: &str) -> Result<Exit, Failure> {
    let started = Instant::now();
    loop {
        let status = client.status()?;
        let deployment = status.deployments.iter().find(|it| it.id == args.id);
        // That of a removed deployment is known to the supervisor only.
        let has_ended = status
            .supervisor
            .as_ref()
            .map(|supervisor| supervisor.lambdas.iter().all(|lambda| lambda.id != args.id));
        if has_ended == Some(true) {
            let result = match deployment {
                Some(deployment) => json!(deployment),
                None => json!({ "id": args.id, "removed": true }),
            };
            return show(args.vehicle.json, &result, |_| format!("{done} `{}`\n", args.id));
        }
        if started.elapsed() >= args.timeout {
            let id = &args.id;
            return Err(match has_ended {
                Some(_) => Failure::new(Exit::Differs, format!("`{id}` is still stopping")),
                None => {
                    let message = format!("{done} `{id}`, but whether it has ended is unknown");
                    let causes = vec!["the supervisor does not report".to_owned()];
                    Failure { causes, ..Failure::new(Exit::Unreachable, message) }
                        .with_help("see `gleaner events`")
                }
            });
        }
        thread::sleep(POLL_INTERVAL);
    }
}

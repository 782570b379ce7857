//! Publishing the build of a lambda, and comparing files with a revision.

use std::fs;
use std::os::unix::fs::{PermissionsExt, chown, symlink};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

use gleaner_base::Explain;
use gleaner_lambda::{BuildDir, LayoutError};
use gleaner_trust::{
    COUNTER_MAX, FileDigestError, KeyError, Published, Refusal, Release, ReleaseError, check_files,
    publish,
};
use tempfile::TempDir;

use super::*;

const MANIFEST: &str = "lambda = { name = 'brake-dark', version = '0.1.0', kind = 'python', entry = 'main.py' }\nschedule.period = '1s'\n";

struct BuiltLambda(TempDir);

impl BuiltLambda {
    fn new() -> Self {
        let lambda = Self(tempfile::tempdir().unwrap());
        lambda.write("main.py", "");
        lambda.write("lambda.toml", MANIFEST);
        lambda.write("build/main.py", "x = 1\n");
        lambda.write("build/models/größe 駅.onnx", "model");
        lambda.write("build/lambda.toml", MANIFEST);
        lambda
    }

    fn write(&self, path: &str, text: &str) {
        let path = self.0.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    fn out(&self) -> PathBuf {
        self.0.path().join("revision.json")
    }

    fn publish(&self, release: Option<u64>) -> Result<Published, ReleaseError> {
        publish_to(self.0.path(), &self.out(), release, PUBLISHER)
    }
}

fn publish_to(
    lambda: &Path,
    out: &Path,
    release: Option<u64>,
    seed: u8,
) -> Result<Published, ReleaseError> {
    publish(&Release { lambda, out, release, created: SIGNED }, &key(seed))
}

fn refusal(checked: Result<(), FileDigestError>) -> Refusal {
    match checked.unwrap_err() {
        FileDigestError::Refused(refusal) => refusal,
        other => panic!("{other}"),
    }
}

#[test]
fn a_published_build_is_accepted_by_a_vehicle_with_its_files() {
    let lambda = BuiltLambda::new();
    let published = lambda.publish(None).unwrap();
    let verified = on_vehicle(|it| it.revision(&fs::read(lambda.out()).unwrap())).unwrap();
    assert_eq!(*verified.payload(), published.revision);
    assert_eq!(*verified.digest(), published.digest);
    let paths: Vec<_> = published.revision.files.iter().map(|file| file.path.as_str()).collect();
    assert_eq!(paths, ["lambda.toml", "main.py", "models/größe 駅.onnx"]);
    check_files(verified.payload(), &BuildDir::of(lambda.0.path())).unwrap();
}

#[test]
fn a_changed_missing_or_added_file_is_refused_by_name_with_both_values() {
    let lambda = BuiltLambda::new();
    let revision = lambda.publish(None).unwrap().revision;
    let check = || check_files(&revision, &BuildDir::of(lambda.0.path()));
    for (at, byte) in "x = 1\n".bytes().enumerate() {
        let mut text = b"x = 1\n".to_vec();
        text[at] = byte ^ 1;
        fs::write(lambda.0.path().join("build/main.py"), text).unwrap();
        let refusal = refusal(check());
        assert!(matches!(&refusal, Refusal::Digest { path, .. } if path == "main.py"));
    }
    for length in 0..5 {
        lambda.write("build/main.py", &"x = 1\n"[..length]);
        let found = length as u64;
        let expected = Refusal::Length { path: "main.py".to_owned(), signed: 6, found };
        assert_eq!(refusal(check()), expected);
    }
    lambda.write("build/main.py", "x = 1\n");
    lambda.write("build/more/évil.py", "");
    assert_eq!(refusal(check()), Refusal::ExtraFile { path: "more/évil.py".to_owned() });
    fs::remove_dir_all(lambda.0.path().join("build/more")).unwrap();
    fs::remove_file(lambda.0.path().join("build/main.py")).unwrap();
    assert_eq!(refusal(check()), Refusal::MissingFile { path: "main.py".to_owned() });
    let elsewhere = lambda.0.path().join("main.py");
    symlink(elsewhere, lambda.0.path().join("build/main.py")).unwrap();
    assert!(check().unwrap_err().to_string().contains("main.py"), "a link out of the build");
}

#[test]
fn the_release_grows_with_each_change_and_only_then() {
    let lambda = BuiltLambda::new();
    let first = lambda.publish(None).unwrap();
    assert_eq!((first.revision.release, first.unchanged), (1, false));
    let text = fs::read(lambda.out()).unwrap();
    let later =
        Release { lambda: lambda.0.path(), out: &lambda.out(), release: None, created: SIGNED + 1 };
    let again = publish(&later, &key(PUBLISHER)).unwrap();
    assert_eq!((again.unchanged, &again.revision), (true, &first.revision));
    assert_eq!(fs::read(lambda.out()).unwrap(), text);
    assert!(lambda.publish(Some(1)).unwrap().unchanged);
    lambda.write("build/main.py", "x = 2\n");
    for release in [1, 0] {
        let error = lambda.publish(Some(release)).unwrap_err();
        assert!(matches!(error, ReleaseError::Counter { existing: 1, .. }), "{error}");
    }
    assert_eq!(lambda.publish(None).unwrap().revision.release, 2);
    assert_eq!(lambda.publish(Some(40)).unwrap().revision.release, 40);
    let most = lambda.publish(Some(COUNTER_MAX + 1)).unwrap_err();
    assert!(matches!(most, ReleaseError::CounterRange { .. }), "{most}");
}

#[test]
fn what_cannot_be_published_is_named_and_nothing_is_written() {
    let lambda = BuiltLambda::new();
    let folder = lambda.0.path();
    let inside = publish_to(folder, &folder.join("build/revision.json"), None, 1).unwrap_err();
    assert!(matches!(inside, ReleaseError::Inside { .. }), "{inside}");
    let error = publish_to(folder, &folder.join("main.py"), None, 1).unwrap_err();
    assert!(matches!(error, ReleaseError::NoRevision { .. }), "{error}");
    assert_eq!(fs::read_to_string(folder.join("main.py")).unwrap(), "");
    let error = publish_to(folder, &folder.join("nowhere/x.json"), None, 1).unwrap_err();
    assert!(error.to_string().contains("nowhere") && error.help().is_some(), "{error}");
    lambda.write("build/\u{1}", "");
    let error = lambda.publish(None).unwrap_err();
    assert!(error.help().is_some_and(|help| help.contains("rename")), "{error}");
    fs::remove_file(folder.join("build/\u{1}")).unwrap();
    let newer = fs::File::options().write(true).open(folder.join("main.py")).unwrap();
    newer.set_modified(std::time::SystemTime::now() + std::time::Duration::from_secs(60)).unwrap();
    let error = lambda.publish(None).unwrap_err();
    assert!(error.to_string().contains("older than its source `main.py`"), "{error}");
    assert!(!lambda.out().exists());
    let other = BuiltLambda::new();
    other.write("build/lambda.toml", &MANIFEST.replace("brake-dark", "brake-wet"));
    other.publish(None).unwrap();
    let error = publish_to(BuiltLambda::new().0.path(), &other.out(), None, 1).unwrap_err();
    assert!(matches!(error, ReleaseError::OtherLambda { .. }), "{error}");
}

#[test]
fn several_at_once_leave_the_highest_release_whole() {
    let lambda = BuiltLambda::new();
    thread::scope(|scope| {
        for release in 1..=8 {
            let lambda = &lambda;
            scope.spawn(move || match lambda.publish(Some(release)) {
                Ok(published) => assert_eq!(published.revision.release, release),
                Err(ReleaseError::Counter { existing, .. }) => assert!(existing > release),
                Err(error) => panic!("{error}"),
            });
        }
    });
    assert!(!lambda.0.path().join("revision.json.part").exists());
    let last = lambda.publish(None).unwrap();
    assert_eq!((last.unchanged, last.revision.release), (true, 8));
}

#[test]
fn a_counter_by_another_key_is_not_continued() {
    let lambda = BuiltLambda::new();
    publish_to(lambda.0.path(), &lambda.out(), Some(COUNTER_MAX), 9).unwrap();
    let text = fs::read(lambda.out()).unwrap();
    let error = lambda.publish(None).unwrap_err();
    assert!(error.to_string().ends_with("revision.json` is not signed by this key"), "{error}");
    assert!(error.help().is_some_and(|help| help.contains("give `--release N`")));
    assert_eq!(fs::read(lambda.out()).unwrap(), text);
    // A signature that names this key and is wrong does not count either.
    let [own, other] = [PUBLISHER, 9].map(|seed| key(seed).public().id().to_string());
    lambda.write("revision.json", &String::from_utf8(text).unwrap().replace(&other, &own));
    assert!(matches!(lambda.publish(None), Err(ReleaseError::NotOurs { .. })));
    assert_eq!(lambda.publish(Some(7)).unwrap().revision.release, 7);
    lambda.write("build/main.py", "x = 2\n");
    assert_eq!(lambda.publish(None).unwrap().revision.release, 8);
}

#[test]
fn messages_at_the_last_release_lead_out_of_it() {
    let lambda = BuiltLambda::new();
    lambda.publish(Some(COUNTER_MAX)).unwrap();
    assert!(lambda.publish(None).unwrap().unchanged);
    lambda.write("build/main.py", "x = 2\n");
    for asked in [None, Some(1), Some(COUNTER_MAX), Some(COUNTER_MAX + 1)] {
        let error = lambda.publish(asked).unwrap_err();
        assert!(matches!(error, ReleaseError::LastRelease { .. }), "{asked:?}: {error}");
        assert!(error.help().is_some_and(|help| help.contains("new name")));
    }
    fs::remove_file(lambda.out()).unwrap();
    assert_eq!(lambda.publish(None).unwrap().revision.release, 1);
}

#[test]
fn a_secret_key_in_the_build_is_refused_by_name() {
    let lambda = BuiltLambda::new();
    let path = lambda.0.path().join("build/models/a key");
    key(PUBLISHER).create_file(&path).unwrap();
    let refused = || match lambda.publish(None).unwrap_err() {
        ReleaseError::Files(error @ FileDigestError::SecretKey { .. }) => error,
        other => panic!("{other}"),
    };
    let error = refused();
    assert!(error.to_string().contains("build/models/a key"), "{error}");
    assert!(error.help().is_some_and(|help| help.contains("make a new key")));
    assert!(!lambda.out().exists());
    // Another key, with the line ends of another system.
    fs::remove_file(&path).unwrap();
    key(9).create_file(&path).unwrap();
    fs::write(&path, fs::read_to_string(&path).unwrap().replace('\n', "\r\n")).unwrap();
    refused();
    fs::write(&path, "-----BEGIN PRIVATE KEY-----\nnot one\n").unwrap();
    lambda.publish(None).unwrap();
}

#[test]
fn the_manifest_must_have_the_name_version_and_kind_of_the_revision() {
    let lambda = BuiltLambda::new();
    let good = lambda.publish(None).unwrap().revision;
    let build = BuildDir::of(lambda.0.path());
    check_files(&good, &build).unwrap();
    let cases = [
        ("name", Revision { name: "brake-wet".parse().unwrap(), ..good.clone() }),
        ("version", Revision { version: "0.2.0".parse().unwrap(), ..good.clone() }),
        ("kind", Revision { kind: LambdaKind::Wasm, ..good.clone() }),
    ];
    for (name, changed) in cases {
        let refusal = refusal(check_files(&changed, &build));
        assert!(matches!(refusal, Refusal::OtherManifest { what, .. } if what == name));
        let (text, value) = (refusal.to_string(), |revision: &Revision| match name {
            "name" => revision.name.to_string(),
            "version" => revision.version.to_string(),
            _ => revision.kind.as_str().to_owned(),
        });
        assert!(text.contains(&value(&good)) && text.contains(&value(&changed)), "{text}");
    }
    // Without a manifest, and with one that cannot be parsed.
    let mut without = good.clone();
    without.files.retain(|file| file.path.as_str() != "lambda.toml");
    fs::remove_file(build.manifest_path()).unwrap();
    let missing = Refusal::MissingFile { path: "lambda.toml".to_owned() };
    assert_eq!(refusal(check_files(&without, &build)), missing);
    lambda.write("build/lambda.toml", "");
    let mut empty = good;
    let file = empty.files.iter_mut().find(|file| file.path.as_str() == "lambda.toml").unwrap();
    file.bytes = 0;
    // The SHA-256 of nothing.
    file.sha256 =
        "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855".parse().unwrap();
    let error = check_files(&empty, &build).unwrap_err();
    assert!(matches!(error, FileDigestError::Layout(LayoutError::Manifest(_))), "{error}");
}

#[test]
fn a_manifest_that_changes_during_publishing_is_never_signed_as_another_one() {
    let lambda = BuiltLambda::new();
    let versions = ["0.1.0", "0.2.0"];
    let mut digests = Vec::new();
    for version in versions {
        lambda.write("build/lambda.toml", &MANIFEST.replace("0.1.0", version));
        let revision = lambda.publish(None).unwrap().revision;
        digests.push(manifest_digest(&revision));
    }
    let (is_done, mut count) = (AtomicBool::new(false), 0);
    thread::scope(|scope| {
        scope.spawn(|| {
            for version in versions.iter().cycle() {
                if is_done.load(Ordering::Relaxed) {
                    break;
                }
                lambda.write("next.toml", &MANIFEST.replace("0.1.0", version));
                let next = lambda.0.path().join("next.toml");
                fs::rename(next, lambda.0.path().join("build/lambda.toml")).unwrap();
            }
        });
        for _ in 0..60 {
            let Ok(Published { revision, .. }) = lambda.publish(None) else { continue };
            count += 1;
            let at = versions.iter().position(|it| *it == revision.version.as_str()).unwrap();
            let is_same = manifest_digest(&revision) == digests[at];
            is_done.fetch_or(!is_same, Ordering::Relaxed);
            assert!(is_same, "{revision:?}");
        }
        is_done.store(true, Ordering::Relaxed);
    });
    assert!(count > 0, "nothing was published");
}

fn manifest_digest(revision: &Revision) -> String {
    let file = revision.files.iter().find(|file| file.path.as_str() == "lambda.toml").unwrap();
    file.sha256.to_string()
}

#[test]
fn a_key_of_another_user_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("key.pem");
    key(7).create_file(&path).unwrap();
    // Only a privileged user can give a file away.
    if chown(&path, Some(12_345), None).is_err() {
        return;
    }
    let error = SecretKey::load(&path).unwrap_err();
    assert!(matches!(error, KeyError::Foreign { owner: 12_345, .. }), "{error}");
    assert!(error.help().is_some());
}

#[test]
fn help_for_keys_is_no_circle() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("key.pem");
    let error = SecretKey::load(&path).unwrap_err();
    assert!(error.help().is_some_and(|help| help.contains("keys new") && help.contains("key.pem")));
    // A file that is there: `gleaner keys new` with its name would be refused.
    fs::write(&path, "no key").unwrap();
    let error = SecretKey::load(&path).unwrap_err();
    assert!(error.help().is_some_and(|help| help.contains("under a new name")), "{error}");
    let error = key(7).create_file(&folder.path().join("nowhere/key.pem")).unwrap_err();
    assert!(matches!(error, KeyError::Create { .. }), "{error}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
}

#[test]
fn a_key_file_is_private_never_overwritten_and_reads_back() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("key.pem");
    key(7).create_file(&path).unwrap();
    assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
    assert_eq!(SecretKey::load(&path).unwrap().public(), key(7).public());
    assert!(matches!(key(8).create_file(&path), Err(KeyError::Exists { .. })));
    for mode in [0o640, 0o604, 0o660, 0o601] {
        fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
        let error = SecretKey::load(&path).unwrap_err();
        assert!(matches!(error, KeyError::Shared { .. }), "{error}");
        assert!(error.help().is_some_and(|help| help.contains("chmod 600")));
    }
    fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
    let text = fs::read(&path).unwrap();
    // Without its line end, it is whole.
    for length in 0..text.len() - 1 {
        fs::write(&path, &text[..length]).unwrap();
        assert!(matches!(SecretKey::load(&path), Err(KeyError::NoKey { .. })), "{length}");
    }
    let random = [(); 2].map(|()| SecretKey::generate().unwrap().public());
    assert_ne!(random[0], random[1]);
}

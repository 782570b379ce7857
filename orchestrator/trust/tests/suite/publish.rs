//! Publishing the build of a lambda, and comparing files with a revision.

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::thread;

use gleaner_base::Explain;
use gleaner_lambda::BuildDir;
use gleaner_trust::{
    FileDigestError, KeyError, Published, Refusal, Release, ReleaseError, check_files, publish,
};
use tempfile::TempDir;

use super::*;

const MANIFEST: &str = "lambda = { name = 'brake-dark', version = '0.1.0', kind = 'python', entry = 'main.py' }\nschedule.period = '1s'\n";

/// A built lambda.
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
    // By another key, it is another release.
    let other = publish_to(lambda.0.path(), &lambda.out(), None, 9).unwrap();
    assert_eq!(other.revision.release, 41);
    let most = lambda.publish(Some(gleaner_trust::COUNTER_MAX + 1)).unwrap_err();
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
fn two_at_once_leave_one_whole_revision() {
    let lambda = BuiltLambda::new();
    let results = thread::scope(|scope| {
        let threads: Vec<_> = (0..8)
            .map(|seed| {
                let lambda = &lambda;
                scope.spawn(move || publish_to(lambda.0.path(), &lambda.out(), None, 10 + seed))
            })
            .collect();
        threads.into_iter().map(|it| it.join().unwrap().unwrap()).collect::<Vec<_>>()
    });
    let mut releases: Vec<_> = results.iter().map(|it| it.revision.release).collect();
    releases.sort_unstable();
    assert_eq!(releases, (1..=8).collect::<Vec<_>>(), "each key is a release of its own");
    assert!(!lambda.0.path().join("revision.json.part").exists());
    assert_eq!(lambda.publish(None).unwrap().revision.release, 9);
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

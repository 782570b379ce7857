//! Clips that a run signs, and the checks of their readers: `gleaner verify CLIP --trust FILE`.

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use gleaner_base::grouped;
use gleaner_lambda::Clip;
use gleaner_tests::live::{run_all, summary};
use gleaner_tests::readers::compare_clips;
use gleaner_tests::{LambdaCopy, TempFolder, gleaner, replay_to, sample_drive};
use serde_json::Value;

/// Exit codes of a wrong command line, and of a clip that is refused.
const USAGE: i32 = 2;
const DENIED: i32 = 3;

/// Runs a command; returns its exit code and both streams.
fn ended(command: &mut Command) -> (i32, String, String) {
    let Output { status, stdout, stderr } = command.output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (status.code().unwrap(), text(stdout), text(stderr))
}

fn verify(clip: &Path, args: &[&str]) -> (i32, String, String) {
    ended(gleaner().arg("verify").arg(clip).args(args))
}

/// Makes a key; returns its file and its public key.
fn key(folder: &TempFolder, name: &str) -> (PathBuf, String) {
    let file = folder.path().join(name);
    let (code, shown, error) = ended(gleaner().args(["keys", "new", "--json"]).arg(&file));
    assert_eq!(code, 0, "{error}");
    let shown: Value = serde_json::from_str(&shown).unwrap();
    (file, shown["public"].as_str().unwrap().to_owned())
}

fn hello() -> LambdaCopy {
    LambdaCopy::named("examples/hello/rust", "hello")
}

fn clips(out: &Path) -> Vec<Clip> {
    let lines = fs::read_to_string(out.join("clips.jsonl")).unwrap();
    lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn a_signed_clip_is_verified_by_its_vehicle_and_refused_once_it_is_changed() {
    let (lambda, out, scratch) = (hello(), TempFolder::new(), TempFolder::new());
    let (key_file, public) = key(&scratch, "car.pem");
    let (_, stranger) = key(&scratch, "stranger.pem");
    let drive = sample_drive();
    let args = ["--drive", drive.to_str().unwrap(), "--rate", "4", "--set", "brake_mps2=-1.4"];
    let sign = ["--sign", key_file.to_str().unwrap(), "--vehicle-name", "car-7"];
    let finished = run_all(&[lambda.path()], out.path(), &[&args[..], &sign].concat()).finish();
    assert!(finished.status.success(), "{}", finished.stderr);
    let recording = summary(out.path()).recording.unwrap().recording;
    assert!(recording.clips > 0 && recording.unsigned == 0, "{}", finished.stderr);
    compare_clips(out.path(), &[sample_drive()]);
    let clip = &clips(out.path())[0];
    let path = out.path().join(&clip.file);

    let list = |name: &str, text: String| {
        scratch.write(name, text).into_os_string().into_string().unwrap()
    };
    let trusted = list("trusted", format!("# cars\ncar-6 {stranger}\ncar-7 {public}\n"));
    let folder = lambda.path().to_str().unwrap();
    let (code, text, error) = verify(&path, &["--trust", &trusted, "--lambda", folder]);
    assert_eq!(code, 0, "{error}");
    let messages: u64 = clip.topics.iter().map(|topic| topic.messages).sum();
    let lines: Vec<_> = text.lines().collect();
    assert!(
        lines[0].contains("signed by car-7 (key ")
            && lines[0].ends_with(&format!("Z: hello 0.1.0, {} messages", grouped(messages)))
            && lines[1].starts_with("hello: "),
        "{text}"
    );
    let json = ["--trust", &trusted, "--json", "--lambda", folder];
    let (_, text, error) = verify(&path, &json);
    let result: Value = serde_json::from_str(&text).expect(&error);
    let statement = &result["signature"]["statement"];
    assert_eq!(
        (&statement["vehicle"], &result["triggers"]),
        (&"car-7".into(), &clip.triggers.into())
    );
    assert_eq!(statement["lambdas"][0]["digest"], clip.lambdas[0].digest.as_str());
    assert_eq!(
        (&statement["messages"], statement["recovered"].as_bool()),
        (&messages.into(), Some(false))
    );
    let only = ["--trust", &trusted];
    let (code, text, _) = verify(&path, &only);
    assert_eq!((code, text.lines().count()), (0, 1), "{text}");

    for (vehicles, reason) in [
        (format!("car-7 {stranger}"), "none of the 1 trusted keys"),
        (format!("car-6 {public}"), "is that of `car-6`, and the clip names vehicle `car-7`"),
        (String::new(), "none of the 0 trusted keys"),
    ] {
        let other = list("other", vehicles);
        let (code, text, error) = verify(&path, &["--trust", &other, "--lambda", folder]);
        assert!(code == DENIED && text.is_empty(), "{code}: {text}");
        assert!(error.contains(reason) && error.contains("help:"), "{error}");
    }
    let bytes = fs::read(&path).unwrap();
    for place in 0..40 {
        let mut changed = bytes.clone();
        let at = (bytes.len() - 1) * place / 39;
        changed[at] ^= 1 << (place % 8);
        let changed = scratch.write("changed.mcap", changed);
        let (code, text, error) = verify(&changed, &only);
        assert!([USAGE, DENIED].contains(&code) && text.is_empty(), "byte {at}: {code}, {error}");
        assert!(error.contains("is not accepted") && error.contains("help:"), "{error}");
    }
    let longer = scratch.write("longer.mcap", [&bytes[..], b"\n"].concat());
    let (code, _, error) = verify(&longer, &only);
    assert!(code == DENIED && error.contains("its content has the digest"), "{error}");
}

#[test]
fn an_unsigned_clip_and_unusable_keys_and_lists_are_refused() {
    let (lambda, out, scratch) = (hello(), TempFolder::new(), TempFolder::new());
    let (key_file, public) = key(&scratch, "car.pem");
    replay_to(out.path(), lambda.path(), &[sample_drive()], &["--set", "brake_mps2=-1.4"])
        .must_exit(0);
    let path = out.path().join(&clips(out.path())[0].file);
    let trusted = scratch.write("trusted", format!("car-7 {public}\n"));
    let only = ["--trust", trusted.to_str().unwrap()];
    let (code, _, error) = verify(&path, &only);
    assert!(code == DENIED && error.contains("cause: it is not signed\n"), "{error}");
    assert!(error.contains("help:  record with `gleaner run --sign KEY`"), "{error}");

    let wrong = scratch.write("wrong", "car-7\n");
    let (code, _, error) = verify(&path, &["--trust", wrong.to_str().unwrap()]);
    assert!(code == USAGE && error.contains("line 1 of the list of vehicles"), "{error}");
    let (code, _, error) = verify(&path, &[]);
    assert!(code == USAGE && error.contains("--lambda"), "{error}");

    let drive = sample_drive();
    let run = |sign: &[&str]| {
        ended(gleaner().arg("run").arg(lambda.path()).arg("--drive").arg(&drive).args(sign))
    };
    let no_key = trusted.to_str().unwrap();
    let (code, _, error) = run(&["--sign", no_key, "--vehicle-name", "car-7"]);
    assert!(code == USAGE && error.contains("is not an ed25519 key in PEM"), "{error}");
    let (code, _, error) = run(&["--sign", key_file.to_str().unwrap(), "--vehicle-name", "car 7"]);
    assert!(code == USAGE && error.contains("is not the name of a vehicle"), "{error}");
}

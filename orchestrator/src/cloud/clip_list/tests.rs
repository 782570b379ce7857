use std::io::Write;
use std::os::unix::fs::symlink;

use super::*;

fn line(name: &str) -> String {
    let moment = serde_json::json!({ "lambda": "brake", "kind": "event", "label": "dark",
        "score": 0.5, "attributes": { "lat": 59.9 }, "at_ns": 5 });
    let clip = serde_json::json!({ "file": format!("clips/{name}.mcap"),
        "thumbnail": format!("clips/{name}.jpg"), "bytes": 3, "from_ns": 1, "to_ns": 9,
        "first_ns": null, "last_ns": null, "triggers": 1, "moments": [moment], "topics": [],
        "lambdas": [{ "name": "brake", "version": "1.0.0", "kind": "wasm", "digest": "d1",
                      "windows": 1 }],
        "incomplete": [], "recovered": null });
    format!("{clip}\n")
}

/// Creates the folder of a recorder with these clips.
fn folder(names: &[&str]) -> (tempfile::TempDir, ClipFolder) {
    let folder = tempfile::tempdir().unwrap();
    fs::create_dir(folder.path().join("clips")).unwrap();
    for name in names {
        fs::write(folder.path().join(format!("clips/{name}.mcap")), name).unwrap();
    }
    let lines: String = names.iter().map(|name| line(name)).collect();
    fs::write(folder.path().join("clips.jsonl"), lines).unwrap();
    let clips = ClipFolder(folder.path().to_owned());
    (folder, clips)
}

fn new(clips: &ClipFolder, cursor: Option<&str>) -> Option<ClipReport> {
    clips.clips(cursor, None, &[], &mut ClipReads::default()).unwrap()
}

fn names(report: &Option<ClipReport>) -> Vec<&str> {
    report.iter().flat_map(|report| &report.clips).map(|clip| clip.name.as_str()).collect()
}

#[test]
fn each_clip_is_read_once_and_a_list_that_was_begun_again_from_its_begin() {
    let (folder, clips) = folder(&["a", "b"]);
    let first = new(&clips, None);
    assert_eq!(names(&first), ["a", "b"]);
    let facts = &first.as_ref().unwrap().clips[0];
    assert_eq!(facts.sha256.as_deref(), Some(sha256(b"a").as_str()));
    assert_eq!((facts.bytes, &*facts.moments[0].label), (1, "dark"));
    let cursor = first.unwrap().cursor.unwrap();
    assert_eq!((new(&clips, Some(&cursor)), offset(&cursor)), (None, Some(clips.length())));
    // A line that is still written does not count yet.
    let mut list = File::options().append(true).open(folder.path().join("clips.jsonl")).unwrap();
    let third = line("c");
    list.write_all(&third.as_bytes()[..20]).unwrap();
    assert_eq!(new(&clips, Some(&cursor)), None);
    list.write_all(&third.as_bytes()[20..]).unwrap();
    let third = new(&clips, Some(&cursor));
    assert_eq!(names(&third), ["c"]);
    assert_eq!(third.unwrap().clips[0].sha256, None, "its file is gone");
    fs::write(folder.path().join("clips.jsonl"), line("d")).unwrap();
    assert_eq!(names(&new(&clips, Some(&cursor))), ["d"]);
    for nonsense in ["", "x", "9999999-5-aa", "0-0-aa", "3-9-aa"] {
        assert_eq!(names(&new(&clips, Some(nonsense))), ["d"], "{nonsense}");
    }
}

#[test]
fn names_with_paths_and_links_are_not_followed() {
    let (folder, clips) = folder(&[]);
    let secret = folder.path().join("secret.mcap");
    fs::write(&secret, "secret").unwrap();
    symlink(&secret, folder.path().join("clips/link.mcap")).unwrap();
    symlink(&secret, folder.path().join("clips/link.jpg")).unwrap();
    let lines = [line("../secret"), line("a/b"), "nonsense\n".to_owned(), line("link")].concat();
    fs::write(folder.path().join("clips.jsonl"), lines).unwrap();
    let report = new(&clips, None);
    assert_eq!(names(&report), ["link"]);
    let facts = &report.as_ref().unwrap().clips[0];
    assert_eq!((&facts.sha256, &facts.thumbnail), (&None, &None));
    let refused = clips.piece(&facts.name, 6, (0, 6)).unwrap_err();
    assert!(is_gone(&refused), "{refused}");
}

#[test]
fn a_piece_is_of_the_file_that_was_announced() {
    let (folder, clips) = folder(&["a"]);
    let path = folder.path().join("clips/a.mcap");
    fs::write(&path, "0123456789").unwrap();
    let name: ClipName = "a".parse().unwrap();
    assert_eq!(clips.piece(&name, 10, (3, 4)).unwrap(), b"3456");
    assert_eq!(clips.piece(&name, 10, (8, 4)).unwrap(), b"89");
    assert!(is_gone(&clips.piece(&name, 10, (10, 4)).unwrap_err()), "it is beyond the end");
    assert!(is_gone(&clips.piece(&name, 9, (0, 4)).unwrap_err()), "it has another length");
    fs::remove_file(path).unwrap();
    assert!(is_gone(&clips.piece(&name, 10, (0, 4)).unwrap_err()));
}

/// The digest was computed with `sha256sum`, over its own lines of the two files.
#[test]
fn a_build_is_found_by_the_digest_that_clips_have() {
    let key = gleaner_trust::SecretKey::generate().unwrap();
    let file = |path: &str, content: &[u8]| gleaner_trust::RevisionFile {
        path: path.parse().unwrap(),
        bytes: 1,
        sha256: sha256(content),
    };
    let revision = gleaner_trust::Revision {
        name: "brake".parse().unwrap(),
        version: "1.0.0".parse().unwrap(),
        kind: serde_json::from_value(serde_json::json!("wasm")).unwrap(),
        release: 1,
        created: 1,
        files: vec![file("lambda.toml", b"a"), file("models/a.onnx", b"b")],
    };
    let envelope = gleaner_trust::seal(&revision, &[&key]).unwrap();
    let expected = "ae5853b272b64d515ad0a5783db1e65d34cc9d278373224157614818426e89de";
    assert_eq!(build_digest(&envelope).as_deref(), Some(expected));
}

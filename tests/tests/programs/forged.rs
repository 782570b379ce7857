//! A clip with changed statements, messages or attachments is refused; the message names the record
//! and the key.
//!
//! Each forgery writes the clip with correct checksums, so that only the comparison of the clip
//! with itself can find it.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::PathBuf;
use std::sync::Arc;

use gleaner_lambda::Clip;
use gleaner_tests::parts::{ClipAttachment, ClipParts};
use gleaner_tests::{TempFolder, Verification, replay_to, root, sample_drive, verify};
use mcap::Channel;
use mcap::records::Metadata;

const CAMERA: &str = "/camera/front/compressed";
const IMU: &str = "/imu/data";

/// Clips of hello, the last of which begin later than the drive.
struct RecordedClips {
    lambda: PathBuf,
    out: TempFolder,
    clips: Vec<PathBuf>,
}

impl RecordedClips {
    fn of(kind: &str) -> Self {
        let (lambda, out) = (root().join("examples/hello").join(kind), TempFolder::new());
        let run = replay_to(out.path(), &lambda, &[sample_drive()], &["--set", "brake_mps2=-1.4"]);
        run.must_exit(0);
        let clips = run.clips.iter().map(|clip| out.path().join(&clip.file)).collect();
        Self { lambda, out, clips }
    }

    fn verify(&self, parts: &ClipParts) -> Verification {
        let path = self.out.write("forged.mcap", parts.bytes());
        verify(&[
            "verify".as_ref(),
            path.as_ref(),
            "--lambda".as_ref(),
            self.lambda.as_ref() as &OsStr,
        ])
    }
}

/// A forgery: its name, its change, and words of the error.
type Forgery = (String, Box<dyn Fn(&mut ClipParts)>, Vec<String>);

fn forgery(name: &str, words: &[&str], change: impl Fn(&mut ClipParts) + 'static) -> Forgery {
    (name.to_owned(), Box::new(change), words.iter().map(|word| (*word).to_owned()).collect())
}

/// Another value of the same kind, if possible.
fn other(value: &str) -> String {
    match value.parse::<i64>() {
        Ok(number) => (number + 1).to_string(),
        Err(_) => format!("{value}0"),
    }
}

/// Drops and duplicates every record, adds a key, and removes or changes each key.
fn records(parts: &ClipParts) -> Vec<Forgery> {
    let mut forgeries = Vec::new();
    for (index, Metadata { name, metadata }) in parts.metadata.iter().enumerate() {
        let of = |what: &str| format!("{what}: record {index}, {name}");
        let named = &[name.as_str()];
        forgeries
            .push(forgery(&of("dropped"), named, move |parts| drop(parts.metadata.remove(index))));
        forgeries.push(forgery(&of("duplicated"), named, move |parts| {
            let double = parts.metadata[index].clone();
            parts.metadata.push(double);
        }));
        forgeries.push(forgery(&of("an additional key"), &[name, "more"], move |parts| {
            parts.metadata[index].metadata.insert("more".to_owned(), "1".to_owned());
        }));
        for key in metadata.keys() {
            let (gone, words) = (key.clone(), &[name.as_str(), key.as_str()]);
            forgeries.push(forgery(&of(&format!("without `{key}`")), words, move |parts| {
                parts.metadata[index].metadata.remove(&gone);
            }));
            let changed = key.clone();
            forgeries.push(forgery(&of(&format!("another `{key}`")), named, move |parts| {
                let value = parts.metadata[index].metadata.get_mut(&changed).unwrap();
                *value = other(value);
            }));
        }
    }
    forgeries
}

/// The line of the clip, as `clips.jsonl` has it.
fn line_of(parts: &mut ClipParts) -> Clip {
    serde_json::from_str(&parts.record("clip")["line"]).unwrap()
}

/// Changes the attributes of the decision and of the line.
fn change_attributes(parts: &mut ClipParts) {
    let attributes = r#"{"pedestrian":true}"#;
    parts.record("decision").insert("attributes".to_owned(), attributes.to_owned());
    parts
        .change_line(|line| line.moments[0].attributes = serde_json::from_str(attributes).unwrap());
}

/// Changes that are consistent in more than one place of the clip.
fn statements() -> Vec<Forgery> {
    vec![
        forgery("attributes of a decision", &["gleaner.decision"], |parts| {
            parts
                .record("decision")
                .insert("attributes".to_owned(), r#"{"pedestrian":true}"#.to_owned());
        }),
        forgery("attributes of a decision and of the line", &["gleaner.begin"], change_attributes),
        forgery("attributes everywhere", &["gleaner.decision"], |parts| {
            change_attributes(parts);
            let moment = line_of(parts).moments.remove(0);
            parts
                .record("begin")
                .insert("moment".to_owned(), serde_json::to_string(&moment).unwrap());
        }),
        forgery("one trigger fewer, everywhere", &["gleaner.decision", "trigger 1"], |parts| {
            parts.metadata.retain(|metadata| metadata.name != "gleaner.decision");
            parts.record("clip").insert("triggers".to_owned(), "0".to_owned());
            parts.change_line(|line| {
                line.triggers = 0;
                line.moments.clear();
                line.incomplete.push("continues the clip before".to_owned());
            });
            let short = line_of(parts).incomplete.join("; ");
            parts.record("clip").insert("incomplete".to_owned(), short);
        }),
        forgery("one additional trigger, counted only", &["gleaner.clip", "triggers"], |parts| {
            parts.record("clip").insert("triggers".to_owned(), "7".to_owned());
            parts.change_line(|line| line.triggers = 7);
        }),
        forgery("version of the lambda, twice", &["gleaner.lambda", "version"], |parts| {
            parts.record("lambda").insert("version".to_owned(), "9.9.9".to_owned());
            parts.change_line(|line| line.lambdas[0].version = "9.9.9".to_owned());
        }),
        forgery("first_ns, twice", &["gleaner.clip", "first_ns"], |parts| {
            parts.change_line(|line| line.first_ns = line.first_ns.map(|at_ns| at_ns + 1));
            let first_ns = other(&parts.record("clip")["first_ns"]);
            parts.record("clip").insert("first_ns".to_owned(), first_ns);
        }),
        forgery(
            "from_ns after the first message, three times",
            &["gleaner.clip", "from_ns"],
            |parts| {
                let later = line_of(parts).moments[0].at_ns;
                parts.change_line(|line| line.from_ns = later);
                parts.record("clip").insert("from_ns".to_owned(), later.to_string());
                parts.record("begin").insert("from_ns".to_owned(), later.to_string());
            },
        ),
        forgery("received, twice", &["gleaner.topic", "received"], |parts| {
            parts.topic(CAMERA).insert("received".to_owned(), "1000".to_owned());
            parts.change_line(|line| {
                line.topics
                    .iter_mut()
                    .filter(|of| of.topic == CAMERA)
                    .for_each(|of| of.received = Some(1000));
            });
        }),
        forgery("a number out of range", &["gleaner.topic", "overwritten"], |parts| {
            parts.topic(CAMERA).insert("overwritten".to_owned(), u64::MAX.to_string());
        }),
        forgery("a record that no recorder writes", &["gleaner.more"], |parts| {
            parts
                .metadata
                .push(Metadata { name: "gleaner.more".to_owned(), metadata: BTreeMap::new() });
        }),
    ]
}

fn messages() -> Vec<Forgery> {
    let camera = &["gleaner.topic", CAMERA];
    let checksum = &["gleaner.topic", CAMERA, "checksum"];
    let state_no_messages = |parts: &mut ClipParts| {
        parts.topic(CAMERA).insert("messages".to_owned(), "0".to_owned());
        parts.topic(CAMERA).insert("checksum".to_owned(), "0".repeat(16));
    };
    vec![
        forgery("no camera message", checksum, |parts| parts.drop_messages_of(CAMERA)),
        forgery("no camera message, and 0 stated", &["gleaner.topic", CAMERA], move |parts| {
            parts.drop_messages_of(CAMERA);
            state_no_messages(parts);
        }),
        forgery(
            "no camera message, and 0 stated twice",
            &["gleaner.topic", CAMERA, "received"],
            move |parts| {
                parts.drop_messages_of(CAMERA);
                state_no_messages(parts);
                parts.change_line(|line| {
                    line.topics
                        .iter_mut()
                        .filter(|of| of.topic == CAMERA)
                        .for_each(|of| of.messages = 0);
                });
            },
        ),
        forgery("no camera message and no record of any topic", &["gleaner.topic"], |parts| {
            parts.drop_messages_of(CAMERA);
            parts.metadata.retain(|metadata| metadata.name != "gleaner.topic");
        }),
        forgery("one camera message fewer", checksum, |parts| {
            let first = parts.channel_of(CAMERA);
            let index = parts.messages.iter().position(|(channel, ..)| *channel == first).unwrap();
            parts.messages.remove(index);
        }),
        forgery("one camera message fewer, and one fewer stated", camera, |parts| {
            let first = parts.channel_of(CAMERA);
            let index = parts.messages.iter().position(|(channel, ..)| *channel == first).unwrap();
            parts.messages.remove(index);
            let stated = parts.topic(CAMERA)["messages"].parse::<u64>().unwrap() - 1;
            parts.topic(CAMERA).insert("messages".to_owned(), stated.to_string());
        }),
        forgery("one camera message twice", checksum, |parts| {
            let double = parts.messages_of(CAMERA)[3].clone();
            parts.messages.push(double);
        }),
        forgery("every camera message is the first", checksum, |parts| {
            let mut all = parts.messages_of(CAMERA);
            let first = all[0].2.clone();
            all.iter_mut().for_each(|message| message.2.clone_from(&first));
        }),
        forgery("two camera messages exchange their bytes", checksum, |parts| {
            let mut all = parts.messages_of(CAMERA);
            let (first, second) = (all[3].2.clone(), all[4].2.clone());
            all[3].2 = second;
            all[4].2 = first;
        }),
        forgery("one byte of a camera message", checksum, |parts| {
            *parts.messages_of(CAMERA)[2].2.last_mut().unwrap() ^= 1
        }),
        forgery("the options of a camera message", checksum, |parts| {
            parts.messages_of(CAMERA)[2].2[3] ^= 1
        }),
        forgery("the stamp of a camera message", checksum, |parts| {
            parts.messages_of(CAMERA)[2].1.log_time += 1
        }),
        forgery("the time of a camera message's writer", checksum, |parts| {
            parts.messages_of(CAMERA)[2].1.publish_time += 1;
        }),
        forgery("the number of a camera message", checksum, |parts| {
            parts.messages_of(CAMERA)[2].1.sequence += 5000
        }),
        forgery("a byte of an IMU message", &["gleaner.topic", IMU, "checksum"], |parts| {
            *parts.messages_of(IMU)[20].2.last_mut().unwrap() ^= 1;
        }),
    ]
}

fn channels() -> Vec<Forgery> {
    vec![
        forgery(
            "another definition of the camera",
            &["gleaner.topic", CAMERA, "definitions"],
            |parts| {
                let index = parts.channel_of(CAMERA);
                let mut channel = Channel::clone(&parts.channels[index]);
                let mut schema = mcap::Schema::clone(channel.schema.as_ref().unwrap());
                schema.data = Cow::Owned([&schema.data[..], b"\nfloat64 more\n"].concat());
                channel.schema = Some(Arc::new(schema));
                parts.channels[index] = Arc::new(channel);
            },
        ),
        forgery("a second type on the camera's topic", &[CAMERA], |parts| {
            let mut channel = Channel::clone(&parts.channels[parts.channel_of(CAMERA)]);
            channel.schema.clone_from(&parts.channels[parts.channel_of(IMU)].schema);
            channel.id = 999;
            parts.channels.push(Arc::new(channel));
        }),
        forgery("a topic that no record names", &["gleaner.topic", "/other"], |parts| {
            let mut channel = Channel::clone(&parts.channels[parts.channel_of(CAMERA)]);
            (channel.topic, channel.id) = ("/other".to_owned(), 999);
            parts.channels.push(Arc::new(channel));
        }),
    ]
}

/// Changed attachments. `other` is the journal of another clip.
fn attachments(other: ClipAttachment) -> Vec<Forgery> {
    let thumbnail = |parts: &ClipParts| {
        parts.attachments.iter().position(|of| of.name == "thumbnail.jpg").unwrap()
    };
    vec![
        forgery("a second journal of garbage", &["attachment `journal/hello.journal`"], |parts| {
            let garbage = ClipAttachment { data: b"garbage".to_vec(), ..parts.journal().clone() };
            parts.attachments.push(garbage);
        }),
        forgery("a second journal of garbage before the first", &["journal"], |parts| {
            let garbage = ClipAttachment { data: b"garbage".to_vec(), ..parts.journal().clone() };
            parts.attachments.insert(0, garbage);
        }),
        forgery("the journal twice", &["attachment `journal/hello.journal`"], |parts| {
            let double = parts.journal().clone();
            parts.attachments.push(double);
        }),
        forgery("a journal of garbage", &["journal"], |parts| {
            parts.journal().data = b"garbage".to_vec()
        }),
        forgery("an empty journal", &["journal"], |parts| parts.journal().data = Vec::new()),
        forgery("a journal with a changed byte", &["journal"], |parts| {
            let data = &mut parts.journal().data;
            let middle = data.len() / 2;
            data[middle] ^= 1;
        }),
        forgery("a truncated journal", &["has no end"], |parts| {
            let data = &mut parts.journal().data;
            data.truncate(data.len() - 5);
        }),
        forgery("the journal of another clip", &["sample", "journal"], move |parts| {
            *parts.journal() = other.clone()
        }),
        forgery("no journal", &["no journal"], |parts| {
            parts.attachments.retain(|attachment| !attachment.name.starts_with("journal/"));
        }),
        forgery(
            "the journal of a lambda that is not in the clip",
            &["attachment `journal/other.journal`"],
            |parts| {
                let other = ClipAttachment {
                    name: "journal/other.journal".to_owned(),
                    ..parts.journal().clone()
                };
                parts.attachments.push(other);
            },
        ),
        forgery("another thumbnail", &["gleaner.clip", "thumbnail"], move |parts| {
            let index = thumbnail(parts);
            *parts.attachments[index].data.last_mut().unwrap() ^= 1;
        }),
        forgery("no thumbnail", &["gleaner.clip", "thumbnail"], move |parts| {
            let index = thumbnail(parts);
            parts.attachments.remove(index);
        }),
        forgery("two thumbnails", &["attachment `thumbnail.jpg`"], move |parts| {
            let double = parts.attachments[thumbnail(parts)].clone();
            parts.attachments.push(double);
        }),
        forgery("an unknown file", &["attachment `notes.txt`"], |parts| {
            let notes = ClipAttachment { name: "notes.txt".to_owned(), ..parts.journal().clone() };
            parts.attachments.push(notes);
        }),
    ]
}

fn all_forgeries_are_refused(kind: &str) {
    let recorded = RecordedClips::of(kind);
    let mut original = ClipParts::of(&recorded.clips[1]);
    let control = recorded.verify(&original);
    assert_eq!(control.exit, 0, "the original clip is refused: {}", control.stderr);
    let other = ClipParts::of(&recorded.clips[0]).journal().clone();
    assert!(
        original.messages_of(CAMERA).len() > 10
            && original.metadata.iter().any(|of| of.name == "gleaner.decision")
    );
    let all = [records(&original), statements(), messages(), channels(), attachments(other)];
    let forgeries: Vec<Forgery> = all.into_iter().flatten().collect();
    assert!(forgeries.len() > 150, "{}", forgeries.len());
    let mut accepted = Vec::new();
    for (name, change, words) in &forgeries {
        let mut forged = original.clone();
        change(&mut forged);
        let Verification { exit, stderr, .. } = recorded.verify(&forged);
        let missing: Vec<_> = words.iter().filter(|word| !stderr.contains(word.as_str())).collect();
        if ![2, 4].contains(&exit) || !missing.is_empty() {
            accepted.push(format!("{name}: exit {exit}, without {missing:?}: {stderr}"));
        }
    }
    println!("{} forgeries of a clip in {kind}", forgeries.len());
    assert!(
        accepted.is_empty(),
        "{} of {}:\n{}",
        accepted.len(),
        forgeries.len(),
        accepted.join("\n")
    );
}

#[test]
fn every_forged_clip_of_a_wasm_lambda_is_refused() {
    all_forgeries_are_refused("rust");
}

#[test]
fn every_forged_clip_of_a_python_lambda_is_refused() {
    all_forgeries_are_refused("python");
}

//! Signed clips: no byte can be changed, added or removed.

use std::fs;
use std::sync::atomic::Ordering;

use gleaner_base::Explain;
use gleaner_trust::{
    ClipRefusal, ClipSigner, MEDIA_TYPE, Refusal, SIGNATURE, SecretKey, SignedClip,
    TrustedVehicles, sha256, verify_clip,
};

use super::*;
use crate::file::clip_dir::PART;

const CLIP: &str = "clips/a.mcap";
/// Length of the attachment's fields before its data.
const FIELDS: usize = 8 + 8 + 4 + SIGNATURE.len() + 4 + MEDIA_TYPE.len() + 8;

fn key(seed: u8) -> SecretKey {
    SecretKey::from_bytes(&[seed; 32])
}

fn trusted(vehicles: &[(&str, u8)]) -> TrustedVehicles {
    let lines = vehicles.iter().map(|(name, seed)| format!("{name} {}\n", key(*seed).public()));
    TrustedVehicles::parse(lines.collect::<String>().as_bytes()).unwrap()
}

fn verify(clip: &[u8]) -> Result<SignedClip, ClipRefusal> {
    verify_clip(clip, &trusted(&[("car-7", 7)]))
}

fn signing(scratch: &TestDir) -> RecordingFolder {
    let folder = RecordingFolder::open_without_recovery(&scratch.0).unwrap();
    folder.sign_clips(ClipSigner::new(key(7), "car-7".parse().unwrap()));
    folder
}

/// Returns a folder with a signed clip, its bytes, and the number of clips without a signature.
fn recorded(trailer: ClipTrailer) -> (TestDir, Vec<u8>, u64) {
    let scratch = TestDir::new();
    let mut folder = signing(&scratch);
    let clip = begun(&mut folder, "a", 9).finish(trailer).unwrap();
    let bytes = fs::read(scratch.path(CLIP)).unwrap();
    assert_eq!((clip.bytes, scratch.listed()), (bytes.len() as u64, vec![clip]));
    let unsigned = folder.unsigned().load(Ordering::Relaxed);
    (scratch, bytes, unsigned)
}

#[test]
fn a_signed_clip_is_a_usual_one_and_states_its_origin() {
    let (scratch, bytes, unsigned) = recorded(trailer());
    assert_eq!(unsigned, 0);
    assert_eq!(numbers(&scratch.path(CLIP)), (0..9).collect::<Vec<_>>());
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let index = summary.attachment_indexes.last().unwrap();
    assert_eq!(index.name, SIGNATURE);
    let attachment = mcap::read::attachment(&bytes, index).unwrap();
    let start = b"{\"payloadType\":\"application/vnd.gleaner.clip.v1+json";
    assert!(attachment.data.starts_with(start));
    let SignedClip { statement, key: signer } = verify(&bytes).unwrap();
    assert_eq!(signer, key(7).public().id());
    let losses = &statement.losses;
    assert_eq!((losses.lost, losses.overwritten, losses.reasons), (None, None, 1));
    assert_eq!((&*statement.clip, statement.messages, statement.triggers), ("a", 9, 2));
    assert_eq!((statement.from_ns, statement.to_ns), (10 * SECOND, 20 * SECOND));
    assert_eq!(statement.lambdas[0].name.as_str(), "hello");
    assert_eq!(statement.lambdas[0].digest.as_str(), "ab".repeat(32));
    assert_eq!(statement.journals[0].name, "journal/hello.journal");
    assert_eq!(statement.journals[0].sha256, sha256(b"a journal"));
    assert!(!statement.recovered && statement.created > 1_700_000_000);
}

#[test]
fn every_changed_removed_added_or_cut_byte_is_refused() {
    let (_scratch, bytes, _) = recorded(trailer());
    verify(&bytes).unwrap();
    for at in 0..bytes.len() {
        let mut changed = bytes.clone();
        changed[at] ^= 1 << (at % 8);
        let refusal = verify(&changed).unwrap_err();
        assert!(refusal.to_string().len() < 400 && refusal.help().is_some(), "{refusal}");
        let mut removed = bytes.clone();
        removed.remove(at);
        assert!(verify(&removed).is_err(), "without byte {at}");
        assert!(verify(&bytes[..at]).is_err(), "cut at {at}");
        let mut added = bytes.clone();
        added.insert(at, bytes[at]);
        assert!(verify(&added).is_err(), "byte {at} twice");
    }
    for byte in 0..=255 {
        verify(&[&bytes[..], &[byte]].concat()).unwrap_err();
    }
}

fn envelope(clip: &[u8]) -> std::ops::Range<usize> {
    let summary = mcap::Summary::read(clip).unwrap().unwrap();
    let index = summary.attachment_indexes.last().unwrap();
    let end = (index.offset + index.length) as usize - 4;
    end - index.data_size as usize..end
}

/// Puts `text` in the place of the envelope, with the two checksums that depend on it.
fn replaced(clip: &[u8], text: &[u8]) -> Vec<u8> {
    let (mut clip, place) = (clip.to_vec(), envelope(clip));
    let end = place.end;
    clip[place.clone()].copy_from_slice(text);
    let crc = crc32fast::hash(&clip[place.start - FIELDS..end]);
    clip[end..end + 4].copy_from_slice(&crc.to_le_bytes());
    let crc = crc32fast::hash(&clip[..end + 4]);
    clip[end + 13..end + 17].copy_from_slice(&crc.to_le_bytes());
    clip
}

#[test]
fn another_form_of_the_same_envelope_is_refused() {
    let (_scratch, bytes, _) = recorded(trailer());
    let place = envelope(&bytes);
    let text = str::from_utf8(&bytes[place.clone()]).unwrap();
    assert_eq!(replaced(&bytes, text.as_bytes()), bytes);
    // The same members in another order.
    let (payload_type, rest) = text[1..].split_once(',').unwrap();
    let (payload, signatures) = rest[..rest.len() - 1].split_once(',').unwrap();
    let other = format!("{{{payload},{payload_type},{signatures}}}");
    let refusal = verify(&replaced(&bytes, other.as_bytes())).unwrap_err();
    assert!(matches!(refusal, ClipRefusal::Form(_)), "{refusal}");
    // The checksums alone.
    for at in [place.end, place.end + 13] {
        let mut other = bytes.clone();
        other[at] ^= 1;
        let refusal = verify(&other).unwrap_err();
        assert!(matches!(refusal, ClipRefusal::Checksum(_)), "{refusal}");
    }
}

#[test]
fn a_second_signature_and_the_signature_of_another_clip_are_refused() {
    let (_scratch, bytes, _) = recorded(trailer());
    let place = envelope(&bytes);
    let start = place.start - FIELDS - 9;
    let record = bytes[start..place.end + 4].to_vec();
    for at in [start, place.end + 4] {
        let mut twice = bytes.clone();
        twice.splice(at..at, record.iter().copied());
        let refusal = verify(&twice).unwrap_err();
        assert!(matches!(refusal, ClipRefusal::Form(_)), "{refusal}");
    }
    let (_other, other, _) = recorded(ClipTrailer { triggers: 3, ..trailer() });
    let refusal = verify(&replaced(&bytes, &other[envelope(&other)])).unwrap_err();
    assert!(matches!(refusal, ClipRefusal::Content { .. }), "{refusal}");
}

#[test]
fn other_keys_other_names_and_unsigned_clips_are_refused_by_what_they_are() {
    let (_scratch, bytes, _) = recorded(trailer());
    let by = |vehicles: &[(&str, u8)]| verify_clip(&bytes[..], &trusted(vehicles));
    by(&[("car-8", 8), ("car-7", 6), ("car-7", 7)]).unwrap();
    for vehicles in [&[][..], &[("car-7", 8)]] {
        let refused = by(vehicles).unwrap_err();
        let is_key = matches!(refused, ClipRefusal::Statement(Refusal::UnknownKey { .. }));
        assert!(is_key, "{refused}");
    }
    let refused = by(&[("car-8", 7), ("car-7", 8)]).unwrap_err();
    assert!(refused.to_string().contains("`car-8`, and the clip names vehicle `car-7`"));

    let scratch = TestDir::new();
    begun(&mut scratch.open().0, "a", 9).finish(trailer()).unwrap();
    let refused = verify(&fs::read(scratch.path(CLIP)).unwrap()).unwrap_err();
    assert!(matches!(refused, ClipRefusal::Unsigned), "{refused}");
    assert!(matches!(verify(b"no mcap file"), Err(ClipRefusal::NotMcap)));
}

#[test]
fn a_clip_that_cannot_be_signed_is_written_without_a_signature_and_counted() {
    let nameless = ClipLambda { name: "No Lambda".to_owned(), ..lambda() };
    let (scratch, bytes, unsigned) = recorded(ClipTrailer { lambdas: vec![nameless], ..trailer() });
    assert_eq!(unsigned, 1);
    assert_eq!(numbers(&scratch.path(CLIP)), (0..9).collect::<Vec<_>>());
    assert!(matches!(verify(&bytes), Err(ClipRefusal::Unsigned)));
}

#[test]
fn a_clip_of_a_dead_recorder_is_signed_by_the_next_one_which_states_it() {
    let (_scratch, bytes, _) = recorded(trailer());
    // From within the first messages to the last byte before the end.
    let mut count = 0;
    for cut in (bytes.len() / 4..bytes.len()).step_by(97).chain([bytes.len() - 1]) {
        let scratch = TestDir::new();
        fs::create_dir(scratch.path("clips")).unwrap();
        fs::write(scratch.path(&format!("clips/a{PART}")), &bytes[..cut]).unwrap();
        let mut recovery = signing(&scratch).take_unfinished();
        let Some(clip) = recovery.next(&mut || true) else { continue };
        let recovered = verify(&fs::read(scratch.0.join(clip.unwrap().file)).unwrap()).unwrap();
        assert!(recovered.statement.recovered, "cut at {cut}");
        count += 1;
    }
    assert!(count > 10, "only {count} were recovered");
    // A file that lacked only its name keeps its signature.
    let scratch = TestDir::new();
    fs::create_dir(scratch.path("clips")).unwrap();
    fs::write(scratch.path(&format!("clips/a{PART}")), &bytes).unwrap();
    scratch.open();
    assert!(!verify(&fs::read(scratch.path(CLIP)).unwrap()).unwrap().statement.recovered);
}

//! Envelopes that were changed, cut, or made to exhaust the reader.

use gleaner_trust::{Deployment, Floors, Refusal, Revision, Trusted, first_root, seal};

use super::*;

fn verify(envelope: &[u8]) -> Result<Trusted<Revision>, Refusal> {
    on_vehicle(|vehicle| vehicle.revision(envelope))
}

#[test]
fn every_changed_byte_is_refused_with_a_reason_of_its_place() {
    let envelope = signed_revision(1);
    let text = String::from_utf8(envelope.clone()).unwrap();
    let place = |name: &str| {
        let start = text.find(&format!("\"{name}\":\"")).unwrap() + name.len() + 4;
        start..start + text[start..].find('"').unwrap()
    };
    let (kind, payload, id, sig) =
        (place("payloadType"), place("payload"), place("keyid"), place("sig"));
    let mut wrong = 0;
    for at in 0..envelope.len() {
        for mask in [1, 1 << (at % 8), 0xff] {
            let mut changed = envelope.clone();
            changed[at] ^= mask;
            let refusal = verify(&changed).unwrap_err();
            let fits = match &refusal {
                // Any byte may become one that JSON or base64 does not have.
                Refusal::Malformed { .. } => true,
                Refusal::WrongType { .. } => kind.contains(&at),
                Refusal::UnknownKey { .. } => id.contains(&at),
                Refusal::WrongSignature { .. } => payload.contains(&at) || sig.contains(&at),
                _ => false,
            };
            assert!(fits, "byte {at} by {mask}: {refusal:?}");
            wrong += usize::from(!matches!(refusal, Refusal::Malformed { .. }));
        }
    }
    assert!(wrong > 400, "only {wrong} reasons were not that of the form");
}

#[test]
fn every_truncation_and_every_appended_byte_is_refused() {
    let envelope = signed_revision(1);
    for length in 0..envelope.len() {
        let refusal = verify(&envelope[..length]).unwrap_err();
        assert!(matches!(refusal, Refusal::Malformed { .. }), "{length}: {refusal:?}");
    }
    for byte in (0..=255).filter(|byte| !b" \t\r\n".contains(byte)) {
        verify(&[&envelope[..], &[byte]].concat()).unwrap_err();
    }
}

#[test]
fn a_payload_does_not_pass_as_another_type() {
    let deployment = deployment(1, &signed_revision(1));
    let envelope = seal(&deployment, &[&key(PUBLISHER)]).unwrap();
    assert!(matches!(verify(&envelope), Err(Refusal::WrongType { .. })));
    // With the type replaced, the signature is wrong.
    let text = String::from_utf8(envelope).unwrap().replace(DEPLOYMENT, REVISION);
    assert!(matches!(verify(text.as_bytes()), Err(Refusal::WrongSignature { .. })));
    // Signed with the other type, the fields are unknown.
    let payload = serde_json::to_vec(&deployment).unwrap();
    let refusal = verify(&forged(REVISION, &payload, PUBLISHER)).unwrap_err();
    assert!(matches!(refusal, Refusal::Malformed { .. }), "{refusal:?}");
}

#[test]
fn signatures_of_other_keys_are_refused_by_what_they_are() {
    let refusal = verify(&seal(&revision(1), &[&key(DEPLOYER)]).unwrap()).unwrap_err();
    assert!(matches!(refusal, Refusal::UnknownKey { trusted: 1, .. }), "{refusal:?}");
    assert!(refusal.to_string().contains(key(DEPLOYER).public().id().as_str()));
    // A stranger's signature under the id of a trusted key.
    let stranger = seal(&revision(1), &[&key(9)]).unwrap();
    let [own, trusted] = [9, PUBLISHER].map(|seed| key(seed).public().id().to_string());
    let text = String::from_utf8(stranger).unwrap().replace(&own, &trusted);
    assert!(matches!(verify(text.as_bytes()), Err(Refusal::WrongSignature { .. })));
    assert!(matches!(verify(&seal(&revision(1), &[]).unwrap()), Err(Refusal::UnknownKey { .. })));
    // A second signature, of a key that is not trusted yet, does not matter.
    verify(&seal(&revision(1), &[&key(9), &key(PUBLISHER)]).unwrap()).unwrap();
    verify(&seal(&revision(1), &[&key(PUBLISHER), &key(PUBLISHER)]).unwrap_or_default())
        .unwrap_err();
}

#[test]
fn payloads_beyond_their_bounds_are_refused_although_they_are_signed() {
    let text = String::from_utf8(serde_json::to_vec(&revision(1)).unwrap()).unwrap();
    let file = text[text.find("[{").unwrap() + 1..text.find("}]").unwrap() + 1].to_owned();
    let with = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        text.replace(from, to)
    };
    let deep = format!(r#""files":{}{}"#, "[".repeat(100_000), "]".repeat(100_000));
    let files = |count: usize| {
        let files = (0..count).map(|n| file.replace("models", &format!("{n:05}")));
        with(&file, &files.collect::<Vec<_>>().join(","))
    };
    verify(&forged(REVISION, files(4_000).as_bytes(), PUBLISHER)).unwrap();
    for payload in [
        files(4_001),
        with("\"files\":", &format!("{deep},\"files\":")),
        with("\"release\":1", "\"release\":1,\"release\":2"),
        with("\"release\":1", "\"release\":0"),
        with("\"release\":1", "\"release\":9007199254740992"),
        with("\"release\":1", "\"release\":1e3"),
        with("\"release\":1", "\"release\":-1"),
        with("\"release\":1", "\"release\":1,\"more\":1"),
        with("\"release\":1,", ""),
        with("1800000000", "253402300800"),
        with("\"bytes\":3", "\"bytes\":2147483649"),
        with("models/", "../"),
        with("models/", "/"),
        with("models/", "a//"),
        with("models/", "a\\u0000/"),
        with("models/", &"a".repeat(300)),
        with("brake-dark", "Brake"),
        with("python", "perl"),
        with(&file, &format!("{file},{file}")),
        with(&"0".repeat(64), &"0".repeat(63)),
        format!("{text}x"),
        String::new(),
        "null".to_owned(),
    ] {
        let refusal = verify(&forged(REVISION, payload.as_bytes(), PUBLISHER)).unwrap_err();
        assert!(matches!(refusal, Refusal::Malformed { .. }), "{refusal:?}");
        assert!(refusal.to_string().len() < 400, "{refusal}");
    }
}

#[test]
fn envelopes_that_are_too_much_are_refused_before_they_are_parsed() {
    let refusal = verify(&vec![b'['; (4 << 20) + 1]).unwrap_err();
    assert!(matches!(refusal, Refusal::TooLarge { bytes: 4_194_305, .. }), "{refusal:?}");
    let nested = "[".repeat(1 << 20);
    let sig = r#"{"keyid":"a","sig":""}"#;
    let many = vec![sig; 17].join(",");
    for text in [
        nested.clone(),
        format!(r#"{{"payloadType":"{REVISION}","payload":"","signatures":{nested}"#),
        format!(r#"{{"payloadType":"{REVISION}","payload":"","signatures":[{many}]}}"#),
        format!(r#"{{"payloadType":"{REVISION}","payload":"","payload":"","signatures":[]}}"#),
    ] {
        let refusal = verify(text.as_bytes()).unwrap_err();
        assert!(matches!(refusal, Refusal::Malformed { .. }), "{refusal:?}");
    }
}

#[test]
fn config_with_a_key_twice_and_with_too_many_keys_is_refused() {
    let envelope = signed_revision(1);
    let text = String::from_utf8(serde_json::to_vec(&deployment(1, &envelope)).unwrap()).unwrap();
    let check = |config: &str| {
        let payload = text.replace(r#""config":{}"#, &format!(r#""config":{{{config}}}"#));
        on_vehicle(|vehicle| vehicle.deployment(&forged(DEPLOYMENT, payload.as_bytes(), DEPLOYER)))
    };
    let verified = check(r#""a":1,"b":2.5,"c":"ö","d":true"#).unwrap();
    assert_eq!(verified.payload().config.len(), 4);
    let many = (0..20_000).map(|n| format!(r#""k{n}":1"#)).collect::<Vec<_>>().join(",");
    let long = format!(r#""a":"{}""#, "x".repeat(4097));
    for config in [r#""a":1,"a":2"#, r#""a":null"#, r#""a":[1]"#, r#""A b":1"#, &many, &long] {
        let refusal = check(config).unwrap_err();
        assert!(matches!(refusal, Refusal::Malformed { .. }), "{config:.20}: {refusal:?}");
    }
}

#[test]
fn what_a_vehicle_would_refuse_cannot_be_sealed() {
    let mut files = revision(1);
    files.files.push(files.files[0].clone());
    seal(&files, &[&key(PUBLISHER)]).unwrap_err();
    seal(&revision(0), &[&key(PUBLISHER)]).unwrap_err();
    let mut labels = deployment(1, &signed_revision(1));
    labels.selector = labelled(&[("fleet", "a\nb")]);
    seal::<Deployment>(&labels, &[&key(DEPLOYER)]).unwrap_err();
    let mut keys = root();
    keys.root.threshold = 2;
    seal(&keys, &[&key(ROOT)]).unwrap_err();
}

#[test]
fn damaged_floors_are_an_error_and_not_an_empty_state() {
    let floors = Floors::default();
    let text = floors.to_json();
    assert_eq!(Floors::parse(&text).unwrap(), floors);
    for length in 0..text.len() {
        Floors::parse(&text[..length]).unwrap_err();
    }
    first_root(b"", &floors).unwrap_err();
}

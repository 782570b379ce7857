//! Seeds: a payload of each type, alone and in an envelope, floors, and a signed clip.

use gleaner_trust::{
    ClipLosses, ClipSigner, ClipStatement, ContentDigest, Deployment, Floors, MEDIA_TYPE, Payload,
    Revision, SIGNATURE, SecretKey, TrustRoot, sha256,
};

use crate::trust::{KEY, VEHICLE, mode, root, signed};

/// Keys and types of signed data.
pub const WORDS: &[&str] = &[
    "payloadType",
    "payload",
    "signatures",
    "keyid",
    "sig",
    "name",
    "version",
    "kind",
    "release",
    "created",
    "files",
    "path",
    "bytes",
    "sha256",
    "id",
    "selector",
    "revision",
    "fallback",
    "config",
    "grants",
    "topics",
    "models",
    "record",
    "expires",
    "root",
    "threshold",
    "keys",
    "publishers",
    "deployers",
    "key",
    "lambdas",
    "labels",
    "wasm",
    "python",
    "null",
    ClipStatement::TYPE,
    SIGNATURE,
    Revision::TYPE,
    Deployment::TYPE,
    TrustRoot::TYPE,
];

pub fn all() -> Vec<Vec<u8>> {
    let digest = "0123456789abcdef".repeat(4);
    let revision = format!(
        r#"{{"name":"brake","version":"0.1.0","kind":"wasm","release":1,"created":2,"files":[{{"path":"brake.wasm","bytes":3,"sha256":"{digest}"}},{{"path":"msg/größe.msg","bytes":4,"sha256":"{digest}"}}]}}"#
    );
    let deployment = format!(
        r#"{{"id":"front","release":1,"selector":{{}},"revision":"{digest}","fallback":"{digest}","config":{{"a":-1.5,"b":true,"c":"x","d":7}},"grants":{{"topics":["/imu/data"],"models":["m"],"record":true}},"created":1,"expires":2}}"#
    );
    let mut second = root();
    second.version = 2;
    second.publishers[0].labels.insert("fleet".parse().expect("a name"), "test".to_owned());
    let second = serde_json::to_string(&second).expect("a root is JSON");
    let floors = format!(
        r#"{{"root":1,"root_time":2,"time":3,"deployments":{{"front":{{"release":1,"digest":"{digest}"}}}},"lambdas":{{}}}}"#
    );
    let payloads = [
        (mode::REVISION, Revision::TYPE, revision),
        (mode::DEPLOYMENT, Deployment::TYPE, deployment),
        (mode::ROOT, TrustRoot::TYPE, second),
    ];
    let mut seeds = vec![
        [&[mode::FLOORS], &Floors::default().to_json()[..]].concat(),
        [&[mode::FLOORS], floors.as_bytes()].concat(),
        [&[mode::CLIP], &clip()[..]].concat(),
    ];
    for (mode, payload_type, payload) in payloads {
        let envelope = signed(payload_type, payload.as_bytes());
        seeds.push([&[mode], payload.as_bytes()].concat());
        seeds.push([&[mode::ENVELOPE], &envelope[..]].concat());
    }
    seeds
}

/// Returns a signed clip without messages.
fn clip() -> Vec<u8> {
    let vehicle = VEHICLE.parse().expect("a name");
    let signer = ClipSigner::new(SecretKey::from_bytes(&KEY), vehicle);
    let statement = ClipStatement {
        vehicle: signer.vehicle().clone(),
        clip: "brake".to_owned(),
        created: 1,
        recorder: "gleaner".to_owned(),
        sha256: sha256(b""),
        clock: "log time".to_owned(),
        from_ns: 1,
        to_ns: 2,
        messages: 0,
        triggers: 0,
        lambdas: Vec::new(),
        journals: Vec::new(),
        losses: ClipLosses::default(),
        recovered: false,
    };
    let length = signer.length(&statement).expect("a valid statement");
    let text = |text: &str| [&(text.len() as u32).to_le_bytes(), text.as_bytes()].concat();
    let mut attachment = [&[0; 16][..], &text(SIGNATURE), &text(MEDIA_TYPE)].concat();
    attachment.extend((length as u64).to_le_bytes());
    attachment.resize(attachment.len() + length + 4, 0);
    let record =
        |kind: u8, body: &[u8]| [&[kind][..], &(body.len() as u64).to_le_bytes(), body].concat();
    let magic = b"\x89MCAP0\r\n";
    let header = record(1, &[text("ros2"), text("")].concat());
    let start = [&magic[..], &header].concat();
    let mut rest = [record(9, &attachment), record(15, &[0; 4]), record(2, &[0; 20])].concat();
    rest.extend(magic);
    let mut before = ContentDigest::default();
    before.update(&start);
    signer.complete(&before, &mut rest, statement).expect("the file has the right form");
    [start, rest].concat()
}

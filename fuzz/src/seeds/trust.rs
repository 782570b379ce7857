//! Seeds: a payload of each type, alone and in an envelope, and floors.

use gleaner_trust::{Deployment, Floors, Payload, Revision, TrustRoot};

use crate::trust::{mode, root, signed};

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
    Revision::TYPE,
    Deployment::TYPE,
    TrustRoot::TYPE,
];

/// All seeds.
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
    ];
    for (mode, payload_type, payload) in payloads {
        let envelope = signed(payload_type, payload.as_bytes());
        seeds.push([&[mode], payload.as_bytes()].concat());
        seeds.push([&[mode::ENVELOPE], &envelope[..]].concat());
    }
    seeds
}

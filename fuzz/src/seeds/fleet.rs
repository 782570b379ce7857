//! Seeds: a frame of each kind, an enrolment, a report of clips, and orders for them.

use gleaner_fleet::{
    Ack, Body, Cursor, Desired, Enrolment, Frame, GoAway, Hello, PROTOCOL, Ping, Pong, Records,
    Reported, Tail, Wanted, WantedProblem, Welcome, compress,
};

use crate::fleet::mode;

/// Keys of an enrolment.
pub const WORDS: &[&str] = &[
    "clips",
    "gone",
    "moments",
    "wanted",
    "thumbnails",
    "cursor",
    "gleaner_enrolment",
    "address",
    "vehicle",
    "authority",
    "token",
    "events",
    "lambdas/",
];

const REPORT: &str = r#"{"cursor":"1","clips":[{"name":"brake-1","from_ns":1,"to_ns":2,"bytes":9,
    "sha256":"0000000000000000000000000000000000000000000000000000000000000000","thumbnail":null,
    "lambdas":[{"name":"brake","version":"1","digest":"5","deployment":"brake","revision":null}],
    "triggers":1,"moments":[{"lambda":"brake","kind":"event","label":"hard","score":0.5,
    "attributes":{"mps2":-4.5},"at_ns":1}],"incomplete":["late"],"is_recovered":true}],
    "gone":[{"name":"brake-0","is_thumbnail":true,"reason":"evicted"}]}"#;
const ORDERS: &str = r#"{"cursor":"1","thumbnails":["brake-1"],
    "wanted":[{"name":"brake-1","bytes":9,"sha256":"5","part":0}]}"#;

pub fn all() -> Vec<Vec<u8>> {
    let cursor = Cursor {
        stream: "lambdas/brake".to_owned(),
        life: 1,
        next: 300,
        seq: 299,
        boot: "00112233445566778899aabbccddeeff".to_owned(),
        boot_ns: 12_345_678_901,
    };
    let wanted = |id: &str, rollback| Wanted {
        id: id.to_owned(),
        envelope: "5".repeat(64),
        is_wanted: rollback == 0,
        rollback,
        start: rollback + 1,
    };
    let records = Records {
        stream: "events".to_owned(),
        life: 2,
        next: 9,
        lines: compress(b"{\"stream\":\"events\",\"seq\":8}\n"),
    };
    let frames = [
        Body::Hello(Hello {
            protocol: PROTOCOL,
            version: "0.1.0".to_owned(),
            key: "key".to_owned(),
            followed: 7,
            boot: "0".repeat(32),
        }),
        Body::Welcome(Welcome { epoch: 5, time_ms: -1, ping_s: 20, cursors: vec![cursor] }),
        Body::Desired(Desired {
            generation: 7,
            deployments: vec![wanted("a", 0), wanted("b", 1)],
            keeps: true,
        }),
        Body::Reported(Reported {
            generation: 7,
            status: compress(b"{}"),
            problems: vec![WantedProblem {
                deployment: "a".to_owned(),
                envelope: "0".repeat(64),
                title: "refused".to_owned(),
                is_pending: true,
                causes: vec!["a cause".to_owned()],
                help: "a help".to_owned(),
            }],
        }),
        Body::Records(records),
        Body::Ack(Ack { stream: "events".to_owned(), life: 2, next: 9 }),
        Body::Ping(Ping { number: 1 }),
        Body::Pong(Pong { number: 1 }),
        Body::GoAway(GoAway { after_ms: 1000, reason: "revoked".to_owned() }),
        Body::Tail(Tail { streams: vec!["events".to_owned()], seconds: 60 }),
    ];
    let enrolment = Enrolment {
        gleaner_enrolment: 1,
        address: "127.0.0.1:8443".to_owned(),
        vehicle: "car-7".to_owned(),
        authority: "a certificate".to_owned(),
        token: "secret".to_owned(),
    };
    let enrolment = serde_json::to_vec(&enrolment).expect("it is plain data");
    let seed = |mode: u8, bytes: Vec<u8>| [vec![mode], bytes].concat();
    let frames = frames.into_iter().map(|body| seed(mode::FRAME, Frame::encoded(body)));
    frames
        .chain([
            seed(mode::ENROLMENT, enrolment),
            seed(mode::CLIPS, REPORT.into()),
            seed(mode::ORDERS, ORDERS.into()),
        ])
        .collect()
}

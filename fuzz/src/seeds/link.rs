//! Seeds: conversations with the recorder, frame by frame.

use gleaner_journal::Encoder;
use gleaner_lambda::manifest::Limits;
use gleaner_protocol::link::AddLambda;

pub use super::journal::WORDS;
use super::journal::{entries, header};
use crate::link::mode;

/// All seeds. The tag numbers are private to `gleaner_protocol::link`, so they are repeated here.
pub fn all() -> Vec<Vec<u8>> {
    let hello = serde_json::to_vec(&header()).expect("a header is JSON");
    let wakes = entries().into_iter().map(|entry| {
        let mut payload = [&1_000_i64.to_le_bytes()[..], &2_u32.to_le_bytes()].concat();
        Encoder::new(2).encode(&entry, &mut payload);
        (17, payload)
    });
    let lambda = [(16, hello)].into_iter().chain(wakes).chain([(18, Vec::new())]).collect();
    let remaps = vec![("/imu".to_owned(), "/car/imu".to_owned())];
    let grants = vec![("/car/imu".to_owned(), 1)];
    let add = AddLambda { lambda: "/lambdas/brake".into(), remaps, most: Limits::MAX, grants };
    let add = serde_json::to_vec(&add).expect("it is JSON");
    let starter = vec![(1, add), (2, Vec::new())];
    let recorder =
        vec![(32, Vec::new()), (34, 5_u64.to_le_bytes().to_vec()), (33, b"not today".to_vec())];
    let all = [(mode::LAMBDA, lambda), (mode::STARTER, starter), (mode::RECORDER, recorder)];
    all.into_iter()
        .flat_map(|(peers, frames)| [as_frames(peers, &frames), as_bytes(peers, &frames)])
        .collect()
}

pub(super) fn as_frames(peers: u8, frames: &[(u8, Vec<u8>)]) -> Vec<u8> {
    let mut seed = vec![peers | mode::FRAMES];
    for (tag, payload) in frames {
        seed.push(*tag);
        seed.extend((payload.len() as u16).to_le_bytes());
        seed.extend(payload);
    }
    seed
}

pub(super) fn as_bytes(peers: u8, frames: &[(u8, Vec<u8>)]) -> Vec<u8> {
    let mut seed = vec![peers];
    for (tag, payload) in frames {
        seed.extend((payload.len() as u32).to_le_bytes());
        seed.push(*tag);
        seed.extend(payload);
    }
    seed
}

//! SHA-256 digests, which name revisions, files and keys.

use gleaner_base::hex;
use gleaner_lambda::manifest::Sha256;
use sha2::Digest;

pub(crate) fn digest_text(digest: &[u8]) -> Sha256 {
    hex(digest).parse().expect("hexadecimal digits of 32 bytes")
}

pub fn sha256(bytes: &[u8]) -> Sha256 {
    digest_text(&sha2::Sha256::digest(bytes))
}

//! Digests in hexadecimal digits.

use gleaner_base::hex;
use gleaner_journal::FileDigest;
use sha2::{Digest, Sha256};

/// One digest for all files of a lambda: SHA-256 of their digests and paths, a line each, as
/// `sha256sum` writes them; in hexadecimal digits.
pub fn lambda_digest(files: &[FileDigest]) -> String {
    let mut digest = Sha256::new();
    for file in files {
        digest.update(format!("{}  {}\n", file.sha256, file.path));
    }
    hex(&digest.finalize())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Computed with `printf 'aa lambda.toml\nbb main.py\n' | sha256sum`.
    #[test]
    fn a_digest_is_that_of_the_lines_of_sha256sum() {
        let file = |path: &str, sha256: &str| FileDigest {
            path: path.to_owned(),
            bytes: 1,
            sha256: sha256.to_owned(),
        };
        let digest = lambda_digest(&[file("lambda.toml", "aa"), file("main.py", "bb")]);
        assert_eq!(digest, "d2cabc19c6515d37adc80b227c62593c2abcee6d7f6c963bc062285740482c5d");
    }
}

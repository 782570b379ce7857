//! The version that programs print.

use std::sync::OnceLock;

static VERSION: OnceLock<String> = OnceLock::new();

/// Sets the commit of the running program, such as `ff1d6916`. `main` calls it first, with
/// `option_env!("GLEANER_COMMIT")`, which is set for builds of packages.
///
/// Only files `main.rs` read that variable, so that a new commit compiles nothing but these: a
/// library that read it would compile again, with all that depends on it.
pub fn set_commit(commit: Option<&'static str>) {
    // It was set before if this fails.
    let _ = VERSION.set(with_commit(commit));
}

/// Returns the version with the commit, if there is one: `0.1.0+ff1d6916`, or `0.1.0`.
pub fn version() -> &'static str {
    VERSION.get_or_init(|| with_commit(None))
}

fn with_commit(commit: Option<&str>) -> String {
    let commit = commit.map(|commit| format!("+{commit}"));
    env!("CARGO_PKG_VERSION").to_owned() + &commit.unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_commit_follows_the_release() {
        set_commit(Some("ff1d6916"));
        assert_eq!(version(), concat!(env!("CARGO_PKG_VERSION"), "+ff1d6916"));
        assert_eq!(with_commit(None), env!("CARGO_PKG_VERSION"));
    }
}

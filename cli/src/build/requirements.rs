//! Reads the requirements.txt of a lambda.
//!
//! pip has a language of its own there, in which the author of a lambda could run code (an address
//! of a source archive), read variables and files, and choose indexes. So pip never reads this
//! file, but what is written here: `NAME==VERSION`, a marker of few characters, and hashes.

/// A line that pip will not get.
#[derive(Debug)]
pub(super) struct RefusedLine {
    pub(super) number: usize,
    pub(super) text: String,
    pub(super) reason: &'static str,
}

/// Endings for which pip takes `NAME==VERSION` for a file, if its folder has that.
const ARCHIVES: &str = "zip whl tar gz tgz bz2 tbz xz txz lz tlz lzma";

const CONTROL: &str = "has a control character";
const OPTION: &str = "is an option of pip";
const PIN: &str = "is not NAME==VERSION, or has an unusual marker";
const NO_HASH: &str = "has no hash";
const HASH: &str = "is not --hash=sha256:HEX";

pub(super) fn parse(text: &[u8]) -> Result<String, RefusedLine> {
    let text = String::from_utf8_lossy(text);
    let lines = text.strip_prefix('\u{feff}').unwrap_or(&text).split('\n');
    let (mut locked, mut words) = (String::new(), Vec::new());
    // The last line may end with a backslash.
    for (number, line) in (1..).zip(lines.chain([""])) {
        let line = line.strip_suffix('\r').unwrap_or(line);
        if line.chars().any(|it| it.is_control() && it != '\t') {
            return Err(RefusedLine { number, text: line.to_owned(), reason: CONTROL });
        }
        let line = without_comment(line).trim_ascii_end();
        let continued = line.strip_suffix('\\');
        let new = continued.unwrap_or(line).split_ascii_whitespace();
        words.extend(new.map(|word| (number, word)));
        if continued.is_none() && !words.is_empty() {
            locked += &requirement(&words)?;
            words.clear();
        }
    }
    Ok(locked)
}

fn without_comment(line: &str) -> &str {
    let begins = |before: &str| before.is_empty() || before.ends_with([' ', '\t']);
    let found = line.match_indices('#').find(|(at, _)| begins(&line[..*at]));
    found.map_or(line, |(at, _)| &line[..at])
}

/// Returns the line for pip of a requirement, of which `words` has each word with its line.
fn requirement(words: &[(usize, &str)]) -> Result<String, RefusedLine> {
    let join = |words: &[(usize, &str)]| words.iter().map(|it| it.1).collect::<Vec<_>>().join(" ");
    let refused = |words: &[(usize, &str)], reason| {
        Err(RefusedLine { number: words[0].0, text: join(words), reason })
    };
    let options = words.iter().position(|it| it.1.starts_with('-')).unwrap_or(words.len());
    let (pin, hashes) = words.split_at(options);
    if pin.is_empty() {
        return refused(words, OPTION);
    }
    let Some(mut locked) = pinned(&join(pin)) else { return refused(pin, PIN) };
    if hashes.is_empty() {
        return refused(pin, NO_HASH);
    }
    for hash in hashes.chunks(1) {
        let is_hex = |it: &str| it.len() == 64 && it.bytes().all(|it| it.is_ascii_hexdigit());
        if !hash[0].1.strip_prefix("--hash=sha256:").is_some_and(is_hex) {
            return refused(hash, HASH);
        }
        locked += " ";
        locked += &hash[0].1.to_ascii_lowercase();
    }
    Ok(locked + "\n")
}

/// Returns `NAME==VERSION` with the marker, without the extras: these only choose dependencies, all
/// of which are locked. pip checks the grammar of a marker.
fn pinned(text: &str) -> Option<String> {
    let is_plain = |text: &str, inner: &str| {
        text.starts_with(|it: char| it.is_ascii_alphanumeric())
            && text.ends_with(|it: char| it.is_ascii_alphanumeric())
            && text.chars().all(|it| it.is_ascii_alphanumeric() || inner.contains(it))
    };
    let (pin, marker) = text.split_once(';').map_or((text, ""), |(pin, marker)| (pin, marker));
    let (name, version) = pin.split_once("==")?;
    let (name, extras) = match name.trim_ascii().strip_suffix(']') {
        Some(name) => name.split_once('[')?,
        None => (name, "none"),
    };
    let (name, version) = (name.trim_ascii(), version.trim_ascii());
    let is_marker = |it: char| it.is_ascii_alphanumeric() || "_.+*-<>=!~()'\" ".contains(it);
    let is_pinned = is_plain(name, "._-")
        && is_plain(version, "._-+!")
        && extras.split(',').all(|extra| is_plain(extra.trim_ascii(), "._-"))
        && !ARCHIVES.split(' ').any(|it| version.to_ascii_lowercase().ends_with(it))
        && marker.chars().all(is_marker);
    let marker = if marker.is_empty() { String::new() } else { format!(" ;{marker}") };
    is_pinned.then(|| format!("{name}=={version}{marker}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_pip_compile_uv_and_poetry_are_read() {
        let parsed = |text: &str| {
            let (a, b) = ("a".repeat(64), "b".repeat(64));
            let text = text.replace("HASH", "--hash=sha256").replace("AA", &a).replace("BB", &b);
            let parsed = parse(text.as_bytes()).unwrap_or_else(|it| panic!("{it:?}"));
            parsed.replace("--hash=sha256", "HASH").replace(&a, "AA").replace(&b, "BB")
        };
        let pip_compile = "#\n# This file is autogenerated by pip-compile with Python 3.11\n\
            #    pip-compile --generate-hashes requirements.in\n#\n\
            numpy==2.0.2 \\\n    HASH:AA \\\n    HASH:BB\n    # via -r requirements.in\n\
            ruamel.yaml[jinja2]==0.18.6 \\\n    HASH:BB\n    # via\n    #   x\n\n\
            # WARNING: Consider using the --allow-unsafe flag.\n# setuptools\n";
        let expected = "numpy==2.0.2 HASH:AA HASH:BB\nruamel.yaml==0.18.6 HASH:BB\n";
        assert_eq!(parsed(pip_compile), expected);
        assert_eq!(parsed(&format!("\u{feff}{}", pip_compile.replace('\n', "\r\n"))), expected);
        let uv = "numpy==2.0.2 ; python_full_version < '3.11.*' \\\n    HASH:AA\n\
            torch==2.5+cu121 ; (os_name=='nt' and sys_platform != 'a') \\\n    HASH:BB\n    # via";
        assert_eq!(parsed(uv), uv.replace(" \\\n   ", "").replace("\n    # via", "\n"));
        let poetry =
            "x==2.0 ; python_version >= \"3.9\" and python_version < \"4.0\" \\\n    HASH:AA \\\n";
        assert_eq!(parsed(poetry), poetry.replace(" \\\n   ", "").replace(" \\", ""));
        assert_eq!(parsed(" # x\nx [ a , b ] == 1!2.0-1\tHASH:AA"), "x==1!2.0-1 HASH:AA\n");
    }

    #[test]
    fn anything_else_is_refused_with_its_line() {
        let hash = format!("--hash=sha256:{}", "a".repeat(64));
        for (reason, texts) in [
            (PIN, "./x-1.tar.gz HASH | /tmp/x==1 HASH | http://host/x-1.tar.gz HASH | x HASH"),
            (PIN, "x==1.zip HASH | x==1+a.tar.BZ2 HASH | x==1.whl HASH"),
            (PIN, "http://host/x==1 HASH | x @ http://host/x.tar.gz HASH | x@file:///x==1 HASH"),
            (PIN, "git+ssh://host/x#egg=x==1 HASH | x==${TOKEN} HASH | x==%2e HASH | x>=1 HASH"),
            (PIN, "x== HASH | ==1 HASH | x==1.* HASH | x===1 HASH | x==1,<2 HASH | x==1 y HASH"),
            (PIN, "x[a==1 HASH | x[../a]==1 HASH | ｘ==1 HASH | x==1. \\\n2 HASH | x==-1 HASH"),
            (PIN, "x==1 ; ${HOME} HASH | x==1 ; a/b HASH | x==1 ; a @ b HASH | x==1 ; a ; b HASH"),
            (NO_HASH, "x==1 | x==1 # HASH"),
            (HASH, "x==1 HASH y==1 | x==1 HASH --config-settings=a=b | x==1 --hash=md5:d41d8cd9"),
            (HASH, "x==1 --hash=sha512:HASH | x==1 --hash=sha256:aa | x==1 --hash HASH"),
            (
                OPTION,
                "-r a.txt | -c a.txt | -e . | --index-url http://host/ | --trusted-host \\\na",
            ),
            (OPTION, "--no-binary=:all: | HASH"),
            (CONTROL, "x==1\0 HASH | # x\rx==1 HASH | x==1\u{1b}[2J HASH | x==1\u{85} HASH"),
        ] {
            for line in texts.split(" | ") {
                let text = format!("# first\nnumpy==1 \\\n HASH\n{line}\n").replace("HASH", &hash);
                let refused = parse(text.as_bytes()).expect_err(line);
                assert_eq!((refused.number, refused.reason), (4, reason), "{line}");
            }
        }
        let refused =
            parse(format!("x==1 \\\n{hash} \\\n\\\n--hash=md5:a").as_bytes()).unwrap_err();
        assert_eq!((refused.number, &*refused.text), (4, "--hash=md5:a"));
    }
}

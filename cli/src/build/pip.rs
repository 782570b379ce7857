//! Starts pip, which fetches wheels. All that it gets is of the user who builds, but for the
//! requirements that were read before: nothing in the lambda's folder is visible to it.

use std::env;
use std::ffi::OsString;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use gleaner_base::Exit;
use gleaner_lambda::REQUIREMENTS;

use super::error::{BuildError, failed};
use super::sandbox;

/// Variables with folders and languages of the user. pip gets these and [`SETTINGS`], listed in
/// docs/environment.md; others, such as credentials, are not for it.
const OF_USER: &str = "PATH HOME LANG LC_ALL XDG_CONFIG_HOME XDG_CACHE_HOME";
/// Variables with settings of the network, and files for them.
const SETTINGS: &str = "HTTP_PROXY HTTPS_PROXY ALL_PROXY NO_PROXY http_proxy https_proxy \
    all_proxy no_proxy PIP_PROXY SSL_CERT_FILE SSL_CERT_DIR REQUESTS_CA_BUNDLE CURL_CA_BUNDLE \
    PIP_CERT PIP_CLIENT_CERT PIP_INDEX_URL PIP_EXTRA_INDEX_URL PIP_NO_INDEX PIP_FIND_LINKS \
    PIP_TRUSTED_HOST PIP_CONFIG_FILE PIP_CACHE_DIR LD_LIBRARY_PATH";

/// Files of the system that pip reads: names of hosts, certificates, its configuration; the name of
/// the system and types of files, without which it fails; and the start of Debian's Python.
const SYSTEM: &str = "/etc/resolv.conf /etc/hosts /etc/host.conf /etc/nsswitch.conf \
    /etc/ssl/certs /etc/ssl/openssl.cnf /etc/pki/ca-trust/extracted /etc/pki/tls/openssl.cnf \
    /etc/pip.conf /etc/xdg/pip /etc/os-release /etc/lsb-release /etc/debian_version \
    /etc/mime.types /etc/apache2/mime.types /etc/httpd/conf/mime.types /usr/local/etc/mime.types \
    /etc/python3.9 /etc/python3.10 /etc/python3.11 /etc/python3.12 /etc/python3.13";
/// Its configuration in the home of a user.
const OF_HOME: &str = ".config/pip .config/pip/pip.conf .pip .pip/pip.conf .netrc";

/// Lets the pip of `python` fetch the wheels of `requirements` into the empty `folder`.
pub(super) fn download(
    python: &Path,
    requirements: &str,
    options: &[&str],
    folder: &Path,
    sandboxed: bool,
) -> Result<(), BuildError> {
    let private = tempfile::Builder::new().prefix("gleaner-pip-").tempdir();
    let private = private.map_err(failed("create a folder in", &env::temp_dir()))?;
    let list = private.path().join(REQUIREMENTS);
    fs::write(&list, requirements).map_err(failed("write", &list))?;
    let folder = folder.canonicalize().map_err(failed("find", folder))?;
    let mut pip = match sandboxed {
        true => sandbox::fetcher(python, &readable(python), [private.path(), &folder])?,
        false => Command::new(python),
    };
    pip.args(["-I", "-m", "pip", "download", "--quiet", "--no-input"])
        .args(["--disable-pip-version-check", "--require-hashes", "--no-deps"])
        .args(["--only-binary", ":all:", "--requirement"])
        .arg(&list)
        .arg("--dest")
        .arg(&folder)
        .args(options);
    // Other builds trust the user's cache.
    pip.args(sandboxed.then_some("--no-cache-dir"));
    pip.env_clear().envs(variables(OF_USER)).envs(variables(SETTINGS));
    // pip takes a file in its folder for a package of that name. Standard output has the summary of
    // the build.
    pip.env("TMPDIR", private.path()).current_dir(private.path());
    let ended = pip.stdin(Stdio::null()).stdout(io::stderr()).status();
    let status = ended.map_err(failed("start", Path::new(pip.get_program())))?;
    match status.code() {
        Some(0) => Ok(()),
        Some(code) if sandboxed && code == i32::from(Exit::Denied.code()) => {
            Err(BuildError::NoSandbox)
        }
        _ => Err(BuildError::Fetched { status }),
    }
}

fn variables(names: &'static str) -> impl Iterator<Item = (&'static str, OsString)> {
    names.split(' ').filter_map(|name| Some((name, env::var_os(name)?)))
}

/// Returns what pip may read in its sandbox, beside the interpreter: its configuration, and the
/// absolute paths in its variables.
fn readable(python: &Path) -> Vec<PathBuf> {
    let mut readable: Vec<PathBuf> = SYSTEM.split(' ').map(PathBuf::from).collect();
    readable.extend(python.ancestors().nth(2).map(|prefix| prefix.join("pip.conf")));
    let home = env::var_os("HOME").map(PathBuf::from);
    readable.extend(home.iter().flat_map(|home| OF_HOME.split(' ').map(|it| home.join(it))));
    let config = env::var_os("XDG_CONFIG_HOME").map(PathBuf::from);
    readable.extend(config.map(|it| it.join("pip")).filter(|it| it.is_absolute()));
    for (_, value) in variables(SETTINGS) {
        let value = value.to_string_lossy();
        // Lists have blanks or colons. After the colon of an address are two slashes.
        let words = value.split(' ').map(|it| it.strip_prefix("file://").unwrap_or(it));
        let paths = words.flat_map(|it| it.split(':')).filter(|it| it.starts_with('/'));
        readable.extend(paths.filter(|it| !it.starts_with("//")).map(PathBuf::from));
    }
    readable
}

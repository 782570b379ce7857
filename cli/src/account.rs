//! The address of a cloud and the token for it: in a file of the user, or in the environment.

use std::env;
use std::fmt;
use std::fs::{self, DirBuilder};
use std::io::{self, ErrorKind, Write};
use std::net::IpAddr;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use gleaner_base::{ByteSize, Exit, Failure, PlainFile, excerpt, sync_folder};
use hyper::Uri;
use serde::{Deserialize, Serialize};

/// Variables that outweigh the file.
const URL_VARIABLE: &str = "GLEANER_CLOUD";
const TOKEN_VARIABLE: &str = "GLEANER_CLOUD_TOKEN";

/// Longest file; one has some hundred bytes.
const FILE_MAX: ByteSize = ByteSize::kib(64);

pub(crate) const LOGIN_HELP: &str = "log in: `gleaner login URL --code CODE`; an admin of the \
    cloud makes a code with `gleaner users invite NAME --role ROLE`";

#[derive(Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct CloudAccount {
    pub(crate) url: CloudUrl,
    pub(crate) token: String,
}

/// The address of a cloud for people: `http://HOST:PORT`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub(crate) struct CloudUrl {
    host: String,
    port: u16,
}

impl CloudUrl {
    pub(crate) fn address(&self) -> (&str, u16) {
        (self.host.trim_matches(['[', ']']), self.port)
    }

    /// Returns `HOST:PORT`.
    pub(crate) fn authority(&self) -> String {
        format!("{}:{}", self.host, self.port)
    }

    /// Returns a warning if the token leaves this machine, since HTTP does not encrypt it.
    pub(crate) fn warning(&self) -> Option<String> {
        let (host, port) = self.address();
        let is_local = host.parse::<IpAddr>().map_or(host == "localhost", |it| it.is_loopback());
        (!is_local).then(|| {
            format!(
                "warning: the token goes to `{host}` unencrypted. Use a proxy with TLS instead, \
                 such as `ssh -L {port}:127.0.0.1:{port} {host}` and http://127.0.0.1:{port}"
            )
        })
    }
}

impl FromStr for CloudUrl {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let refused =
            || format!("`{}` is not http://HOST:PORT, as in http://127.0.0.1:8080", excerpt(text));
        let uri: Uri = text.parse().map_err(|_| refused())?;
        if uri.scheme_str() == Some("https") {
            return Err(
                "https is not supported: use a proxy on this machine, and its address, as \
                        in http://127.0.0.1:8080"
                    .to_owned(),
            );
        }
        let has_more = !["", "/"].contains(&uri.path()) || uri.query().is_some();
        match (uri.scheme_str(), uri.host(), uri.port_u16()) {
            (Some("http"), Some(host), Some(port))
                if !has_more && !host.is_empty() && !text.contains('@') =>
            {
                Ok(Self { host: host.to_owned(), port })
            }
            _ => Err(refused()),
        }
    }
}

impl fmt::Display for CloudUrl {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "http://{}", self.authority())
    }
}

impl TryFrom<String> for CloudUrl {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<CloudUrl> for String {
    fn from(url: CloudUrl) -> Self {
        url.to_string()
    }
}

impl CloudAccount {
    /// Loads the account: that of the environment, else that of the file.
    pub(crate) fn load() -> Result<Self, Failure> {
        let token = variable(TOKEN_VARIABLE);
        let url = variable(URL_VARIABLE).map(|text| text.parse::<CloudUrl>());
        let url = url.transpose().map_err(|reason| {
            let failure = Failure::new(Exit::Usage, format!("cannot use {URL_VARIABLE}"));
            Failure { causes: vec![reason], ..failure }
                .with_help("set it to the address of the cloud, or unset it")
        })?;
        if let (Some(url), Some(token)) = (&url, &token) {
            return Ok(Self { url: url.clone(), token: token.clone() });
        }
        let stored = Self::stored()?.ok_or_else(|| {
            Failure::new(Exit::Denied, "not logged in to a cloud").with_help(LOGIN_HELP)
        })?;
        match url {
            // The token must not reach another cloud.
            Some(url) if url != stored.url => {
                let Self { url: other, .. } = stored;
                let message = format!("there is no token for {url}, but one for {other}");
                Err(Failure::new(Exit::Denied, message)
                    .with_help(format!("set {TOKEN_VARIABLE}, too, or unset {URL_VARIABLE}")))
            }
            _ => Ok(Self { token: token.unwrap_or(stored.token), ..stored }),
        }
    }

    pub(crate) fn stored() -> Result<Option<Self>, Failure> {
        let path = file()?;
        let failed = |error: &dyn std::error::Error| {
            Failure::caused_by(Exit::Usage, format!("cannot use `{}`", path.display()), error)
                .with_help("`gleaner logout` removes it; log in again then")
        };
        let file = match PlainFile::named(&path, FILE_MAX) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            file => file.map_err(|error| failed(&error))?,
        };
        if file.mode() & 0o077 != 0 {
            let path = path.display();
            let message = format!("other users can read the token in `{path}`");
            return Err(Failure::new(Exit::Denied, message)
                .with_help(format!("`chmod 600 {path}`, or log in again for another token")));
        }
        let text = file.read_whole().map_err(|error| failed(&error))?;
        serde_json::from_slice(&text).map(Some).map_err(|error| failed(&error))
    }

    /// Stores the account, in a file that only its user can read.
    pub(crate) fn save(&self) -> Result<PathBuf, Failure> {
        let path = file()?;
        let text = serde_json::to_vec_pretty(self).expect("an account is text");
        let folder = path.parent().unwrap_or(Path::new("."));
        let created = DirBuilder::new().recursive(true).mode(0o700).create(folder);
        created.and_then(|()| write_private(&path, &text, true)).map_err(|error| {
            Failure::caused_by(Exit::Usage, format!("cannot write `{}`", path.display()), &error)
                .with_help("XDG_CONFIG_HOME chooses another folder")
        })?;
        Ok(path)
    }

    /// Removes the file; returns whether there was one.
    pub(crate) fn remove() -> Result<bool, Failure> {
        let path = file()?;
        match fs::remove_file(&path) {
            Ok(()) => Ok(true),
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(false),
            Err(error) => {
                let action = format!("cannot remove `{}`", path.display());
                Err(Failure::caused_by(Exit::Usage, action, &error)
                    .with_help("remove it yourself: it has the token"))
            }
        }
    }
}

/// Writes a secret to the file `path` atomically. Only its user can read it.
pub(crate) fn write_private(path: &Path, text: &[u8], may_replace: bool) -> io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new("."));
    // It is created with mode 0600.
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    file.write_all(text)?;
    file.as_file().sync_all()?;
    match may_replace {
        true => file.persist(path)?,
        false => file.persist_noclobber(path)?,
    };
    sync_folder(folder)
}

fn file() -> Result<PathBuf, Failure> {
    let folder = |name: &str| env::var_os(name).map(PathBuf::from).filter(|it| it.is_absolute());
    let config = folder("XDG_CONFIG_HOME").or_else(|| Some(folder("HOME")?.join(".config")));
    let config = config.ok_or_else(|| {
        Failure::new(Exit::Usage, "there is no folder for the token of a cloud")
            .with_help("set HOME or XDG_CONFIG_HOME to an absolute path")
    })?;
    Ok(config.join("gleaner/cloud.json"))
}

fn variable(name: &str) -> Option<String> {
    env::var(name).ok().filter(|text| !text.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_address_of_a_cloud_is_parsed_and_others_are_refused_with_an_example() {
        for (text, address) in [
            ("http://127.0.0.1:8080", ("127.0.0.1", 8080)),
            ("http://cloud.example:80/", ("cloud.example", 80)),
            ("http://[::1]:8080", ("::1", 8080)),
        ] {
            let url: CloudUrl = text.parse().unwrap();
            assert_eq!(url.address(), address);
            assert_eq!(url.to_string(), text.trim_end_matches('/'));
        }
        for text in [
            "127.0.0.1:8080",
            "http://127.0.0.1",
            "http://127.0.0.1:8080/v1",
            "http://127.0.0.1:8080?a",
            "http://ada:secret@127.0.0.1:8080",
            "http://:8080",
            "ftp://127.0.0.1:8080",
            "https://127.0.0.1:8080",
            "",
        ] {
            let refused = text.parse::<CloudUrl>().unwrap_err();
            assert!(refused.contains("as in http://127.0.0.1:8080"), "{refused}");
        }
    }

    #[test]
    fn a_token_that_leaves_the_machine_is_worth_a_warning() {
        let warning = |text: &str| text.parse::<CloudUrl>().unwrap().warning();
        for local in ["http://localhost:80", "http://127.0.0.9:80", "http://[::1]:80"] {
            assert_eq!(warning(local), None);
        }
        for remote in ["http://cloud.example:80", "http://10.0.0.1:80", "http://[fe80::1]:80"] {
            assert!(warning(remote).unwrap().contains("proxy with TLS"), "{remote}");
        }
    }

    #[test]
    fn a_secret_is_readable_by_its_user_alone_and_replaced_only_on_request() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("secret");
        write_private(&path, b"first", false).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);
        let refused = write_private(&path, b"second", false).unwrap_err();
        assert_eq!(refused.kind(), ErrorKind::AlreadyExists);
        assert_eq!(fs::read(&path).unwrap(), b"first");
        write_private(&path, b"second", true).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
    }
}

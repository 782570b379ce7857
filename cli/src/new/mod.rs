//! `gleaner new`: a folder with a lambda in it that builds, passes its test, and finds something in
//! the sample drive.
//!
//! It begins as the example `hello`. With it comes the SDK, in `.gleaner`, so that the folder
//! builds wherever it is taken. Nothing that is there already is changed.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use gleaner_base::{Exit, Explain, Failure};
use gleaner_lambda::Manifest;
use gleaner_lambda::manifest::{Kind, LambdaName, NameError};

use crate::args::NewArgs;
use crate::say::say;

/// Files of the repository, by their path in it.
const PACKED: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/packed.rs"));

/// Where the SDK is.
const SDK: &str = ".gleaner";
/// What takes the place of a `Cargo.toml` of the repository in it.
const PACKAGES: [(&str, &str); 2] = [
    ("guest-sdk-rust/Cargo.toml", include_str!("files/sdk.toml")),
    ("rules/Cargo.toml", include_str!("files/rules.toml")),
];
/// Names that mean something to cargo or to Rust: keywords, and crates that are there already.
const NO_CRATES: &[&str] = &[
    "abstract",
    "alloc",
    "as",
    "async",
    "await",
    "become",
    "box",
    "break",
    "const",
    "continue",
    "core",
    "crate",
    "do",
    "dyn",
    "else",
    "enum",
    "extern",
    "false",
    "final",
    "fn",
    "for",
    "gen",
    "gleaner-rules",
    "gleaner-sdk",
    "if",
    "impl",
    "in",
    "let",
    "loop",
    "macro",
    "match",
    "mod",
    "move",
    "mut",
    "override",
    "priv",
    "proc-macro",
    "pub",
    "ref",
    "return",
    "self",
    "static",
    "std",
    "struct",
    "super",
    "test",
    "trait",
    "true",
    "try",
    "type",
    "typeof",
    "unsafe",
    "unsized",
    "use",
    "virtual",
    "where",
    "while",
    "yield",
];
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Why there is no new lambda.
#[derive(Debug, thiserror::Error)]
enum NewError {
    #[error("`{}` ends with no name", path.display())]
    NoName { path: PathBuf },
    #[error(transparent)]
    Name(#[from] NameError),
    #[error("there is something in `{}` already", path.display())]
    NotEmpty { path: PathBuf },
    #[error("there is no `{}`", path.display())]
    NoSdk { path: PathBuf },
    #[error("a crate cannot have the name `{name}`")]
    CrateName { name: LambdaName },
    #[error("cannot {action} `{}`", path.display())]
    File { action: &'static str, path: PathBuf, source: io::Error },
}

impl Explain for NewError {
    fn help(&self) -> Option<String> {
        match self {
            Self::NoName { .. } => Some(
                "give the folder to make, whose name is the lambda's: gleaner new brake-dark"
                    .to_owned(),
            ),
            Self::Name(error) => error.help(),
            Self::NotEmpty { .. } => Some(
                "choose another name; to replace only the SDK in it: gleaner new --update DIR"
                    .to_owned(),
            ),
            Self::NoSdk { .. } => {
                Some("give the folder of a lambda that `gleaner new` made".to_owned())
            }
            Self::CrateName { .. } => {
                Some("it means something to Rust; choose another one".to_owned())
            }
            Self::File { .. } => None,
        }
    }

    fn exit(&self) -> Exit {
        match self {
            Self::File { .. } => Exit::Internal,
            _ => Exit::Usage,
        }
    }
}

/// Makes a lambda's folder, or replaces the SDK in one, and says what comes next.
pub(crate) fn run(args: &NewArgs) -> Result<Exit, Failure> {
    let (dir, shown) = (&args.path, args.path.display());
    if args.update {
        update(dir)?;
        say(&format!(
            "{shown}/{SDK} is that of gleaner {VERSION} now; next: gleaner build {shown}\n"
        ))?;
        return Ok(Exit::Ok);
    }
    let name = name_of(dir)?;
    make(dir, &name, args.kind.into())?;
    let test = test_command(args.kind.into());
    say(&format!(
        "made {shown}: what it reads and may use is in lambda.toml, what it decides in {}\nnext:\n  cd {shown}\n  {test}\n  gleaner dev . DRIVE.mcap\n",
        source(args.kind.into()),
    ))?;
    Ok(Exit::Ok)
}

fn name_of(dir: &Path) -> Result<LambdaName, NewError> {
    let no_name = || NewError::NoName { path: dir.to_owned() };
    let name = dir.file_name().and_then(|name| name.to_str()).ok_or_else(no_name)?;
    Ok(LambdaName::from_str(name)?)
}

/// All of it or nothing: it is made in a folder beside, which then takes its name.
fn make(dir: &Path, name: &LambdaName, kind: Kind) -> Result<(), NewError> {
    if kind == Kind::Wasm && NO_CRATES.contains(&name.as_str()) {
        return Err(NewError::CrateName { name: name.clone() });
    }
    if dir.symlink_metadata().is_ok() && !is_empty(dir) {
        return Err(NewError::NotEmpty { path: dir.to_owned() });
    }
    if let Some(parent) = dir.parent() {
        fs::create_dir_all(parent).map_err(failed("make", parent))?;
    }
    // One of our own: what has that name already is somebody else's.
    let partial = dir.with_file_name(format!(".{name}.partial-{}", std::process::id()));
    fs::create_dir(&partial).map_err(failed("make", &partial))?;
    let made = fill(&partial, name, kind)
        .and_then(|()| fs::rename(&partial, dir).map_err(failed("make", dir)));
    if made.is_err() {
        // What went wrong tells more than what cannot be cleaned up after it.
        let _ = fs::remove_dir_all(&partial);
    }
    made
}

fn fill(dir: &Path, name: &LambdaName, kind: Kind) -> Result<(), NewError> {
    let example = match kind {
        Kind::Wasm => "examples/hello/rust",
        Kind::Python => "examples/hello/python",
    };
    for (path, bytes) in below(example) {
        let named = String::from_utf8_lossy(bytes).replace("\"hello\"", &format!("\"{name}\""));
        write(dir, path, named.replace("hello.wasm", &format!("{name}.wasm")).as_bytes())?;
    }
    if kind == Kind::Wasm {
        copy("Cargo.lock", dir)?;
    }
    let own: &[(&str, &str)] = match kind {
        Kind::Wasm => &[("Cargo.toml", include_str!("files/package.toml"))],
        Kind::Python => &[
            ("pyproject.toml", include_str!("files/pyproject.toml")),
            ("tests/test_main.py", include_str!("files/test_main.py")),
        ],
    };
    let both = [
        ("README.md", include_str!("files/README.md")),
        (".gitignore", include_str!("files/gitignore")),
    ];
    for (path, text) in own.iter().chain(&both) {
        let text = text.replace("NAME", name.as_str()).replace("VERSION", VERSION);
        let text = text.replace("TEST", test_command(kind)).replace("SOURCE", source(kind));
        write(dir, Path::new(path), text.as_bytes())?;
    }
    unpack_sdk(&dir.join(SDK), kind)
}

fn update(dir: &Path) -> Result<(), Failure> {
    let sdk = dir.join(SDK);
    if !sdk.is_dir() {
        return Err(NewError::NoSdk { path: sdk }.into());
    }
    let kind = Manifest::load(dir)?.lambda.kind;
    let (partial, old) = (dir.join(".gleaner.partial"), dir.join(".gleaner.old"));
    remove(&partial)?;
    remove(&old)?;
    unpack_sdk(&partial, kind)?;
    match fs::rename(&sdk, &old) {
        Err(error) => return Err(failed("replace", &sdk)(error).into()),
        Ok(()) => fs::rename(&partial, &sdk).map_err(failed("make", &sdk))?,
    }
    Ok(remove(&old)?)
}

fn unpack_sdk(to: &Path, kind: Kind) -> Result<(), NewError> {
    let (parts, packages): (&[&str], &[(&str, &str)]) = match kind {
        Kind::Wasm => (&["guest-sdk-rust", "rules", "wit"], &PACKAGES),
        Kind::Python => (&["guest-sdk-python", "wit"], &[]),
    };
    for part in parts {
        for (path, bytes) in below(part) {
            write(to, &Path::new(part).join(path), bytes)?;
        }
    }
    for (path, text) in packages {
        write(to, Path::new(path), text.replace("VERSION", VERSION).as_bytes())?;
    }
    copy("LICENSE", to)
}

/// A packed file, into a folder.
fn copy(file: &str, to: &Path) -> Result<(), NewError> {
    PACKED
        .iter()
        .filter(|(path, _)| *path == file)
        .try_for_each(|(path, bytes)| write(to, Path::new(path), bytes))
}

/// What is packed of a folder, by the path in it.
fn below(folder: &str) -> impl Iterator<Item = (&'static Path, &'static [u8])> {
    PACKED.iter().filter_map(move |(path, bytes)| {
        Some((Path::new(*path).strip_prefix(folder).ok()?, *bytes))
    })
}

fn test_command(kind: Kind) -> &'static str {
    match kind {
        Kind::Wasm => "cargo test",
        Kind::Python => "pip install ./.gleaner/guest-sdk-python pytest && python -m pytest",
    }
}

fn source(kind: Kind) -> &'static str {
    match kind {
        Kind::Wasm => "src/lib.rs",
        Kind::Python => "main.py",
    }
}

fn write(folder: &Path, path: &Path, bytes: &[u8]) -> Result<(), NewError> {
    let path = folder.join(path);
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).map_err(failed("make", parent))?;
    }
    fs::write(&path, bytes).map_err(failed("write", &path))
}

fn is_empty(folder: &Path) -> bool {
    fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_none())
}

fn remove(folder: &Path) -> Result<(), NewError> {
    match fs::remove_dir_all(folder) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => {
            Err(failed("remove", folder)(error))
        }
        _ => Ok(()),
    }
}

fn failed(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> NewError {
    let path = path.to_owned();
    move |source| NewError::File { action, path, source }
}

#[cfg(test)]
mod tests;

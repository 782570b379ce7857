//! `gleaner new`: creates a folder with a lambda that builds, passes its test, and triggers on the
//! sample drive.
//!
//! The new lambda is a copy of the example `hello`. Its SDK is copied to `.gleaner`, so that the
//! folder builds anywhere. Existing files are not changed.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use gleaner_base::{Exit, Explain, Failure};
use gleaner_lambda::Manifest;
use gleaner_lambda::manifest::{LambdaKind, LambdaName, NameError};

use crate::args::NewArgs;
use crate::output::print;
use crate::remove_folder;

/// Embedded files by their path in the repository.
const PACKED: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/packed.rs"));

const SDK: &str = ".gleaner";
/// Replacements for the `Cargo.toml` files of the repository in the SDK.
const PACKAGES: [(&str, &str); 2] = [
    ("guest-sdk-rust/Cargo.toml", include_str!("files/sdk.toml")),
    ("rules/Cargo.toml", include_str!("files/rules.toml")),
];
/// Names that a package cannot have: keywords, and names of existing crates, separated by spaces.
const NO_CRATES: &str = "\
    abstract alloc as async await become box break const continue core crate do dyn else \
    enum extern false final fn for gen gleaner-rules gleaner-sdk if impl in let loop macro \
    match mod move mut override priv proc-macro pub ref return self static std struct super \
    test trait true try type typeof unsafe unsized use virtual where while yield";
const VERSION: &str = env!("CARGO_PKG_VERSION");

#[derive(Debug, thiserror::Error)]
enum NewError {
    #[error("`{}` does not end with a name", path.display())]
    NoName { path: PathBuf },
    #[error(transparent)]
    Name(#[from] NameError),
    #[error("`{}` exists and is not empty", path.display())]
    NotEmpty { path: PathBuf },
    #[error("`{}` does not exist", path.display())]
    NoSdk { path: PathBuf },
    #[error("a crate cannot be named `{name}`")]
    CrateName { name: LambdaName },
    #[error("cannot {action} `{}`", path.display())]
    File { action: &'static str, path: PathBuf, source: io::Error },
}

impl Explain for NewError {
    fn help(&self) -> Option<String> {
        let help = match self {
            Self::NoName { .. } => "name the folder to create, such as: gleaner new brake-dark",
            Self::Name(error) => return error.help(),
            Self::NotEmpty { .. } => {
                "choose another name; to update only the SDK in it: gleaner new --update DIR"
            }
            Self::NoSdk { .. } => "name the folder of a lambda that `gleaner new` created",
            Self::CrateName { .. } => "Rust reserves it; choose another name",
            Self::File { .. } => "choose a writable folder, on a disk with room",
        };
        Some(help.to_owned())
    }

    fn exit(&self) -> Exit {
        match self {
            Self::File { .. } => Exit::Internal,
            _ => Exit::Usage,
        }
    }
}

/// Creates a lambda's folder, or replaces its SDK, and prints the next steps.
pub(crate) fn run(args: &NewArgs) -> Result<Exit, Failure> {
    let (dir, shown) = (&args.path, args.path.display());
    if args.update {
        update(dir)?;
        print(&format!(
            "updated {shown}/{SDK} to gleaner {VERSION}; next: gleaner build {shown}\n"
        ))?;
        return Ok(Exit::Ok);
    }
    let name = name_of(dir)?;
    make(dir, &name, args.kind.into())?;
    let test = test_command(args.kind.into());
    print(&format!(
        "created {shown}: inputs and limits are in lambda.toml, the code is in {}\nnext:\n  \
         cd {shown}\n  {test}\n  gleaner dev . DRIVE.mcap\n",
        source(args.kind.into()),
    ))?;
    Ok(Exit::Ok)
}

fn name_of(dir: &Path) -> Result<LambdaName, NewError> {
    let no_name = || NewError::NoName { path: dir.to_owned() };
    let name = dir.file_name().and_then(|name| name.to_str()).ok_or_else(no_name)?;
    Ok(LambdaName::from_str(name)?)
}

/// Creates the folder atomically: fills a temporary folder beside it and renames that.
fn make(dir: &Path, name: &LambdaName, kind: LambdaKind) -> Result<(), NewError> {
    if kind == LambdaKind::Wasm && NO_CRATES.split(' ').any(|it| it == name.as_str()) {
        return Err(NewError::CrateName { name: name.clone() });
    }
    if dir.symlink_metadata().is_ok() && !is_empty(dir) {
        return Err(NewError::NotEmpty { path: dir.to_owned() });
    }
    if let Some(parent) = dir.parent() {
        fs::create_dir_all(parent).map_err(failed("create", parent))?;
    }
    // The process id makes the name unique.
    let partial = dir.with_file_name(format!(".{name}.partial-{}", std::process::id()));
    fs::create_dir(&partial).map_err(failed("create", &partial))?;
    let result = fill(&partial, name, kind)
        .and_then(|()| fs::rename(&partial, dir).map_err(failed("create", dir)));
    if result.is_err() {
        // The first error matters more than a failed clean-up.
        let _ = fs::remove_dir_all(&partial);
    }
    result
}

fn fill(dir: &Path, name: &LambdaName, kind: LambdaKind) -> Result<(), NewError> {
    let example = match kind {
        LambdaKind::Wasm => "examples/hello/rust",
        LambdaKind::Python => "examples/hello/python",
    };
    for (path, bytes) in below(example) {
        let named = String::from_utf8_lossy(bytes).replace("\"hello\"", &format!("\"{name}\""));
        write(dir, path, named.replace("hello.wasm", &format!("{name}.wasm")).as_bytes())?;
    }
    if kind == LambdaKind::Wasm {
        copy("Cargo.lock", dir)?;
    }
    let own: &[(&str, &str)] = match kind {
        LambdaKind::Wasm => &[("Cargo.toml", include_str!("files/package.toml"))],
        LambdaKind::Python => &[
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
        Ok(()) => fs::rename(&partial, &sdk).map_err(failed("create", &sdk))?,
    }
    Ok(remove(&old)?)
}

fn unpack_sdk(to: &Path, kind: LambdaKind) -> Result<(), NewError> {
    let (parts, packages): (&[&str], &[(&str, &str)]) = match kind {
        LambdaKind::Wasm => (&["guest-sdk-rust", "rules", "wit"], &PACKAGES),
        LambdaKind::Python => (&["guest-sdk-python", "wit"], &[]),
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

fn copy(file: &str, to: &Path) -> Result<(), NewError> {
    PACKED
        .iter()
        .filter(|(path, _)| *path == file)
        .try_for_each(|(path, bytes)| write(to, Path::new(path), bytes))
}

/// Returns the embedded files below `folder`, by their path in it.
fn below(folder: &str) -> impl Iterator<Item = (&'static Path, &'static [u8])> {
    PACKED.iter().filter_map(move |(path, bytes)| {
        Some((Path::new(*path).strip_prefix(folder).ok()?, *bytes))
    })
}

fn test_command(kind: LambdaKind) -> &'static str {
    match kind {
        LambdaKind::Wasm => "cargo test",
        LambdaKind::Python => "pip install ./.gleaner/guest-sdk-python pytest && python -m pytest",
    }
}

fn source(kind: LambdaKind) -> &'static str {
    match kind {
        LambdaKind::Wasm => "src/lib.rs",
        LambdaKind::Python => "main.py",
    }
}

fn write(folder: &Path, path: &Path, bytes: &[u8]) -> Result<(), NewError> {
    let path = folder.join(path);
    if let Some(parent) = path.parent() {
        fs::create_dir_all(parent).map_err(failed("create", parent))?;
    }
    fs::write(&path, bytes).map_err(failed("write", &path))
}

fn is_empty(folder: &Path) -> bool {
    fs::read_dir(folder).is_ok_and(|mut entries| entries.next().is_none())
}

fn remove(folder: &Path) -> Result<(), NewError> {
    remove_folder(folder).map_err(failed("remove", folder))
}

fn failed(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> NewError {
    let path = path.to_owned();
    move |source| NewError::File { action, path, source }
}

#[cfg(test)]
mod tests;

//! Finds the checkout, its target folder, and the cargo that started this program.

use std::env;
use std::ffi::{OsStr, OsString};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use gleaner_base::{Exit, Failure};

/// Folders of lambdas; each lambda has a folder with one for each of its twins.
pub(crate) const FAMILIES: [&str; 3] = ["bench/lambdas", "examples", "tests/lambdas"];

#[derive(Clone)]
pub(crate) struct Checkout {
    root: PathBuf,
    target: PathBuf,
    cargo: OsString,
    /// The commit that programs print which cargo builds.
    commit: Option<String>,
}

impl Checkout {
    /// The checkout that this program was built in.
    pub(crate) fn find() -> Result<Checkout, Failure> {
        let lost = |what| {
            Failure::new(Exit::Usage, what)
                .with_help("start it as `cargo xtask`, inside of the checkout")
        };
        // Cargo sets these variables for the programs that it runs.
        let package =
            env::var_os("CARGO_MANIFEST_DIR").ok_or_else(|| lost("cannot find the checkout"))?;
        let root = Path::new(&package)
            .parent()
            .ok_or_else(|| lost("cannot find the checkout"))?
            .to_owned();
        let cargo = env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
        // This program is TARGET/release/xtask. Every other cargo builds there, too, whatever the
        // user has configured.
        let exe = env::current_exe().ok().filter(|exe| exe.is_absolute());
        let target = exe.as_deref().and_then(|exe| exe.ancestors().nth(2));
        let target = target.ok_or_else(|| lost("cannot find the target folder"))?.to_owned();
        Ok(Checkout { root, target, cargo, commit: None })
    }

    /// A checkout in `root`, with the program `cargo` in place of cargo.
    #[cfg(test)]
    pub(crate) fn with_cargo(root: PathBuf, cargo: OsString) -> Checkout {
        Checkout { target: root.join("target"), root, cargo, commit: None }
    }

    #[cfg(test)]
    pub(crate) fn commit_all(&self) -> String {
        self.git(&["init", "--quiet"]);
        self.git(&["add", "."]);
        self.git(&["commit", "--quiet", "-m", "x"]);
        self.git(&["rev-parse", "HEAD"])
    }

    #[cfg(test)]
    pub(crate) fn git(&self, arguments: &[&str]) -> String {
        let mut git = self.command("git");
        git.args(["-c", "user.name=x", "-c", "user.email=x@localhost"]).args(arguments);
        let output = git.output().unwrap();
        assert!(output.status.success(), "{arguments:?}");
        String::from_utf8(output.stdout).unwrap().trim().to_owned()
    }

    /// The same checkout, whose cargo builds programs that print `commit` with their versions.
    pub(crate) fn with_commit(&self, commit: Option<String>) -> Checkout {
        Checkout { commit, ..self.clone() }
    }

    pub(crate) fn path(&self, relative: impl AsRef<Path>) -> PathBuf {
        self.root.join(relative)
    }

    pub(crate) fn target(&self) -> &Path {
        &self.target
    }

    /// The interpreter of `.venv`, made by [`setup`](crate::setup).
    pub(crate) fn python(&self) -> PathBuf {
        self.path(".venv/bin/python3")
    }

    pub(crate) fn program(&self, name: &str) -> PathBuf {
        self.target.join("release").join(name)
    }

    /// A command that runs `program` in the checkout. It uses the same cargo, target folder and
    /// Python, and the checkout's parts even if the target folder is elsewhere or another Gleaner
    /// is installed.
    pub(crate) fn command(&self, program: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new(program);
        // Set by hooks of git, these would let it work on another checkout.
        for name in ["GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_COMMON_DIR"] {
            command.env_remove(name);
        }
        command
            .current_dir(&self.root)
            .env("CARGO", &self.cargo)
            .env("CARGO_TARGET_DIR", &self.target)
            .env("GLEANER_HOME", self.path("guest-sdk-python"))
            .env("GLEANER_PYTHON", self.python())
            // That of ONNX Runtime, whose wheels send data to Microsoft otherwise.
            .env("ORT_DISABLE_TELEMETRY", "1");
        command
    }

    /// Cargo as a [`command`](Self::command), without the variables in which `cargo run` describes
    /// this package: some build scripts look at them, and would run again after each build without
    /// xtask, with all that depends on them.
    pub(crate) fn cargo(&self) -> Command {
        let mut cargo = self.command(&self.cargo);
        remove_package(&mut cargo);
        cargo.envs(self.commit.iter().map(|commit| ("GLEANER_COMMIT", commit)));
        cargo
    }

    /// A command that runs a script in the checkout as a user would start it.
    pub(crate) fn script(&self, script: impl AsRef<OsStr>) -> Command {
        let mut command = Command::new(script);
        remove_package(&mut command);
        command.current_dir(&self.root);
        command
    }

    /// The folders of the lambdas in `families`, relative to the checkout: all twins of each.
    pub(crate) fn lambdas(&self, families: &[&str]) -> Vec<PathBuf> {
        let below = |folder: &PathBuf| {
            let entries =
                fs::read_dir(self.path(folder)).into_iter().flatten().filter_map(Result::ok);
            let folder = folder.clone();
            entries.map(move |entry| folder.join(entry.file_name())).collect::<Vec<_>>()
        };
        let twins = families
            .iter()
            .map(PathBuf::from)
            .flat_map(|family| below(&family))
            .flat_map(|lambda| below(&lambda));
        let mut lambdas: Vec<_> =
            twins.filter(|twin| self.path(twin).join("lambda.toml").is_file()).collect();
        lambdas.sort();
        lambdas
    }
}

/// Removes the variables in which `cargo run` describes this package.
fn remove_package(command: &mut Command) {
    let is_of_package =
        |name: &str| ["CARGO_MANIFEST_", "CARGO_PKG_"].iter().any(|start| name.starts_with(start));
    for (name, _) in env::vars_os() {
        if name.to_str().is_some_and(is_of_package) {
            command.env_remove(name);
        }
    }
}

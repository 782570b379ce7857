use std::sync::{Mutex, PoisonError};

use super::*;
use crate::{Exit, Explain};
use gleaner_test_support::TestFolder;

/// Linux refuses to start a file that is open for writing anywhere, such as in a child that another
/// test is about to start. The lock serialises tests that write and start programs.
static EXEC_LOCK: Mutex<()> = Mutex::new(());

/// A program that answers the probe like Python of this version.
fn python(dir: &TestFolder, relative: &str, version: &str) -> PathBuf {
    let path = dir.path(relative);
    dir.write_program(
        relative,
        &format!("#!/bin/sh\necho '{version}'\necho '{}'\n", path.display()),
    )
}

/// An installation with `bin/gleaner` and everything else in `lib/gleaner`.
fn installation() -> TestFolder {
    let dir = TestFolder::new();
    dir.write_program("bin/gleaner", "");
    dir.write_program("lib/gleaner/gleaner-runtime", "");
    dir.write("lib/gleaner/lib_gleaner.so", "");
    dir.write("lib/gleaner/start.py", "");
    dir.write("lib/gleaner/gleaner/__init__.py", "");
    dir
}

/// A checkout after `cargo build --release`.
fn checkout() -> TestFolder {
    let dir = TestFolder::new();
    dir.write("Cargo.toml", "");
    dir.write("guest-sdk-python/start.py", "");
    dir.write("guest-sdk-python/gleaner/__init__.py", "");
    dir.write("target/CACHEDIR.TAG", "");
    dir.write_program("target/release/gleaner-runtime", "");
    dir.write("target/release/lib_gleaner.so", "");
    dir
}

#[track_caller]
fn finds_everything(parts: &InstalledPrograms, programs: &Path, python_home: &Path) {
    assert_eq!(parts.program("gleaner-runtime").unwrap(), programs.join("gleaner-runtime"));
    assert_eq!(parts.extension().unwrap(), programs.join("lib_gleaner.so"));
    assert_eq!(parts.python_home().unwrap(), python_home);
}

#[test]
fn an_installed_program_finds_its_parts_in_lib_gleaner() {
    let dir = installation();
    let lib = dir.path("lib/gleaner");
    for exe in ["bin/gleaner", "lib/gleaner/gleaner-runtime"] {
        finds_everything(&InstalledPrograms::around(&dir.path(exe), None, None), &lib, &lib);
    }
}

#[test]
fn gleaner_home_comes_first_as_a_prefix_or_as_the_folder_itself() {
    let (dir, other) = (installation(), installation());
    let lib = dir.path("lib/gleaner");
    for home in [dir.root(), &lib] {
        let parts =
            InstalledPrograms::around(&other.path("bin/gleaner"), Some(home.to_owned()), None);
        finds_everything(&parts, &lib, &lib);
    }
}

#[test]
fn a_program_in_a_cargo_target_folder_finds_its_parts_beside_it_and_in_the_checkout() {
    let dir = checkout();
    for exe in ["target/release/gleaner", "target/release/deps/replay-0123456789abcdef"] {
        let parts = InstalledPrograms::around(&dir.path(exe), None, None);
        finds_everything(&parts, &dir.path("target/release"), &dir.path("guest-sdk-python"));
        assert_eq!(parts.search_paths.checkout(), Some(dir.root()));
    }
}

#[test]
fn outside_of_a_target_folder_nothing_beside_the_program_is_taken() {
    let dir = checkout();
    std::fs::remove_file(dir.path("target/CACHEDIR.TAG")).unwrap();
    let parts = InstalledPrograms::around(&dir.path("target/release/gleaner"), None, None);
    assert!(parts.program("gleaner-runtime").is_err());
    assert!(parts.python_home().is_err());
}

#[test]
fn a_missing_program_is_reported_with_all_folders_and_help() {
    let dir = checkout();
    let root = dir.root().display();
    // A file that is not executable.
    dir.write("target/release/gleaner-shim", "");
    let parts =
        InstalledPrograms::around(&dir.path("target/release/deps/x"), Some(dir.path("home")), None);
    let error = parts.program("gleaner-shim").unwrap_err();
    assert_eq!(
        error.to_string(),
        format!(
            "cannot find gleaner-shim; searched in\n{root}/home/lib/gleaner\n{root}/home\n{root}/target/release/lib/gleaner\n\
             {root}/target/release/deps\n{root}/target/release\n{root}/guest-sdk-python"
        )
    );
    let help = "in a checkout run `cargo build --release`, else set GLEANER_HOME to the folder of the installation";
    assert_eq!(error.help().as_deref(), Some(help));
    assert_eq!(error.exit(), Exit::Internal);
}

#[test]
fn missing_python_files_are_reported_with_the_command_that_makes_them() {
    let dir = installation();
    std::fs::remove_file(dir.path("lib/gleaner/gleaner/__init__.py")).unwrap();
    let error =
        InstalledPrograms::around(&dir.path("bin/gleaner"), None, None).python_home().unwrap_err();
    let lib = dir.path("lib/gleaner");
    assert_eq!(
        error.to_string(),
        format!("cannot find start.py with the package gleaner; searched in\n{}", lib.display())
    );
    let help = "in a checkout run `cargo xtask demo`, else set GLEANER_HOME to the folder of the installation";
    assert_eq!(error.help().as_deref(), Some(help));
}

#[test]
fn the_chosen_python_comes_before_those_of_lambda_and_checkout() {
    let _lock = EXEC_LOCK.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = checkout();
    let exe = dir.path("target/release/gleaner");
    let wanted = python(&dir, "wanted/python", "3 9");
    let own = python(&dir, "elsewhere/bin/python3", "3 12");
    environment(&dir, &own);
    let shared = python(&dir, ".venv/bin/python3", "4 0");
    let lambda = dir.path("lambda");

    let parts = InstalledPrograms::around(&exe, None, Some(wanted.clone()));
    assert_eq!(parts.python(Some(&lambda)).unwrap(), wanted);
    let parts = InstalledPrograms::around(&exe, None, None);
    assert_eq!(parts.python(Some(&lambda)).unwrap(), dir.path("lambda/.venv/bin/python3"));
    assert_eq!(parts.python(None).unwrap(), shared);
    assert_eq!(parts.python(Some(&dir.path("another"))).unwrap(), shared);
}

/// A virtual environment in the folder `lambda`, as `python3 -m venv` makes it of `program`.
fn environment(dir: &TestFolder, program: &std::path::Path) {
    let home = program.parent().unwrap().display();
    dir.write("lambda/.venv/pyvenv.cfg", &format!("home = {home}\n"));
    let link = dir.path("lambda/.venv/bin/python3");
    std::fs::create_dir_all(link.parent().unwrap()).unwrap();
    let _ = std::fs::remove_file(&link);
    std::os::unix::fs::symlink(program, link).unwrap();
}

#[test]
fn no_program_of_a_lambda_is_run_to_find_its_python() {
    let _lock = EXEC_LOCK.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = checkout();
    let lambda = dir.path("lambda");
    let shared = python(&dir, ".venv/bin/python3", "3 12");
    let parts = InstalledPrograms::around(&dir.path("target/release/gleaner"), None, None);
    let ran = dir.path("ran");
    let script = format!("#!/bin/sh\ntouch '{}'\n", ran.display());
    assert_eq!(
        parts.python_and_unused_venv(Some(&lambda)).unwrap(),
        (shared.clone(), None),
        "it has no environment"
    );
    // A copied program, as `python3 -m venv --copies` makes it, and one behind a link within the
    // folder.
    let own = dir.write_program("lambda/.venv/bin/python3", &script);
    let (chosen, unused) = parts.python_and_unused_venv(Some(&lambda)).unwrap();
    assert_eq!(chosen, shared);
    let why = "is a program in the lambda's folder; create the environment with `python3 -m venv`, which uses links";
    assert_eq!(unused.unwrap(), RejectedPython { path: own.clone(), reason: why.to_owned() });
    std::fs::rename(own, dir.path("lambda/python3")).unwrap();
    environment(&dir, &dir.path("lambda/python3"));
    assert_eq!(parts.python(Some(&lambda)).unwrap(), shared);
    // A valid program, but with libraries that the lambda chooses.
    environment(&dir, &python(&dir, "elsewhere/bin/python3", "3 12"));
    dir.write("lambda/.venv/pyvenv.cfg", &format!("home = {}\n", lambda.display()));
    assert_eq!(parts.python(Some(&lambda)).unwrap(), shared);
    assert!(!ran.exists());
}

#[test]
fn the_program_behind_an_environments_link_is_started_by_its_own_path() {
    let _lock = EXEC_LOCK.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = checkout();
    let lambda = dir.path("lambda");
    let shared = python(&dir, ".venv/bin/python3", "3 12");
    let parts = InstalledPrograms::around(&dir.path("target/release/gleaner"), None, None);
    // Records the name by which it was started.
    let started = dir.path("started");
    let home = dir.path("elsewhere/bin");
    let script = format!(
        "#!/bin/sh\necho \"$0\" >> '{}'\necho '3 12'\necho '{}/python3'\n",
        started.display(),
        home.display()
    );
    let own = dir.write_program("elsewhere/bin/python3", &script);
    environment(&dir, &own);
    assert_eq!(parts.python(Some(&lambda)).unwrap(), lambda.join(".venv/bin/python3"));
    assert_eq!(std::fs::read_to_string(&started).unwrap().trim_end(), own.to_str().unwrap());
    // Library paths that only the interpreter would read.
    for name in ["python3._pth", "PYTHON._PTH"] {
        let names = dir.write(&format!("lambda/.venv/bin/{name}"), "../evil\n");
        assert_eq!(parts.python(Some(&lambda)).unwrap(), shared, "{name}");
        std::fs::remove_file(names).unwrap();
    }
    let home = format!("home = {}\n", home.display());
    let long = format!("#{}{home}{home}", "x".repeat(10_000));
    for config in [
        format!("\u{1f}home = /evil/bin\n{home}"),
        format!("a = b\rhome = /evil/bin\n{home}"),
        long,
    ] {
        dir.write("lambda/.venv/pyvenv.cfg", &config);
        assert_eq!(parts.python(Some(&lambda)).unwrap(), shared, "{config:?}");
    }
    dir.write("lambda/.venv/pyvenv.cfg", &home);
    assert_eq!(parts.python(Some(&lambda)).unwrap(), lambda.join(".venv/bin/python3"));
    // A program that is not an interpreter, and one that starts another.
    environment(&dir, &dir.write_program("elsewhere/bin/shutdown", &script));
    assert_eq!(parts.python(Some(&lambda)).unwrap(), shared);
    environment(&dir, &dir.write_program("elsewhere/bin/python3.12", &script));
    assert_eq!(parts.python(Some(&lambda)).unwrap(), shared);
    assert_eq!(std::fs::read_to_string(&started).unwrap().lines().count(), 3);
}

#[test]
fn an_unusable_chosen_python_is_refused_and_no_other_is_used() {
    let _lock = EXEC_LOCK.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = checkout();
    python(&dir, ".venv/bin/python3", "3 12");
    let old = python(&dir, "old", "3 8");
    for (wanted, why) in [(dir.path("nope"), "not found"), (old, "is Python 3.8")] {
        let parts = InstalledPrograms::around(
            &dir.path("target/release/gleaner"),
            None,
            Some(wanted.clone()),
        );
        let error = parts.python(None).unwrap_err();
        let message =
            format!("GLEANER_PYTHON is `{}`, which cannot be used: {why}", wanted.display());
        assert_eq!(error.to_string(), message);
        assert_eq!(error.exit(), Exit::Usage);
    }
}

#[test]
fn gleaner_home_must_have_a_part() {
    let (installed, dir) = (installation(), checkout());
    for home in [installed.root(), &installed.path("lib/gleaner"), &dir.path("guest-sdk-python")] {
        assert!(search_paths::has_parts(home), "{}", home.display());
    }
    for home in [dir.root(), &dir.path("nope"), &installed.path("bin")] {
        assert!(!search_paths::has_parts(home), "{}", home.display());
    }
    let error = InstallationError::Home { home: "/nope".into() };
    assert_eq!(
        error.to_string(),
        "GLEANER_HOME is `/nope`, which is not an installation of Gleaner"
    );
    assert_eq!(error.exit(), Exit::Usage);
}

#[test]
fn without_a_working_python_each_candidate_is_named_with_its_error() {
    let _lock = EXEC_LOCK.lock().unwrap_or_else(PoisonError::into_inner);
    let dir = TestFolder::new();
    let old = python(&dir, "old", "3 8");
    let silent = dir.write_program("silent", "#!/bin/sh\nexit 3\n");
    let split = dir.write_program(
        "split",
        "#!/bin/sh\necho 'Traceback (most recent call last):' >&2\necho \"ModuleNotFoundError: No module named 'ensurepip'\" >&2\nexit 1\n",
    );
    let other = dir.write_program("other", "#!/bin/sh\necho hello\n");
    let locked = dir.write("locked", "");
    let missing = dir.path("missing");
    let root = dir.root().display().to_string();
    let error = python::first_that_runs(vec![old, silent, split, other, locked, missing], None)
        .unwrap_err();
    assert_eq!(
        error.to_string(),
        format!(
            "cannot find a working Python 3.9 or newer; tried\n\
             {root}/old: is Python 3.8\n\
             {root}/silent: ends with exit status: 3\n\
             {root}/split: ModuleNotFoundError: No module named 'ensurepip'\n\
             {root}/other: does not behave like Python\n\
             {root}/locked: Permission denied (os error 13)\n\
             {root}/missing: not found"
        )
    );
    let help = "in a checkout run `cargo xtask demo`, or set GLEANER_PYTHON to a Python 3.9 or newer with venv and ensurepip";
    assert_eq!(error.help().as_deref(), Some(help));
}

#[test]
fn the_cache_follows_xdg_and_ignores_relative_paths() {
    let path = |text: &str| Some(PathBuf::from(text));
    assert_eq!(cache_below(path("/x"), path("/home/u")).unwrap(), Path::new("/x/gleaner"));
    assert_eq!(
        cache_below(path("x"), path("/home/u")).unwrap(),
        Path::new("/home/u/.cache/gleaner")
    );
    assert_eq!(cache_below(None, path("/home/u")).unwrap(), Path::new("/home/u/.cache/gleaner"));
    let error = cache_below(None, path("u")).unwrap_err();
    assert_eq!(
        error.to_string(),
        "no folder for the cache: neither XDG_CACHE_HOME nor HOME is an absolute path"
    );
    assert_eq!(error.help().as_deref(), Some("set XDG_CACHE_HOME"));
}

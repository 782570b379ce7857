//! Tests of `gleaner new`.

use gleaner_lambda::Manifest;
use tempfile::TempDir;
use toml::{Table, Value};

use super::*;

fn lambda(scratch: &TempDir, name: &str, kind: LambdaKind) -> PathBuf {
    let dir = scratch.path().join(name);
    make(&dir, &name.parse().unwrap(), kind).unwrap();
    dir
}

#[test]
fn a_new_lambda_has_a_valid_manifest_with_its_name_and_entry() {
    let scratch = tempfile::tempdir().unwrap();
    for (kind, entry) in [(LambdaKind::Wasm, "pot-hole.wasm"), (LambdaKind::Python, "main.py")] {
        let dir = lambda(&scratch, "pot-hole", kind);
        let manifest = Manifest::load(&dir).unwrap();
        assert_eq!((manifest.lambda.name.as_str(), manifest.lambda.kind), ("pot-hole", kind));
        assert_eq!(manifest.lambda.entry.to_string(), entry);
        assert!(dir.join(source(kind)).is_file());
        let placeholders = ["NAME", "VERSION", "TEST", "SOURCE", "hello"];
        assert_eq!(fs::read_dir(scratch.path()).unwrap().count(), 1);
        for file in ["README.md", "lambda.toml"] {
            let text = fs::read_to_string(dir.join(file)).unwrap();
            assert!(placeholders.iter().all(|word| !text.contains(word)), "{text}");
        }
        fs::remove_dir_all(dir).unwrap();
    }
}

#[test]
fn existing_files_are_not_changed() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = lambda(&scratch, "mine", LambdaKind::Python);
    fs::write(dir.join("main.py"), "precious").unwrap();
    let again = make(&dir, &"mine".parse().unwrap(), LambdaKind::Python).unwrap_err();
    assert!(matches!(again, NewError::NotEmpty { .. }), "{again}");
    update(&dir).unwrap();
    assert_eq!(fs::read_to_string(dir.join("main.py")).unwrap(), "precious");
    let elsewhere = scratch.path().join("link");
    std::os::unix::fs::symlink(&dir, &elsewhere).unwrap();
    assert!(make(&elsewhere, &"link".parse().unwrap(), LambdaKind::Python).is_err());
}

#[test]
fn an_update_replaces_the_whole_sdk_folder() {
    let scratch = tempfile::tempdir().unwrap();
    for kind in [LambdaKind::Wasm, LambdaKind::Python] {
        let dir = lambda(&scratch, "mine", kind);
        let (stale, wit) = (dir.join(SDK).join("stale"), dir.join(SDK).join("wit"));
        fs::write(&stale, "").unwrap();
        fs::remove_dir_all(&wit).unwrap();
        update(&dir).unwrap();
        assert!(!stale.exists() && wit.is_dir());
        assert!(!dir.join(".gleaner.old").exists() && !dir.join(".gleaner.partial").exists());
        fs::remove_dir_all(dir).unwrap();
    }
    assert!(update(scratch.path()).unwrap_err().to_string().contains("does not exist"));
}

#[test]
fn parent_folders_are_created() {
    let scratch = tempfile::tempdir().unwrap();
    let dir = scratch.path().join("far/away");
    make(&dir, &"away".parse().unwrap(), LambdaKind::Python).unwrap();
    assert!(dir.join("lambda.toml").is_file());
}

#[test]
fn a_folder_needs_a_name_that_a_lambda_can_have() {
    for (path, message) in [
        ("/", "does not end with a name"),
        ("..", "does not end with a name"),
        ("My Lambda", "is not a lambda name"),
    ] {
        let error = name_of(Path::new(path)).unwrap_err();
        assert!(error.to_string().contains(message) && error.help().is_some(), "{error}");
    }
    assert_eq!(name_of(Path::new("some/where/pot-hole/")).unwrap().as_str(), "pot-hole");
    let scratch = tempfile::tempdir().unwrap();
    for name in ["test", "gleaner-rules", "gleaner-sdk", "type"] {
        let result = make(&scratch.path().join(name), &name.parse().unwrap(), LambdaKind::Wasm);
        assert!(matches!(result, Err(NewError::CrateName { .. })), "{name}");
    }
}

/// Versions are written twice, since the copy has to work outside of this workspace.
#[test]
fn the_packed_sdk_has_the_versions_of_this_workspace() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let read = |path: &str| fs::read_to_string(root.join(path)).unwrap().parse::<Table>().unwrap();
    let (workspace, sdk) = (read("Cargo.toml"), read("guest-sdk-rust/Cargo.toml"));
    let packed =
        include_str!("files/sdk.toml").replace("VERSION", VERSION).parse::<Table>().unwrap();
    assert_eq!(packed["features"], sdk["features"]);
    // For all targets, and natively.
    let targets =
        |table: &Table| table["target"].as_table().unwrap().keys().cloned().collect::<Vec<_>>();
    assert_eq!((targets(&packed), targets(&packed).len()), (targets(&sdk), 1));
    let dependencies = |table: &Table| {
        let mut all =
            table.get("dependencies").and_then(Value::as_table).cloned().unwrap_or_default();
        for target in
            table.get("target").and_then(Value::as_table).into_iter().flat_map(Table::values)
        {
            all.extend(target["dependencies"].as_table().unwrap().clone());
        }
        all
    };
    let names = |table: &Table| dependencies(table).keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&packed), names(&sdk));
    assert_eq!(names(&packed), ["gleaner-rules", "rustfft", "toml", "wit-bindgen"]);
    for name in names(&packed) {
        let plain = |table: &Table| {
            let mut value = dependencies(table)[&name].clone();
            if let Some(table) = value.as_table_mut() {
                table.remove("optional");
                // The folder is beside that of the SDK in both places.
                let path = table
                    .get("path")
                    .and_then(Value::as_str)
                    .map(|path| path.trim_start_matches("../").into());
                path.map(|path| table.insert("path".to_owned(), path));
            }
            value
        };
        assert_eq!(plain(&packed), plain(workspace["workspace"].as_table().unwrap()), "{name}");
    }
    let package = workspace["workspace"]["package"].as_table().unwrap();
    let lambda = include_str!("files/package.toml").parse::<Table>().unwrap();
    for key in ["edition", "rust-version"] {
        assert_eq!(lambda["package"][key], package[key], "{key}");
    }
    let rules =
        include_str!("files/rules.toml").replace("VERSION", VERSION).parse::<Table>().unwrap();
    for key in ["version", "edition", "rust-version", "license"] {
        assert_eq!(
            (&packed["package"][key], &rules["package"][key]),
            (&package[key], &package[key]),
            "{key}"
        );
    }
    assert_eq!(names(&rules), names(&read("rules/Cargo.toml")));
}

use std::fs;
use std::path::Path;
use std::time::Duration;

use tempfile::TempDir;

use super::*;

const PYTHON: &str = "lambda = { name = 'x', version = '0.1.0', kind = 'python', entry = 'main.py' }\nschedule.period = '1s'\n";

struct LambdaFolder(TempDir);

impl LambdaFolder {
    fn new(manifest: &str) -> LambdaFolder {
        let folder = tempfile::Builder::new().prefix("gleaner-cli-").tempdir();
        let lambda = LambdaFolder(folder.unwrap());
        lambda.write("lambda.toml", manifest);
        lambda
    }

    fn write(&self, relative: &str, text: &str) {
        let path = self.0.path().join(relative);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }

    fn build(&self) -> Result<Built, BuildError> {
        let started = SystemTime::now();
        let args = BuildArgs { lambda: self.0.path().to_owned(), ..BuildArgs::default() };
        build(&args, &Manifest::load(self.0.path()).unwrap(), started)
    }

    fn read(&self, relative: &str) -> Option<String> {
        fs::read_to_string(self.0.path().join(relative)).ok()
    }

    fn files(&self, relative: &str) -> Vec<String> {
        fn walk(root: &Path, folder: &Path, found: &mut Vec<String>) {
            for entry in fs::read_dir(folder).unwrap().map(Result::unwrap) {
                match entry.path().is_dir() {
                    true => walk(root, &entry.path(), found),
                    false => {
                        found.push(entry.path().strip_prefix(root).unwrap().display().to_string())
                    }
                }
            }
        }
        let mut found = Vec::new();
        walk(&self.0.path().join(relative), &self.0.path().join(relative), &mut found);
        found.sort();
        found
    }
}

#[test]
fn a_python_build_holds_the_manifest_the_sources_and_the_messages() {
    let lambda = LambdaFolder::new(PYTHON);
    for file in [
        "main.py",
        "part/of.py",
        "part/build/deep.py",
        "msg/a/msg/B.msg",
        "msg/README.md",
        "README.md",
        "tests/test.py",
    ] {
        lambda.write(file, "123");
    }
    let built = lambda.build().unwrap();
    let files = ["lambda.toml", "main.py", "msg/a/msg/B.msg", "part/build/deep.py", "part/of.py"];
    assert_eq!(lambda.files("build"), files);
    assert_eq!(built, Built { files: 5, bytes: 4 * 3 + PYTHON.len() as u64 });
}

#[test]
fn a_second_build_replaces_the_first_and_leaves_nothing_else() {
    let lambda = LambdaFolder::new(PYTHON);
    lambda.write("main.py", "1");
    lambda.write("gone.py", "");
    lambda.build().unwrap();
    fs::remove_file(lambda.0.path().join("gone.py")).unwrap();
    lambda.write("main.py", "2");
    lambda.build().unwrap();
    assert_eq!(lambda.files(""), ["build/lambda.toml", "build/main.py", "lambda.toml", "main.py"]);
    assert_eq!(lambda.read("build/main.py").as_deref(), Some("2"));
    assert!(BuildDir::check_fresh(lambda.0.path()).is_ok());
}

#[test]
fn a_build_that_fails_leaves_the_old_one_as_it_was() {
    let lambda = LambdaFolder::new(PYTHON);
    lambda.write("main.py", "1");
    lambda.build().unwrap();
    fs::remove_file(lambda.0.path().join("main.py")).unwrap();
    let error = lambda.build().unwrap_err();
    assert!(
        matches!(&error, BuildError::Missing { path, .. } if path.ends_with("main.py")),
        "{error}"
    );
    assert_eq!(lambda.files(""), ["build/lambda.toml", "build/main.py", "lambda.toml"]);
}

#[test]
fn remains_of_a_killed_build_are_removed() {
    let lambda = LambdaFolder::new(PYTHON);
    lambda.write("main.py", "1");
    lambda.write(".build.partial/half.py", "");
    lambda.write(".build.old/main.py", "");
    lambda.build().unwrap();
    assert_eq!(lambda.files(""), ["build/lambda.toml", "build/main.py", "lambda.toml", "main.py"]);
}

#[test]
fn a_source_from_the_future_is_named() {
    let lambda = LambdaFolder::new(PYTHON);
    lambda.write("main.py", "1");
    let file = File::options().write(true).open(lambda.0.path().join("main.py")).unwrap();
    file.set_modified(SystemTime::now() + Duration::from_secs(3600)).unwrap();
    let error = lambda.build().unwrap_err();
    assert_eq!(error.to_string(), "`main.py` is newer than the build just made from it");
}

#[test]
fn an_entry_has_the_extension_of_its_kind() {
    for (kind, entry, message) in [
        ("python", "lambda.toml", "the entry of a python lambda ends with `.py`"),
        ("wasm", "main.py", "the entry of a wasm lambda ends with `.wasm`"),
    ] {
        let lambda = LambdaFolder::new(&PYTHON.replace("python", kind).replace("main.py", entry));
        let error = lambda.build().unwrap_err();
        assert!(error.to_string().contains(message), "{error}");
    }
}

#[test]
fn a_wasm_lambda_without_a_package_is_refused_with_help() {
    use gleaner_base::Explain;
    let lambda = LambdaFolder::new(&PYTHON.replace("python", "wasm").replace("main.py", "x.wasm"));
    let error = lambda.build().unwrap_err();
    assert_eq!(
        error.to_string(),
        format!("`{}` does not exist", lambda.0.path().join("Cargo.toml").display())
    );
    assert!(error.help().unwrap().contains("cargo init --lib"));
}

#[test]
fn messages_are_optional_but_a_model_in_the_manifest_must_exist() {
    let model =
        format!("[[model]]\nname = 'm'\nfile = 'models/m.onnx'\nsha256 = '{}'\n", "0".repeat(64));
    let lambda = LambdaFolder::new(&format!("{PYTHON}{model}"));
    lambda.write("main.py", "1");
    let error = lambda.build().unwrap_err();
    assert!(error.to_string().contains("models/m.onnx"), "{error}");
    lambda.write("models/m.onnx", "1");
    lambda.build().unwrap();
    assert_eq!(lambda.files("build"), ["lambda.toml", "main.py", "models/m.onnx"]);
}

#[test]
fn data_files_of_the_folder_are_built_in_under_their_paths_and_others_are_noted() {
    let lambda = LambdaFolder::new(&PYTHON.replace("entry", "files = ['a.json', 'calib'], entry"));
    lambda.write("main.py", "1");
    let refused = |path: &str| {
        let message = format!("{path}` (`files` of [lambda] in lambda.toml) does not exist");
        let error = lambda.build().unwrap_err().to_string();
        assert!(error.ends_with(&message), "{error}");
    };
    refused("/a.json");
    lambda.write("a.json", "[1]");
    fs::create_dir(lambda.0.path().join("calib")).unwrap();
    refused("/calib/*");
    lambda.write("calib/deep/front", "f = 2");
    let noted = || left_out(lambda.0.path(), &Manifest::load(lambda.0.path()).unwrap());
    assert_eq!(noted(), "");
    (1..=7).for_each(|number| lambda.write(&format!("{number}.csv"), ""));
    lambda.build().unwrap();
    assert_eq!(lambda.files("build"), ["a.json", "calib/deep/front", "lambda.toml", "main.py"]);
    assert_eq!(lambda.read("build/calib/deep/front").as_deref(), Some("f = 2"));
    let listed = "`1.csv`, `2.csv`, `3.csv`, `4.csv`, `5.csv` and 2 more; add";
    assert!(noted().starts_with(&format!("note: not built in: {listed}")), "{}", noted());
}

#[test]
fn a_note_says_which_inputs_clips_will_lack() {
    let manifest = |recorded: &str| {
        let inputs = "[[input]]\nname = 'imu'\ntopic = '/imu/data'\ntype = 'sensor_msgs/msg/Imu'\n";
        let text = format!("{PYTHON}{inputs}[record]\ntopics = ['{recorded}']\n");
        Manifest::parse(&text, "lambda.toml").unwrap()
    };
    assert_eq!(note(&manifest("/imu/data")), "");
    assert!(note(&manifest("/camera")).starts_with("note: [record] lacks `/imu/data`"));
}

//! The checkout stands alone: nothing in it needs a folder beside it.

use gleaner_tests::tree::files;

#[test]
fn nothing_names_a_folder_beside_the_checkout() {
    // In two pieces, so that this file does not hold what it looks for.
    let beside = ["../sha", "red/"].concat();
    // It sets `GLEANER_SHARED` where that folder exists.
    let others = files().into_iter().filter(|file| file.path != ".ci/run");
    let found = others.filter(|file| file.text.contains(&beside));
    let found: Vec<_> = found.map(|file| file.path).collect();
    assert_eq!(found, Vec::<String>::new(), "read the folder that GLEANER_SHARED names instead");
}

/// `.ci/run` runs these once more without that folder.
#[test]
fn tests_that_read_shared_data_are_run_again_without_it() {
    let files = files();
    let suites = files.iter().find(|file| file.path == "xtask/src/suites/mod.rs");
    let (_, list) = suites.and_then(|it| it.text.split_once("READ_SHARED: &str")).unwrap();
    let list = list.split(';').next().unwrap_or_default();
    // By the function of `test-support`, or read directly.
    let signs = [["support::", "shared_file;"], ["var_os(\"GLEANER_", "SHARED\")"]];
    let signs = signs.map(|it| it.concat());
    let mut readers = 0;
    for file in &files {
        let is_reader =
            file.is_one_of(&["rs"]) && signs.iter().any(|sign| file.text.contains(sign));
        if !is_reader || file.path == "test-support/src/shared_data.rs" {
            continue;
        }
        let (folder, _) =
            file.path.rsplit_once("/src/").or(file.path.rsplit_once("/tests/")).unwrap();
        let name =
            folder.rsplit('/').find(|part| *part != "rust" && *part != "tests").unwrap_or("drives");
        assert!(
            list.contains(name),
            "`{name}` is not in READ_SHARED, and reads it in {}",
            file.path
        );
        readers += 1;
    }
    assert_eq!(readers, 4, "the search finds other files than before");
}

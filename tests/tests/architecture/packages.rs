//! Size of `Cargo.lock`: the number of packages, and of packages with several versions.

use std::collections::BTreeMap;

use gleaner_tests::tree::files;

/// Number of packages, with those of the workspace. It only goes down: a change that removes a
/// package lowers it.
const PACKAGES_MAX: usize = 629;
/// Number of versions beyond the first of each package. It only goes down.
const SURPLUS_MAX: usize = 25;

/// Packages with several versions: name, number of versions, and in the comment the package that
/// needs an older one.
const REPEATED: &[(&str, usize)] = &[
    ("bit-vec", 2),        // yasna, of rcgen
    ("block-buffer", 2),   // digest 0.10
    ("cpufeatures", 2),    // sha2 0.10
    ("crypto-common", 2),  // digest 0.10
    ("digest", 2),         // sha2 0.10
    ("embedded-io", 2),    // postcard, of wasmtime, which lists both and uses neither
    ("getrandom", 2),      // ring
    ("hashbrown", 2),      // sqlx-core, and gimli of wasmtime
    ("io-extras", 2),      // socketpair, of rustdds
    ("io-lifetimes", 2),   // socketpair, of rustdds, and fs-set-times of wasmtime-wasi
    ("itertools", 3),      // bindgen of cyclors, and ratatui with wasmtime; ros2-client has 0.15
    ("libloading", 2),     // clang-sys, of cyclors
    ("linux-raw-sys", 2),  // rustix 0.38
    ("nom", 2),            // x509-parser of rcgen, and cexpr of cyclors
    ("rustc-hash", 2),     // bindgen, of cyclors
    ("rustix", 2),         // which, of cyclors
    ("sha2", 2),           // cranelift-codegen and wasmtime-environ
    ("shlex", 2),          // bindgen, of cyclors
    ("syn", 3),            // cdr-encoding-size-derive of rustdds; 2 has many users, and so has 3
    ("thiserror", 2),      // cdr-encoding, of rustdds
    ("thiserror-impl", 2), // thiserror 1
    ("windows-sys", 3),    // ring, and socketpair of rustdds
];

/// Advice for a package that has a further version.
const HELP: &str = "`cargo tree --target all -e all -i NAME@VERSION` prints the package that needs \
                    a version. Choose a version of that package which uses the version of the \
                    others: `cargo update -p PACKAGE --precise VERSION`, or `Cargo.toml`.";

fn versions() -> BTreeMap<String, Vec<String>> {
    let file = files().into_iter().find(|file| file.path == "Cargo.lock").expect("it is there");
    let lock: toml::Table = file.text.parse().expect("it is TOML");
    let mut versions = BTreeMap::<_, Vec<_>>::new();
    for package in lock["package"].as_array().expect("it lists packages") {
        let text = |key: &str| package[key].as_str().expect("each has one").to_owned();
        versions.entry(text("name")).or_default().push(text("version"));
    }
    versions
}

#[test]
fn there_are_no_more_packages_than_there_were() {
    let packages = versions().values().map(Vec::len).sum::<usize>();
    let help = "remove a dependency, or a feature that needs further packages; \
                with fewer packages, lower PACKAGES_MAX";
    assert_eq!(packages, PACKAGES_MAX, "{help}");
}

#[test]
fn packages_have_one_version_except_those_listed() {
    let versions = versions();
    let repeated = versions.iter().filter(|(_, versions)| versions.len() > 1);
    let repeated: BTreeMap<_, _> =
        repeated.map(|(name, versions)| (name.as_str(), versions.len())).collect();
    let listed = REPEATED.iter().copied().collect();
    assert_eq!(repeated, listed, "{HELP} If there are fewer versions, correct REPEATED.");
    let surplus = repeated.values().map(|count| count - 1).sum::<usize>();
    assert_eq!(surplus, SURPLUS_MAX, "it only goes down");
}

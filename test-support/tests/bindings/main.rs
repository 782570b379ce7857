//! The bindings of the Rust SDK, `guest-sdk-rust/src/bindings.rs`, are those that wit-bindgen
//! generates from `wit/`. They are a file of the SDK so that a lambda compiles no generator.
//! `cargo xtask bless` writes them: it sets `GLEANER_BLESS`.

mod calls;

use std::env;
use std::fs;
use std::path::{Path, PathBuf};

use wit_bindgen_core::wit_parser::Resolve;
use wit_bindgen_core::{Files, WorldGenerator};
use wit_bindgen_rust::Opts;

const FILE: &str = "guest-sdk-rust/src/bindings.rs";

/// The beginning of the file.
const HEADER: &str = "\
//! Bindings to the host for a component. Only this crate uses them; natively
//! `testing::bindings` replaces all but their data types.
//!
//! `cargo xtask bless` makes this file of `wit/` with wit-bindgen.
";
const LINTS: &str =
    "#![allow(unsafe_code, missing_docs, clippy::all, clippy::undocumented_unsafe_blocks)]\n\n";

fn path(relative: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(relative)
}

/// Compares a file of the checkout with its text, or writes it.
fn is_up_to_date(file: &str, text: &str) {
    if env::var_os("GLEANER_BLESS").is_some() {
        return fs::write(path(file), text).expect("the file can be written");
    }
    let now = fs::read_to_string(path(file)).expect(file);
    assert!(text == now, "run `cargo xtask bless`, which writes {file}");
}

fn generated() -> String {
    let mut resolve = Resolve::default();
    let (package, _) = resolve.push_path(path("wit")).expect("`wit/` is a package");
    let world = resolve.select_world(&[package], Some("lambda")).expect("it has this world");
    // Not formatted: the formatted file has 1,900 lines more.
    let options = Opts {
        // `gleaner_sdk::lambda!` uses the macro in another crate.
        pub_export_macro: true,
        export_macro_name: Some("export_lambda".to_owned()),
        default_bindings_module: Some("gleaner_sdk::bindings".to_owned()),
        ..Opts::default()
    };
    let mut files = Files::default();
    options.build().generate(&mut resolve, world, &mut files).expect("bindings of the world");
    let (_, text) = files.iter().next().expect("one file");
    let text = str::from_utf8(text).expect("the file is text");
    // Without the blanks that it has at ends of lines, and without blank lines.
    let lines = text.lines().map(str::trim_end).filter(|line| !line.is_empty());
    [HEADER, LINTS].concat() + &lines.flat_map(|line| [line, "\n"]).collect::<String>()
}

#[test]
fn bindings_of_the_rust_sdk_are_up_to_date() {
    let text = generated();
    assert!(text == generated(), "the same `wit/` has the same bindings");
    is_up_to_date(FILE, &text);
}

#[test]
fn the_page_of_all_calls_is_up_to_date() {
    let mut resolve = Resolve::default();
    resolve.push_path(path("wit")).expect("`wit/` is a package");
    is_up_to_date(calls::PAGE, &calls::page(&resolve));
}

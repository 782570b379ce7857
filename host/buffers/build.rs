//! Tells rustc that `--cfg loom` is known here: `[lints] workspace = true` leaves no room for it in
//! Cargo.toml.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-check-cfg=cfg(loom)");
}

//! Declares `--cfg loom` to rustc: `[lints] workspace = true` excludes declaring it in Cargo.toml.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-check-cfg=cfg(loom)");
}

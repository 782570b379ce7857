//! Links calls in the extension module to its own functions, if it defines one of that name.
//!
//! Python loads the module with RTLD_LOCAL, so other libraries take precedence: without this flag
//! the module's `setsockopt` (`gleaner-dds`), which keeps a multicast address from being announced,
//! would never be called.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rustc-link-arg-cdylib=-Wl,-Bsymbolic-functions");
}

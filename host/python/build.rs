//! Binds calls of the extension module to its own functions, where it has one of the name.
//!
//! Python loads it with RTLD_LOCAL, so that other libraries come first: the module's `setsockopt`
//! (`gleaner_transport`, room `dds`), which keeps a multicast address from being announced, would
//! never be called.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    println!("cargo:rustc-link-arg-cdylib=-Wl,-Bsymbolic-functions");
}

//! Bindings that wit-bindgen generates from `wit/` for a component. Only this crate uses them;
//! natively `testing::bindings` replaces them.
#![allow(unsafe_code, missing_docs, clippy::undocumented_unsafe_blocks)]

wit_bindgen::generate!({
    path: "../wit",
    world: "lambda",
    pub_export_macro: true,
    export_macro_name: "export_lambda",
    default_bindings_module: "gleaner_sdk::bindings",
});

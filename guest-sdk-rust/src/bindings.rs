//! What wit-bindgen generates from `wit/`, in a component. Only this crate's other files use it;
//! natively `testing::bindings` takes its place.
#![allow(unsafe_code, missing_docs, clippy::undocumented_unsafe_blocks)]

wit_bindgen::generate!({
    path: "../wit",
    world: "lambda",
    pub_export_macro: true,
    export_macro_name: "export_lambda",
    default_bindings_module: "gleaner_sdk::bindings",
});

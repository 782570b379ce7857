//! The files of the page, in the program.

use axum::extract::Path;
use axum::http::header;
use axum::response::{IntoResponse, Response};

use crate::error::CloudError;

/// Name, type and content of each file.
const FILES: &[(&str, &str, &str)] = &[
    ("page.css", "text/css", include_str!("../../assets/page.css")),
    ("page.js", "text/javascript", include_str!("../../assets/page.js")),
    ("htmx.min.js", "text/javascript", include_str!("../../assets/htmx.min.js")),
    ("htmx-sse.js", "text/javascript", include_str!("../../assets/htmx-sse.js")),
    ("icon.svg", "image/svg+xml", include_str!("../../assets/icon.svg")),
];

/// Returns the address of a file. It changes with each version, so that browsers may keep a file.
pub(super) fn address(name: &str) -> String {
    format!("/assets/{name}?{}", env!("CARGO_PKG_VERSION"))
}

pub(super) async fn file(Path(name): Path<String>) -> Response {
    let Some((_, kind, content)) = FILES.iter().find(|(known, _, _)| *known == name) else {
        return CloudError::missing("there is no such file", "open the start page").into_response();
    };
    let kind = format!("{kind}; charset=utf-8");
    let headers = [(header::CONTENT_TYPE, &*kind), (header::CACHE_CONTROL, "max-age=3600")];
    (headers, *content).into_response()
}

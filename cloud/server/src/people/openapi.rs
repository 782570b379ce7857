//! The description of the API for other programs: OpenAPI 3.1, from the table of requests and the
//! types of their messages.

use std::sync::LazyLock;

use axum::http::header;
use axum::response::{IntoResponse, Response};
use gleaner_protocol::vehicle_api::Problem;
use schemars::SchemaGenerator;
use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};

use super::endpoint::{Endpoint, MessageShape};
use super::endpoints;

/// Path of the schemas of types in the document.
const SCHEMAS: &str = "/components/schemas";

pub(super) async fn document() -> Response {
    static DOCUMENT: LazyLock<String> = LazyLock::new(|| describe(&endpoints()).to_string());
    ([(header::CONTENT_TYPE, "application/json")], DOCUMENT.as_str()).into_response()
}

fn describe(endpoints: &[Endpoint]) -> Value {
    let settings = SchemaSettings::draft2020_12().with(|settings| {
        settings.definitions_path = SCHEMAS.into();
        settings.meta_schema = None;
    });
    let mut generator = settings.into_generator();
    let mut paths = Map::new();
    for endpoint in endpoints {
        let operation = operation(endpoint, &mut generator);
        let path = paths.entry(endpoint.path).or_insert_with(|| json!({}));
        path[endpoint.method.as_str().to_ascii_lowercase()] = operation;
    }
    let problem = generator.subschema_for::<Problem>();
    let problem = json!({ "application/problem+json": { "schema": problem } });
    json!({
        "openapi": "3.1.0",
        "info": {
            "title": "Gleaner cloud",
            "version": env!("CARGO_PKG_VERSION"),
            "description": "The API for people of the cloud of a fleet.",
        },
        "paths": paths,
        "components": {
            "schemas": generator.take_definitions(true),
            "responses": { "Problem": { "description": "An error", "content": problem } },
            "securitySchemes": { "token": { "type": "http", "scheme": "bearer" } },
        },
    })
}

fn operation(endpoint: &Endpoint, generator: &mut SchemaGenerator) -> Value {
    let Endpoint { method, path, role, needs_login, summary, query, headers, takes, gives, .. } =
        endpoint;
    let names = path.split(['{', '}']).skip(1).step_by(2);
    let mut parameters: Vec<Value> = names
        .map(|name| {
            let schema = json!({ "type": "string" });
            json!({ "name": name, "in": "path", "required": true, "schema": schema })
        })
        .collect();
    let schema = query.map(|query| query(generator).to_value());
    let values = schema.as_ref().and_then(|it| it["properties"].as_object());
    parameters.extend(
        values
            .into_iter()
            .flatten()
            .map(|(name, schema)| json!({ "name": name, "in": "query", "schema": schema })),
    );
    parameters.extend(
        headers
            .iter()
            .map(|name| json!({ "name": name, "in": "header", "schema": { "type": "string" } })),
    );
    let mut responses = json!({ "default": { "$ref": "#/components/responses/Problem" } });
    match gives {
        Some(shape) => {
            let content = content(*shape, generator);
            responses["200"] = json!({ "description": "The answer", "content": content });
        }
        None => responses["204"] = json!({ "description": "Done" }),
    }
    if headers.contains(&"If-None-Match") {
        responses["304"] = json!({ "description": "The answer has not changed" });
    }
    let words = path.split(['/', '{', '}', '.']).filter(|word| !["", "v1"].contains(word));
    let words: Vec<_> = words.collect();
    let id = format!("{}_{}", method.as_str().to_ascii_lowercase(), words.join("_"));
    let mut operation = json!({
        "operationId": id,
        "summary": summary,
        "parameters": parameters,
        "responses": responses,
    });
    if let Some(shape) = takes {
        let content = content(*shape, generator);
        operation["requestBody"] = json!({ "required": true, "content": content });
    }
    if let Some(role) = role {
        let login = if *needs_login { ", and the token of a login" } else { "" };
        operation["description"] = json!(format!("Needs the role `{role}`{login}."));
        operation["security"] = json!([{ "token": [] }]);
    }
    operation
}

fn content(shape: MessageShape, generator: &mut SchemaGenerator) -> Value {
    let media = shape.schema.map(|schema| json!({ "schema": schema(generator) }));
    json!({ shape.kind: media.unwrap_or_else(|| json!({})) })
}

//! The description of an API for other programs: OpenAPI 3.1, from the table of its requests and
//! the types of their messages.

mod endpoint;

use gleaner_protocol::vehicle_api::Problem;
use schemars::SchemaGenerator;
use schemars::generate::SchemaSettings;
use serde_json::{Map, Value, json};

pub use endpoint::{Endpoint, MessageShape};

/// Path of the schemas of types in the document.
const SCHEMAS: &str = "/components/schemas";

/// Returns the description of an API, with all keys sorted.
pub fn describe<S>(title: &str, description: &str, endpoints: &[Endpoint<S>]) -> String {
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
    let mut document = json!({
        "openapi": "3.1.0",
        "info": {
            "title": title,
            "version": env!("CARGO_PKG_VERSION"),
            "description": description,
        },
        "paths": paths,
        "components": {
            "schemas": generator.take_definitions(true),
            "responses": { "Problem": { "description": "An error", "content": problem } },
        },
    });
    if endpoints.iter().any(|it| it.role.is_some()) {
        document["components"]["securitySchemes"] =
            json!({ "token": { "type": "http", "scheme": "bearer" } });
    }
    document.sort_all_objects();
    format!("{document:#}\n")
}

fn operation<S>(endpoint: &Endpoint<S>, generator: &mut SchemaGenerator) -> Value {
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
    let query = schema.unwrap_or_default();
    let needed = query["required"].as_array().map_or(&[][..], Vec::as_slice);
    parameters.extend(query["properties"].as_object().into_iter().flatten().map(
        |(name, schema)| {
            let required = needed.iter().any(|it| it == name);
            json!({ "name": name, "in": "query", "required": required, "schema": schema })
        },
    ));
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

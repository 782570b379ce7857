//! A request that an API answers, with all that its description has.

use axum::http::Method;
use axum::routing::MethodRouter;
use schemars::{JsonSchema, Schema, SchemaGenerator};

use crate::people::Role;

/// A request that an API answers. Its router and its description have the same list of them.
#[derive(Debug)]
pub struct Endpoint<S> {
    /// Its method, which the handler has, too.
    pub method: Method,
    /// Its path, with names in braces.
    pub path: &'static str,
    /// The least role; `None` if no token is needed.
    pub role: Option<Role>,
    /// True if tokens for programs are refused.
    pub needs_login: bool,
    pub(super) summary: &'static str,
    /// The type of its values after `?`.
    pub(super) query: Option<fn(&mut SchemaGenerator) -> Schema>,
    /// The headers that it has a use for.
    pub(super) headers: &'static [&'static str],
    pub(super) takes: Option<MessageShape>,
    /// The answer; `None` if it has no content.
    pub gives: Option<MessageShape>,
    /// The handler of its requests.
    pub handler: MethodRouter<S>,
}

/// The type of the content of a message, with its schema if it is JSON.
#[derive(Debug, Clone, Copy)]
pub struct MessageShape {
    /// The media type.
    pub kind: &'static str,
    pub(super) schema: Option<fn(&mut SchemaGenerator) -> Schema>,
}

impl MessageShape {
    fn of<T: JsonSchema>(kind: &'static str) -> Option<Self> {
        Some(Self { kind, schema: Some(SchemaGenerator::subschema_for::<T>) })
    }
}

impl<S> Endpoint<S> {
    /// Creates a request. Changes by an admin give and take access: they need a login, so that
    /// nothing which a stolen token for programs makes outlives the token.
    pub fn new(
        method: Method,
        path: &'static str,
        role: Option<Role>,
        summary: &'static str,
        handler: MethodRouter<S>,
    ) -> Self {
        let (query, takes, gives, headers): (_, _, _, &[_]) = (None, None, None, &[]);
        let needs_login = role == Some(Role::Admin) && method != Method::GET;
        Self { method, path, role, needs_login, summary, query, headers, takes, gives, handler }
    }

    /// States that it needs a login.
    pub fn needs_login(self) -> Self {
        Self { needs_login: true, ..self }
    }

    /// States the type of the values after `?`.
    pub fn query<T: JsonSchema>(self) -> Self {
        Self { query: Some(T::json_schema), ..self }
    }

    /// States headers that it has a use for.
    pub fn headers(self, headers: &'static [&'static str]) -> Self {
        Self { headers, ..self }
    }

    /// States the type of the body.
    pub fn takes<T: JsonSchema>(self) -> Self {
        Self { takes: MessageShape::of::<T>("application/json"), ..self }
    }

    /// States that the body is a file.
    pub fn takes_file(self) -> Self {
        Self {
            takes: Some(MessageShape { kind: "application/octet-stream", schema: None }),
            ..self
        }
    }

    /// States the type of the answer.
    pub fn gives<T: JsonSchema>(self) -> Self {
        Self { gives: MessageShape::of::<T>("application/json"), ..self }
    }

    /// States the type of each line of the answer.
    pub fn gives_lines<T: JsonSchema>(self) -> Self {
        Self { gives: MessageShape::of::<T>("application/x-ndjson"), ..self }
    }

    /// States that the answer is a file of this kind.
    pub fn gives_file(self, kind: &'static str) -> Self {
        Self { gives: Some(MessageShape { kind, schema: None }), ..self }
    }
}

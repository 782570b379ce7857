//! A request that the API answers, with all that its description has.

use std::sync::Arc;

use axum::http::Method;
use axum::routing::MethodRouter;
use gleaner_fleet::people::Role;
use schemars::{JsonSchema, Schema, SchemaGenerator};

use crate::cloud::Cloud;
use crate::transfer::OCTETS;

pub(crate) struct Endpoint {
    /// Its method, which the handler has, too.
    pub(crate) method: Method,
    pub(crate) path: &'static str,
    /// The least role; `None` if no token is needed.
    pub(crate) role: Option<Role>,
    /// True if tokens for programs are refused.
    pub(crate) needs_login: bool,
    pub(super) summary: &'static str,
    /// The type of its values after `?`.
    pub(super) query: Option<fn(&mut SchemaGenerator) -> Schema>,
    /// The headers that it has a use for.
    pub(super) headers: &'static [&'static str],
    pub(super) takes: Option<MessageShape>,
    /// The answer; `None` if it has no content.
    pub(super) gives: Option<MessageShape>,
    pub(super) handler: MethodRouter<Arc<Cloud>>,
}

/// The type of the content of a message, with its schema if it is JSON.
#[derive(Clone, Copy)]
pub(super) struct MessageShape {
    pub(super) kind: &'static str,
    pub(super) schema: Option<fn(&mut SchemaGenerator) -> Schema>,
}

impl MessageShape {
    fn of<T: JsonSchema>(kind: &'static str) -> Option<Self> {
        Some(Self { kind, schema: Some(SchemaGenerator::subschema_for::<T>) })
    }
}

impl Endpoint {
    /// Creates a request. Changes by an admin give and take access: they need a login, so that
    /// nothing which a stolen token for programs makes outlives the token.
    pub(super) fn new(
        method: Method,
        path: &'static str,
        role: Option<Role>,
        summary: &'static str,
        handler: MethodRouter<Arc<Cloud>>,
    ) -> Self {
        let (query, takes, gives, headers): (_, _, _, &[_]) = (None, None, None, &[]);
        let needs_login = role == Some(Role::Admin) && method != Method::GET;
        Self { method, path, role, needs_login, summary, query, headers, takes, gives, handler }
    }

    /// States that it needs a login.
    pub(super) fn needs_login(self) -> Self {
        Self { needs_login: true, ..self }
    }

    /// States the type of the values after `?`.
    pub(super) fn query<T: JsonSchema>(self) -> Self {
        Self { query: Some(T::json_schema), ..self }
    }

    /// States headers that it has a use for.
    pub(super) fn headers(self, headers: &'static [&'static str]) -> Self {
        Self { headers, ..self }
    }

    /// States the type of the body.
    pub(super) fn takes<T: JsonSchema>(self) -> Self {
        Self { takes: MessageShape::of::<T>("application/json"), ..self }
    }

    /// States that the body is a file.
    pub(super) fn takes_file(self) -> Self {
        Self { takes: Some(MessageShape { kind: OCTETS, schema: None }), ..self }
    }

    /// States the type of the answer.
    pub(super) fn gives<T: JsonSchema>(self) -> Self {
        Self { gives: MessageShape::of::<T>("application/json"), ..self }
    }

    /// States the type of each line of the answer.
    pub(super) fn gives_lines<T: JsonSchema>(self) -> Self {
        Self { gives: MessageShape::of::<T>("application/x-ndjson"), ..self }
    }

    /// States that the answer is a file of this kind.
    pub(super) fn gives_file(self, kind: &'static str) -> Self {
        Self { gives: Some(MessageShape { kind, schema: None }), ..self }
    }
}

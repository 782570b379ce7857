//! Errors after which the process cannot go on.

use std::io;

use crate::running::ModelWork;

#[derive(Debug, thiserror::Error)]
pub(crate) enum EngineError {
    #[error(
        "model `{}` of lambda {} has run for more than {} s", .0.path, quoted(&.0.lambdas),
        .0.limit.as_secs_f64()
    )]
    Overdue(ModelWork),
    #[error("a thread of this process has ended")]
    Thread,
    #[error("cannot wait for lambdas")]
    Wait(#[source] io::Error),
}

/// Names of lambdas, for messages.
pub(crate) fn quoted(lambdas: &[String]) -> String {
    let quoted: Vec<String> = lambdas.iter().map(|name| format!("`{name}`")).collect();
    quoted.join(", ")
}

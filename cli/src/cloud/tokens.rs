//! `gleaner tokens`: tokens for programs, with at most the rights of their user.

use gleaner_base::{Exit, Failure, visible};
use gleaner_fleet::people::{NewToken, TokenSummary, User, UserToken};
use serde_json::json;

use super::{client, date, list, show};
use crate::args::{TokensArgs, TokensCommand};
use crate::render::table;

pub(super) fn tokens(args: &TokensArgs) -> Result<Exit, Failure> {
    let client = client()?;
    match &args.command {
        None => {
            show(args.json, &list::all::<TokenSummary>(&client, "/v1/tokens", &[])?, |tokens| {
                let rows = tokens.iter().map(|it| {
                    [visible(&it.user), visible(&it.name), it.role.to_string(), date(it.expires)]
                });
                table(&["user", "token", "role", "until"], rows, &[])
            })
        }
        Some(TokensCommand::New(new)) => {
            let request = NewToken { name: new.name.clone(), role: new.role, days: new.days };
            let made: UserToken = client.create("/v1/tokens", &request)?;
            show(args.json, &made, |UserToken { user, token, expires }| {
                let (until, token) = (date(*expires), visible(token));
                format!(
                    "created token {} ({}; expires {until}). It is not shown again:\n  {token}\n",
                    new.name, user.role
                )
            })
        }
        Some(TokensCommand::Remove(token)) => {
            let of = match &token.user {
                Some(user) => user.clone(),
                None => client.get::<User>("/v1/me")?.name,
            };
            client.delete(&format!("/v1/tokens/{of}/{}", token.name))?;
            let removed = json!({ "user": of, "name": token.name, "removed": true });
            show(args.json, &removed, |_| format!("removed {}\n", token.name))
        }
    }
}

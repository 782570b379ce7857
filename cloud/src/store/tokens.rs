//! Tokens of users: those of logins, and named ones for programs, with at most the rights of their
//! user.

use gleaner_base::excerpt;
use gleaner_fleet::people::{NewToken, Role, TOKEN_DAYS_MAX, TokenSummary, User, UserToken};

use super::secrets::SecretKind;
use super::users::user;
use super::{ChangeAuthor, CloudStore, now, unsigned};
use crate::error::{CloudError, CloudResult};

pub(crate) const TOKENS_MAX: i64 = 50;

/// A user with a token, and the rights of that token.
#[derive(Debug, Clone)]
pub(crate) struct TokenUser {
    /// The user, with the role of the token if that is less.
    pub(crate) user: User,
    /// Name of the token; empty for that of a login.
    pub(crate) name: String,
    /// Name in the audit trail. No name of a user has a parenthesis.
    pub(crate) actor: String,
}

impl TokenUser {
    /// Returns a user with a token of this name, or with a login or session without one.
    pub(crate) fn new(user: User, name: String) -> Self {
        let actor = match name.is_empty() {
            true => user.name.clone(),
            false => format!("{} (token {name})", user.name),
        };
        Self { user, name, actor }
    }
}

impl CloudStore {
    pub(crate) async fn user(&self, token: &str) -> CloudResult<Option<TokenUser>> {
        let row = self.user_row(SecretKind::TOKEN, token).await?;
        let Some((name, role, secret, most)) = row else { return Ok(None) };
        let mut user = user((name, role))?;
        if !secret.is_empty() {
            user.role = user.role.min(role_of(&most)?);
        }
        Ok(Some(TokenUser::new(user, secret)))
    }

    pub(crate) async fn make_token(
        &self,
        (user, author): (&User, ChangeAuthor<'_>),
        new: NewToken,
    ) -> CloudResult<UserToken> {
        let NewToken { name, role, days } = new;
        let allowed = |c: char| c.is_ascii_alphanumeric() || "._-".contains(c);
        if !(1..=64).contains(&name.len()) || !name.chars().all(allowed) || name.starts_with('.') {
            let message = format!("`{}` cannot be the name of a token", excerpt(&name));
            let help =
                "use 1 to 64 letters, digits and `._-`, with no dot first, as in nightly-export";
            return Err(CloudError::usage(message, help));
        }
        if !(1..=TOKEN_DAYS_MAX).contains(&days) {
            let message = format!("a token cannot be valid for {days} days");
            let help = format!("choose 1 to {TOKEN_DAYS_MAX} days");
            return Err(CloudError::usage(message, &help));
        }
        if role > user.role {
            let message = format!("user `{}` has the role {}, not {role}", user.name, user.role);
            return Err(CloudError::denied(message, "choose your own role, or a lesser one"));
        }
        let mut change = self.change().await?;
        change.begin_request(author).await?;
        run!(change; "DELETE FROM secrets WHERE expires <= $1"; now());
        let (count, same): (i64, i64) = one!(change;
            "SELECT COUNT(*), COUNT(CASE WHEN name = $2 THEN 1 END)
             FROM secrets WHERE kind = 'token' AND subject = $1 AND name <> ''"; &user.name, &name);
        if same > 0 {
            let message = format!("you have a token `{name}` already");
            return Err(CloudError::usage(message, "choose another name, or remove that token"));
        }
        if count >= TOKENS_MAX {
            let message = format!("you have {count} tokens already");
            return Err(CloudError::usage(message, "remove one that you no longer need"));
        }
        let rights = (role.as_str(), i64::from(days) * 86_400);
        let (token, expires) =
            change.add_named_secret(SecretKind::TOKEN, &user.name, &name, rights).await?;
        let subject = format!("{}/{name}", user.name);
        change.commit_noted(&user.name, &format!("make token as {role}"), &subject).await?;
        let user = User { name: user.name.clone(), role };
        Ok(UserToken { user, token, expires: unsigned(expires) })
    }

    /// Returns the named tokens of a user, or of all, after this `USER/NAME`, at most `most`.
    pub(crate) async fn tokens(
        &self,
        of: Option<&str>,
        after: &str,
        most: u64,
    ) -> CloudResult<Vec<TokenSummary>> {
        let rows: Vec<(String, String, String, u64)> = rows!(self;
            "SELECT subject, name, role, expires FROM secrets WHERE kind = 'token' AND name <> ''
             AND expires > $1 AND ($2 = '' OR subject = $2) AND subject || '/' || name > $3
             ORDER BY subject || '/' || name LIMIT $4"; now(), of.unwrap_or_default(), after, most);
        let summary = |(user, name, role, expires): (_, _, String, _)| {
            Ok(TokenSummary { user, name, role: role_of(&role)?, expires })
        };
        rows.into_iter().map(summary).collect()
    }

    pub(crate) async fn remove_token(&self, actor: &str, of: &str, name: &str) -> CloudResult<()> {
        let mut change = self.change().await?;
        let removed = run!(change; "DELETE FROM secrets
             WHERE kind = 'token' AND subject = $1 AND name = $2 AND name <> ''"; of, name);
        let subject = format!("{of}/{name}");
        if removed.rows_affected() == 0 {
            let message = format!("there is no token `{}`", excerpt(&subject));
            let help = "list the tokens, and use one of their names";
            return Err(CloudError::missing(message, help));
        }
        change.commit_noted(actor, "remove token", &subject).await
    }

    pub(crate) async fn end_token(&self, actor: &str, token: &str) -> CloudResult<()> {
        let mut change = self.change().await?;
        if let Some(user) = change.take_secret(SecretKind::TOKEN, token).await? {
            change.note(actor, "logout", &user).await?;
        }
        change.commit().await
    }
}

fn role_of(text: &str) -> CloudResult<Role> {
    text.parse().map_err(|error: String| {
        CloudError::denied("the role of a token is damaged", "make another token").because(error)
    })
}

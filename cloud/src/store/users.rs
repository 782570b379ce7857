//! Users, their invitations and their tokens.

use gleaner_base::excerpt;
use gleaner_fleet::people::{Invitation, NewUser, Role, User, UserToken};

use super::secrets::SecretKind;
use super::{ChangeAuthor, CloudStore, now, unsigned};
use crate::error::{CloudError, CloudResult};

/// Actor of changes that the program itself makes, for a person at its machine.
pub(crate) const CONSOLE: &str = "console";

const ADMIN: &str = "admin";

impl CloudStore {
    /// Adds a user, or invites one again with this role: codes before it do not work any more.
    pub(crate) async fn invite(
        &self,
        author: impl Into<ChangeAuthor<'_>>,
        new: NewUser,
    ) -> CloudResult<Invitation> {
        let author = author.into();
        let NewUser { name, role } = new;
        let allowed = |c: char| c.is_ascii_alphanumeric() || "._-@+".contains(c);
        if !(1..=64).contains(&name.len())
            || !name.chars().all(allowed)
            || name.starts_with('.')
            || name == CONSOLE
        {
            let message = format!("`{}` cannot be the name of a user", excerpt(&name));
            let help = "use 1 to 64 letters, digits and `._-@+`, as in ann-lee; not `console`";
            return Err(CloudError::usage(message, help));
        }
        let mut change = self.change().await?;
        change.begin_request(author).await?;
        run!(change; "INSERT INTO users (name, role) VALUES ($1, $2)
             ON CONFLICT (name) DO UPDATE SET role = excluded.role"; &name, role.as_str());
        change.drop_secrets(SecretKind::CODE, &name, "").await?;
        let (code, expires) = change.add_secret(SecretKind::CODE, &name).await?;
        change.commit_noted(author.name, &format!("invite as {role}"), &name).await?;
        Ok(Invitation { user: User { name, role }, code, expires: unsigned(expires) })
    }

    /// Invites an administrator, unless one has a valid token or a password.
    pub(crate) async fn invite_first(&self) -> CloudResult<Option<Invitation>> {
        let able: i64 = one!(self; "SELECT COUNT(*) FROM users WHERE role = 'admin'
             AND (password <> '' OR EXISTS (SELECT 1 FROM secrets WHERE secrets.subject = users.name
             AND secrets.kind = 'token' AND secrets.name = '' AND secrets.expires > $1))"; now());
        if able > 0 {
            return Ok(None);
        }
        let admin = NewUser { name: ADMIN.to_owned(), role: Role::Admin };
        self.invite(CONSOLE, admin).await.map(Some)
    }

    /// Exchanges a code for a token; `None` if the code is wrong, used or too old.
    pub(crate) async fn login(&self, code: &str) -> CloudResult<Option<UserToken>> {
        let mut change = self.change().await?;
        let Some(name) = change.take_secret(SecretKind::CODE, code).await? else { return Ok(None) };
        let role: String = one!(change; "SELECT role FROM users WHERE name = $1"; &name);
        let (token, expires) = change.add_secret(SecretKind::TOKEN, &name).await?;
        change.commit_noted(&name, "login", &name).await?;
        Ok(Some(UserToken { user: user((name, role))?, token, expires: unsigned(expires) }))
    }

    /// Exchanges a code for a session of the page; returns the session and the user's name. `None`
    /// if the code is wrong, used or too old.
    pub(crate) async fn open_session(&self, code: &str) -> CloudResult<Option<(String, String)>> {
        let mut change = self.change().await?;
        let Some(name) = change.take_secret(SecretKind::CODE, code).await? else { return Ok(None) };
        let (session, _) = change.add_secret(SecretKind::SESSION, &name).await?;
        change.commit_noted(&name, "login", &name).await?;
        Ok(Some((session, name)))
    }

    /// Opens a session for a user whose password was right, unless it has changed meanwhile.
    pub(crate) async fn open_session_of(
        &self,
        name: &str,
        password: &str,
    ) -> CloudResult<Option<String>> {
        let mut change = self.change().await?;
        let stored: Option<String> =
            row!(change; "SELECT password FROM users WHERE name = $1"; name);
        if stored.is_none_or(|stored| stored != password) {
            return Ok(None);
        }
        let (session, _) = change.add_secret(SecretKind::SESSION, name).await?;
        change.commit_noted(name, "login by password", name).await?;
        Ok(Some(session))
    }

    pub(crate) async fn session(&self, session: &str) -> CloudResult<Option<User>> {
        let row = self.user_row(SecretKind::SESSION, session).await?;
        row.map(|(name, role, ..)| user((name, role))).transpose()
    }

    pub(crate) async fn close_session(&self, session: &str) -> CloudResult<()> {
        let mut change = self.change().await?;
        change.take_secret(SecretKind::SESSION, session).await?;
        change.commit().await
    }

    pub(crate) async fn password(&self, name: &str) -> CloudResult<Option<String>> {
        let password: Option<String> =
            row!(self; "SELECT password FROM users WHERE name = $1"; name);
        Ok(password.filter(|it| !it.is_empty()))
    }

    /// Sets the hash of a user's password, and ends the user's other sessions than `session`.
    pub(crate) async fn set_password(
        &self,
        name: &str,
        password: &str,
        session: &str,
    ) -> CloudResult<()> {
        let mut change = self.change().await?;
        run!(change; "UPDATE users SET password = $2 WHERE name = $1"; name, password);
        change.drop_secrets(SecretKind::SESSION, name, session).await?;
        change.commit_noted(name, "set password", name).await
    }

    pub(crate) async fn users(&self, after: &str, most: u64) -> CloudResult<Vec<User>> {
        let rows: Vec<_> = rows!(self;
            "SELECT name, role FROM users WHERE name > $1 ORDER BY name LIMIT $2"; after, most);
        rows.into_iter().map(user).collect()
    }

    /// Removes a user, and the tokens and sessions of the user.
    pub(crate) async fn remove_user(&self, actor: &str, name: &str) -> CloudResult<()> {
        let mut change = self.change().await?;
        let removed = run!(change; "DELETE FROM users WHERE name = $1"; name);
        if removed.rows_affected() == 0 {
            let message = format!("there is no user `{}`", excerpt(name));
            return Err(CloudError::missing(message, "list the users, and use one of their names"));
        }
        for kind in [SecretKind::CODE, SecretKind::TOKEN, SecretKind::SESSION] {
            change.drop_secrets(kind, name, "").await?;
        }
        run!(change; "DELETE FROM request_keys WHERE actor = $1"; name);
        change.commit_noted(actor, "remove user", name).await
    }
}

pub(super) fn user((name, role): (String, String)) -> CloudResult<User> {
    let role = role.parse().map_err(|error: String| {
        CloudError::denied(format!("the role of user `{name}` is damaged"), "invite the user again")
            .because(error)
    })?;
    Ok(User { name, role })
}

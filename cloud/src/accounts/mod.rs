//! Users and their secrets: passwords, sessions, and tokens of logins and for programs.

mod password;

use std::sync::Arc;

use gleaner_base::excerpt;
use gleaner_fleet::listener::ClientNetwork;
use gleaner_fleet::people::{NewToken, Role, User, UserToken};

use crate::attempts::{AccountChanges, WrongSecrets};
use crate::error::{CloudError, CloudResult};
use crate::readers::Readers;
use crate::store::{ChangeAuthor, CloudStore, TokenUser};

/// The way out for a token for programs that is refused.
pub(crate) const LOGIN: &str = "use the token of a login: `gleaner login`";

pub(crate) struct Accounts {
    store: Arc<CloudStore>,
    /// Streams, which end with the right to read them.
    readers: Arc<Readers>,
    pub(crate) wrong_secrets: WrongSecrets,
    changes: AccountChanges,
}

impl Accounts {
    pub(crate) fn new(store: &Arc<CloudStore>, readers: &Arc<Readers>) -> Self {
        Self {
            store: Arc::clone(store),
            readers: Arc::clone(readers),
            wrong_secrets: WrongSecrets::default(),
            changes: AccountChanges::default(),
        }
    }

    pub(crate) async fn remove_user(&self, actor: &str, name: &str) -> CloudResult<()> {
        self.store.remove_user(actor, name).await?;
        self.readers.end(name);
        Ok(())
    }

    pub(crate) async fn make_token(
        &self,
        user: &User,
        author: ChangeAuthor<'_>,
        new: NewToken,
    ) -> CloudResult<UserToken> {
        self.changes.count(&user.name)?;
        self.store.make_token((user, author), new).await
    }

    /// Removes a token of the user `of`. One for programs removes itself only.
    pub(crate) async fn remove_token(
        &self,
        TokenUser { user, name: own, actor }: &TokenUser,
        of: &str,
        name: &str,
    ) -> CloudResult<()> {
        if !own.is_empty() && (of, name) != (&*user.name, own) {
            let message = format!("token `{own}` removes no tokens but itself");
            return Err(CloudError::denied(message, LOGIN));
        }
        if of != user.name && user.role < Role::Admin {
            let message = format!("you have no token `{}/{}`", excerpt(of), excerpt(name));
            let help = "remove one of your own, or let an administrator remove it";
            return Err(CloudError::missing(message, help));
        }
        self.store.remove_token(actor, of, name).await?;
        self.readers.end(of);
        Ok(())
    }

    /// Ends the token of a login, or one for programs, of its user.
    pub(crate) async fn end_token(&self, by: &TokenUser, token: &str) -> CloudResult<()> {
        self.store.end_token(&by.actor, token).await?;
        self.readers.end(&by.user.name);
        Ok(())
    }

    /// Returns the hash of a new password of a user.
    pub(crate) async fn hashed(&self, user: &str, password: &str) -> CloudResult<String> {
        self.changes.count(user)?;
        password::hashed(password.to_owned()).await
    }

    /// Opens a session for a user with this name and password.
    pub(crate) async fn open_session(
        &self,
        network: ClientNetwork,
        (name, password): (&str, &str),
    ) -> CloudResult<String> {
        self.wrong_secrets.count_password(network, name)?;
        let hash = self.store.password(name).await?;
        let is_right = password::is_right(network, password.to_owned(), hash.as_deref()).await?;
        let session = match hash.filter(|_| is_right) {
            Some(hash) => {
                self.changes.count(name)?;
                self.store.open_session_of(name, &hash).await?
            }
            None => None,
        };
        let help = "without a password, log in by a code that an administrator gives you";
        self.wrong_secrets.check(network, session, "the name or the password is wrong", help)
    }
}

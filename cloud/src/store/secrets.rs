//! Secrets: stored as their SHA-256, found by it, and valid for a while. With 256 random bits, a
//! plain hash cannot be searched.

use super::{CloudStore, DAY_S, StoreChange, now};
use crate::error::{CloudError, CloudResult};

/// A kind of secrets: its name, the start of its text, by which tools find secrets in files, and
/// its lifetime in s.
#[derive(Debug, Clone, Copy)]
pub(super) struct SecretKind(&'static str, &'static str, i64);

impl SecretKind {
    /// One-time code of a user.
    pub(super) const CODE: Self = Self("code", "glc_", DAY_S);
    /// Token of a user.
    pub(super) const TOKEN: Self = Self("token", "gln_", 90 * DAY_S);
    /// Session of a user of the page.
    pub(super) const SESSION: Self = Self("session", "gls_", DAY_S / 2);
    /// One-time token of a vehicle.
    pub(super) const ENROLMENT: Self = Self("enrolment", "gle_", DAY_S);
}

impl StoreChange<'_> {
    /// Makes a secret of `subject`; returns it, and its end.
    pub(super) async fn add_secret(
        &mut self,
        kind: SecretKind,
        subject: &str,
    ) -> CloudResult<(String, i64)> {
        self.add_named_secret(kind, subject, "", ("", kind.2)).await
    }

    /// Makes a secret of `subject` with a name, a role and a lifetime in s.
    pub(super) async fn add_named_secret(
        &mut self,
        kind: SecretKind,
        subject: &str,
        name: &str,
        (role, lifetime_s): (&str, i64),
    ) -> CloudResult<(String, i64)> {
        let mut bytes = [0; 32];
        getrandom::fill(&mut bytes).map_err(|error| {
            CloudError::busy("no secret can be made", "try again").because(error)
        })?;
        let secret = format!("{}{}", kind.1, gleaner_base::hex(&bytes));
        let expires = now() + lifetime_s;
        run!(self; "DELETE FROM secrets WHERE expires <= $1"; now());
        run!(self; "INSERT INTO secrets (hash, kind, subject, expires, name, role)
             VALUES ($1, $2, $3, $4, $5, $6)"; hash(&secret), kind.0, subject, expires, name, role);
        Ok((secret, expires))
    }

    /// Removes a valid secret; returns its subject.
    pub(super) async fn take_secret(
        &mut self,
        kind: SecretKind,
        secret: &str,
    ) -> CloudResult<Option<String>> {
        Ok(row!(self; "DELETE FROM secrets WHERE hash = $1 AND kind = $2 AND expires > $3 RETURNING
             subject"; hash(secret), kind.0, now()))
    }

    pub(super) async fn drop_secrets(
        &mut self,
        kind: SecretKind,
        subject: &str,
        kept: &str,
    ) -> CloudResult<()> {
        run!(self; "DELETE FROM secrets WHERE kind = $1 AND subject = $2 AND hash <> $3";
            kind.0, subject, hash(kept));
        Ok(())
    }
}

impl CloudStore {
    /// Returns the name and the role of a user with a secret, and those of the secret, which are
    /// empty for most.
    pub(super) async fn user_row(
        &self,
        kind: SecretKind,
        secret: &str,
    ) -> CloudResult<Option<(String, String, String, String)>> {
        Ok(row!(self;
            "SELECT users.name, users.role, secrets.name, secrets.role
             FROM secrets JOIN users ON users.name = secrets.subject
             WHERE hash = $1 AND kind = $2 AND expires > $3"; hash(secret), kind.0, now()))
    }
}

fn hash(secret: &str) -> String {
    gleaner_trust::sha256(secret.as_bytes()).to_string()
}

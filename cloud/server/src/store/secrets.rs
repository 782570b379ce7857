//! Secrets: stored as their SHA-256, found by it, and valid for a while. With 256 random bits, a
//! plain hash cannot be searched.

use super::{CloudStore, DAY_S, StoreChange, now};
use crate::error::{CloudError, CloudResult};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum SecretKind {
    /// One-time code of a user.
    Code,
    /// Token of a user.
    Token,
    /// Session of a user of the page.
    Session,
    /// One-time token of a vehicle.
    Enrolment,
}

impl SecretKind {
    fn as_str(self) -> &'static str {
        match self {
            SecretKind::Code => "code",
            SecretKind::Token => "token",
            SecretKind::Session => "session",
            SecretKind::Enrolment => "enrolment",
        }
    }

    /// Returns the start of its text, by which tools find secrets in files.
    fn prefix(self) -> &'static str {
        match self {
            SecretKind::Code => "glc_",
            SecretKind::Token => "gln_",
            SecretKind::Session => "gls_",
            SecretKind::Enrolment => "gle_",
        }
    }

    fn lifetime_s(self) -> i64 {
        match self {
            SecretKind::Code | SecretKind::Enrolment => DAY_S,
            SecretKind::Session => DAY_S / 2,
            SecretKind::Token => 90 * DAY_S,
        }
    }
}

impl StoreChange<'_> {
    /// Makes a secret of `subject`; returns it, and its end.
    pub(super) async fn add_secret(
        &mut self,
        kind: SecretKind,
        subject: &str,
    ) -> CloudResult<(String, i64)> {
        self.add_named_secret(kind, subject, "", ("", kind.lifetime_s())).await
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
        let secret = format!("{}{}", kind.prefix(), gleaner_base::hex(&bytes));
        let expires = now() + lifetime_s;
        run!(&mut *self.tx; "DELETE FROM secrets WHERE expires <= $1"; now());
        run!(&mut *self.tx;
            "INSERT INTO secrets (hash, kind, subject, expires, name, role)
             VALUES ($1, $2, $3, $4, $5, $6)";
            hash(&secret), kind.as_str(), subject, expires, name, role);
        Ok((secret, expires))
    }

    /// Removes a valid secret; returns its subject.
    pub(super) async fn take_secret(
        &mut self,
        kind: SecretKind,
        secret: &str,
    ) -> CloudResult<Option<String>> {
        let subject: Option<(String,)> = row!(&mut *self.tx;
            "DELETE FROM secrets WHERE hash = $1 AND kind = $2 AND expires > $3
             RETURNING subject";
            hash(secret), kind.as_str(), now());
        Ok(subject.map(|(subject,)| subject))
    }

    pub(super) async fn drop_other_secrets(
        &mut self,
        kind: SecretKind,
        subject: &str,
        kept: &str,
    ) -> CloudResult<()> {
        run!(&mut *self.tx;
            "DELETE FROM secrets WHERE kind = $1 AND subject = $2 AND hash <> $3";
            kind.as_str(), subject, hash(kept));
        Ok(())
    }

    pub(super) async fn drop_secrets(
        &mut self,
        kind: SecretKind,
        subject: &str,
    ) -> CloudResult<()> {
        self.drop_other_secrets(kind, subject, "").await
    }
}

impl CloudStore {
    /// Returns the name and the role of the user with this secret, and the name and the role that
    /// the secret itself has, which are empty for most.
    pub(super) async fn user_row(
        &self,
        kind: SecretKind,
        secret: &str,
    ) -> CloudResult<Option<(String, String, String, String)>> {
        Ok(row!(&self.pool;
            "SELECT users.name, users.role, secrets.name, secrets.role FROM secrets
             JOIN users ON users.name = secrets.subject
             WHERE secrets.hash = $1 AND secrets.kind = $2 AND secrets.expires > $3";
            hash(secret), kind.as_str(), now()))
    }
}

fn hash(secret: &str) -> String {
    gleaner_trust::sha256(secret.as_bytes()).to_string()
}

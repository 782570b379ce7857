//! The audit trail: who changed what. Each entry has a hash over the one before it, so that a
//! changed or removed entry is detected.

use gleaner_fleet::people::AuditEntry;

use super::{CloudStore, StoreChange, now_ms};
use crate::error::CloudResult;

const CHECKED: i64 = 1000;

columns!(AuditEntry: seq, time_ms, actor, action, subject, hash);

impl StoreChange<'_> {
    /// Adds an entry; returns its number.
    pub(crate) async fn note(
        &mut self,
        actor: &str,
        action: &str,
        subject: &str,
    ) -> CloudResult<u64> {
        let last: Option<(u64, String)> =
            row!(self; "SELECT seq, hash FROM audit ORDER BY seq DESC LIMIT 1");
        let (seq, before) = last.map_or((1, String::new()), |(seq, hash)| (seq + 1, hash));
        let time_ms = now_ms();
        let hash = hash(&before, seq, time_ms, [actor, action, subject]);
        run!(self; "INSERT INTO audit (seq, time_ms, actor, action, subject, hash)
             VALUES ($1, $2, $3, $4, $5, $6)"; seq, time_ms, actor, action, subject, hash);
        Ok(seq)
    }

    /// Commits the change, with its entry.
    pub(super) async fn commit_noted(
        mut self,
        actor: &str,
        action: &str,
        subject: &str,
    ) -> CloudResult<()> {
        self.note(actor, action, subject).await?;
        self.commit().await
    }
}

impl CloudStore {
    /// Returns the newest entries before the one of this number, the newest first: at most `most`.
    pub(crate) async fn audit(&self, before: u64, most: u64) -> CloudResult<Vec<AuditEntry>> {
        Ok(rows!(self; "SELECT seq, time_ms, actor, action, subject, hash FROM audit WHERE seq < $1
             ORDER BY seq DESC LIMIT $2"; before, most))
    }

    /// Returns the number of the first entry that is not as it was written, or is missing.
    pub(crate) async fn first_changed_entry(&self) -> CloudResult<Option<u64>> {
        let (mut before, mut next) = (String::new(), 1);
        loop {
            let rows: Vec<AuditEntry> = rows!(self; "SELECT seq, time_ms, actor, action,
                 subject, hash FROM audit WHERE seq >= $1 ORDER BY seq LIMIT $2"; next, CHECKED);
            if rows.is_empty() {
                return Ok(None);
            }
            for it in rows {
                before = hash(&before, next, it.time_ms, [&it.actor, &it.action, &it.subject]);
                if it.seq != next || before != it.hash {
                    return Ok(Some(next));
                }
                next += 1;
            }
        }
    }

    #[cfg(test)]
    pub(crate) async fn execute(&self, sql: &'static str) {
        crate::sqlx::raw_sql(sql).execute(&self.pool).await.unwrap();
    }

    #[cfg(test)]
    pub(crate) async fn execute_with(&self, sql: &'static str, values: &[&str]) {
        let query = crate::sqlx::query(sql);
        let query = values.iter().fold(query, |query, value| query.bind(*value));
        query.execute(&self.pool).await.unwrap();
    }
}

fn hash(before: &str, seq: u64, time_ms: i64, texts: [&str; 3]) -> String {
    // As JSON, the ends of the texts cannot be moved.
    let entry = serde_json::json!([before, seq, time_ms, texts]).to_string();
    gleaner_trust::sha256(entry.as_bytes()).to_string()
}

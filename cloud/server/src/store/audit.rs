//! The audit trail: who changed what. Each entry has a hash over the one before it, so that a
//! changed or removed entry is detected.

use gleaner_fleet::people::AuditEntry;

use super::{CloudStore, StoreChange, int, now_ms, unsigned};
use crate::error::CloudResult;

/// Number of entries that are checked at a time.
const CHECKED: i64 = 1000;

type Row = (i64, i64, String, String, String, String);

impl StoreChange<'_> {
    /// Adds an entry; returns its number.
    pub(crate) async fn note(
        &mut self,
        actor: &str,
        action: &str,
        subject: &str,
    ) -> CloudResult<u64> {
        let last: Option<(i64, String)> =
            row!(&mut *self.tx; "SELECT seq, hash FROM audit ORDER BY seq DESC LIMIT 1");
        let (seq, before) = last.map_or((1, String::new()), |(seq, hash)| (seq + 1, hash));
        let time_ms = now_ms();
        let hash = hash(&before, seq, time_ms, [actor, action, subject]);
        run!(&mut *self.tx;
            "INSERT INTO audit (seq, time_ms, actor, action, subject, hash)
             VALUES ($1, $2, $3, $4, $5, $6)";
            seq, time_ms, actor, action, subject, hash);
        Ok(unsigned(seq))
    }
}

impl CloudStore {
    /// Returns the newest entries before the one of this number, the newest first: at most `most`.
    pub(crate) async fn audit(&self, before: u64, most: u64) -> CloudResult<Vec<AuditEntry>> {
        let rows: Vec<Row> = rows!(&self.pool;
            "SELECT seq, time_ms, actor, action, subject, hash FROM audit
             WHERE seq < $1 ORDER BY seq DESC LIMIT $2";
            int(before), int(most));
        let entry = |(seq, time_ms, actor, action, subject, hash)| AuditEntry {
            seq: unsigned(seq),
            time_ms,
            actor,
            action,
            subject,
            hash,
        };
        Ok(rows.into_iter().map(entry).collect())
    }

    /// Returns the number of the first entry that is not as it was written, or is missing.
    pub(crate) async fn first_changed_entry(&self) -> CloudResult<Option<u64>> {
        let (mut before, mut next) = (String::new(), 1);
        loop {
            let rows: Vec<Row> = rows!(&self.pool;
                "SELECT seq, time_ms, actor, action, subject, hash FROM audit
                 WHERE seq >= $1 ORDER BY seq LIMIT $2";
                next, CHECKED);
            if rows.is_empty() {
                return Ok(None);
            }
            for (seq, time_ms, actor, action, subject, stored) in rows {
                before = hash(&before, next, time_ms, [&actor, &action, &subject]);
                if seq != next || before != stored {
                    return Ok(Some(unsigned(next)));
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
        let mut query = crate::sqlx::query(sql);
        for value in values {
            query = query.bind((*value).to_owned());
        }
        query.execute(&self.pool).await.unwrap();
    }
}

fn hash(before: &str, seq: i64, time_ms: i64, texts: [&str; 3]) -> String {
    // As JSON, the ends of the texts cannot be moved.
    let entry = serde_json::json!([before, int(unsigned(seq)), time_ms, texts]).to_string();
    gleaner_trust::sha256(entry.as_bytes()).to_string()
}

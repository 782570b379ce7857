//! Lists of a cloud, which come in parts.

use std::time::Duration;

use gleaner_base::{ByteSize, Exit, Failure, nanoseconds};
use gleaner_fleet::people::ListPage;
use serde::de::DeserializeOwned;

use crate::since_1970;
use crate::vehicle::VehicleClient;

/// Maximum number of entries in a part, and their number without another choice.
const PART: usize = 500;
/// Maximum number of entries of a whole list: a cloud has room for fewer vehicles and deployments.
const ENTRIES_MAX: usize = 100_000;
/// Maximum length of all parts of a list: one is kept in memory.
const BYTES_MAX: ByteSize = ByteSize::mib(512);

/// Returns all entries of a list.
///
/// # Errors
///
/// A failure if it has no end, or more entries than fit.
pub(super) fn all<T: DeserializeOwned>(
    client: &VehicleClient,
    path: &str,
    query: &[(&str, String)],
) -> Result<Vec<T>, Failure> {
    let entries = first(client, path, query, ENTRIES_MAX + 1)?;
    match entries.len() > ENTRIES_MAX {
        true => Err(endless(path, &format!("it has more than {ENTRIES_MAX} entries"))),
        false => Ok(entries),
    }
}

/// Returns the first entries of a list, at most `most`.
///
/// # Errors
///
/// A failure if the list goes on after a part that is not full: such parts might never end.
pub(super) fn first<T: DeserializeOwned>(
    client: &VehicleClient,
    path: &str,
    query: &[(&str, String)],
    most: usize,
) -> Result<Vec<T>, Failure> {
    let (mut entries, mut after, mut bytes) = (Vec::new(), None, 0);
    while entries.len() < most {
        let limit = PART.min(most - entries.len());
        let limits = (limit < PART).then(|| ("limit", limit.to_string()));
        let position = after.take().map(|after: String| ("after", after));
        let own = query.iter().cloned().chain(limits).chain(position);
        let (part, length): (ListPage<T>, _) = client.get_sized(&with_query(path, own))?;
        bytes += length as u64;
        if bytes > BYTES_MAX.bytes() {
            return Err(endless(path, &format!("it has more than {BYTES_MAX}")));
        }
        let is_full = part.items.len() >= limit;
        entries.extend(part.items);
        match part.next {
            None => break,
            Some(_) if !is_full => {
                return Err(endless(path, "it goes on after a part that is not full"));
            }
            next => after = next,
        }
    }
    entries.truncate(most);
    Ok(entries)
}

fn endless(path: &str, cause: &str) -> Failure {
    let failure = Failure::new(Exit::Internal, format!("the list `{path}` does not end"));
    Failure { causes: vec![cause.to_owned()], ..failure }
        .with_help("choose fewer with the options of the command, or check the cloud")
}

pub(super) fn with_query<'k>(
    path: &str,
    query: impl IntoIterator<Item = (&'k str, String)>,
) -> String {
    let query = query.into_iter().map(|(key, it)| format!("{key}={}", escaped(&it)));
    let query = query.collect::<Vec<_>>().join("&");
    if query.is_empty() { path.to_owned() } else { format!("{path}?{query}") }
}

/// Returns the time so long before now, in ns since 1970, as a value of a query.
pub(super) fn since(before: Duration) -> String {
    nanoseconds(since_1970().saturating_sub(before)).to_string()
}

fn escaped(text: &str) -> String {
    let escape = |byte: u8| match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' | b'-' | b'.' | b'_' => char::from(byte).into(),
        _ => format!("%{byte:02X}"),
    };
    text.bytes().map(escape).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_value_of_a_query_cannot_end_it() {
        assert_eq!(escaped("a-1.b_C"), "a-1.b_C");
        assert_eq!(escaped("x&y=ä z"), "x%26y%3D%C3%A4%20z");
    }
}

//! Generates files of the checkout, or parts of them, from the manifest's types and the table of
//! limits. `cargo xtask bless` writes them, and a test compares them, so that no number is written
//! twice by hand.

use std::fmt::Write;

use super::limit::Limit;
use super::{Limits, reference};
use gleaner_base::grouped;

/// A file that is generated from this crate.
#[derive(Debug, Clone, Copy)]
pub struct Generated {
    /// Path of the file in the checkout.
    pub path: &'static str,
    text: fn(&str) -> Result<String, String>,
}

pub const GENERATED: &[Generated] = &[
    Generated { path: "docs/manifest.md", text: |_| Ok(reference()) },
    Generated { path: "docs/limits.md", text: page },
    Generated { path: "guest-sdk-rust/src/testing/limits.rs", text: |_| Ok(for_rust()) },
    Generated { path: "guest-sdk-python/gleaner/testing/_limits.py", text: |_| Ok(for_python()) },
];

impl Generated {
    /// Returns the expected text of the file. `now` is its present text, whose handwritten parts
    /// are kept.
    ///
    /// # Errors
    ///
    /// A message with the part that has to be written by hand first.
    pub fn text(&self, now: &str) -> Result<String, String> {
        (self.text)(now).map_err(|why| format!("{}: {why}", self.path))
    }
}

const BEGIN: &str = "<!-- `cargo xtask bless` writes the columns default and maximum -->";
const END: &str = "<!-- end of what it writes -->";

/// Generates the page on limits: defaults and maxima of the table; all else is handwritten.
fn page(now: &str) -> Result<String, String> {
    let outside = || format!("the table must be between `{BEGIN}` and `{END}`");
    let (before, rest) = now.split_once(BEGIN).ok_or_else(outside)?;
    let (table, after) = rest.split_once(END).ok_or_else(outside)?;
    let mut missing: Vec<Limit> = Limits::table().into();
    let mut text = String::new();
    for line in table.split_inclusive('\n') {
        let mut cells: Vec<&str> = line.split('|').collect();
        let key = cells.get(1).and_then(|cell| cell.trim().strip_prefix('`')?.strip_suffix('`'));
        let Some(key) = key else {
            text += line;
            continue;
        };
        let limit =
            missing.iter().position(|limit| limit.key == key).map(|index| missing.remove(index));
        let limit = limit.ok_or_else(|| format!("`{key}` is not a limit, or has two rows"))?;
        let [_, default, max] = &limit.words;
        let (default, max) = (format!(" {default} "), format!(" {max} "));
        let places =
            cells.get_mut(3..5).ok_or_else(|| format!("the row of `{key}` is too short"))?;
        places.copy_from_slice(&[&default, &max]);
        text += &cells.join("|");
    }
    match missing.first() {
        None => Ok(format!("{before}{BEGIN}{text}{END}{after}")),
        Some(limit) => Err(format!(
            "`{}` has no row: describe what it counts, and what happens beyond it",
            limit.key
        )),
    }
}

const ORIGIN: &str = "Made by `cargo xtask bless` of the table in `lambda/src/manifest/limits.rs`.";

fn for_rust() -> String {
    let mut text = format!(
        "//! `[limits]`: key, unit, and minimum, default and maximum; \
         sizes in bytes, durations in ns.\n//!\n//! {ORIGIN}\n\n\
         use super::table::Bounds;\n\npub(super) const LIMITS: &[(&str, &str, Bounds)] = &[\n"
    );
    rows(&mut text);
    text + "];\n"
}

fn for_python() -> String {
    let mut text = format!(
        "\"\"\"`[limits]`: key, unit, and minimum, default and maximum; \
         sizes in bytes, durations in ns.\n\n{ORIGIN}\"\"\"\n\n\
         from typing import Tuple\n\n\
         LIMITS: Tuple[Tuple[str, str, Tuple[int, int, int]], ...] = (\n"
    );
    rows(&mut text);
    text + ")\n"
}

fn rows(text: &mut String) {
    for Limit { key, unit, plain, .. } in Limits::table() {
        let [min, default, max] = plain.map(|number| grouped(number).replace(',', "_"));
        let _ = writeln!(text, "    (\"{key}\", \"{unit}\", ({min}, {default}, {max})),");
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(rows: &str) -> String {
        format!(
            "# Limits\n\n{BEGIN}\n| key | unit | default | maximum | counts |\n\
             |---|---|---|---|---|\n{rows}{END}\nmore\n"
        )
    }

    fn row(limit: &Limit, default: &str, max: &str) -> String {
        format!("| `{}` | u | {default} | {max} | by hand |\n", limit.key)
    }

    #[test]
    fn numbers_on_a_page_are_updated_and_text_is_kept() {
        let limits = Limits::table();
        let stale: String = limits.iter().map(|limit| row(limit, "1", "2")).collect();
        let fresh: String =
            limits.iter().map(|limit| row(limit, &limit.words[1], &limit.words[2])).collect();
        assert_eq!(page(&table(&stale)), Ok(table(&fresh)));
        assert_eq!(page(&table(&fresh)), Ok(table(&fresh)));
        assert!(
            fresh.contains("| `fuel` | u | 50,000,000 | 1,000,000,000,000 | by hand |"),
            "{fresh}"
        );
    }

    #[test]
    fn a_limit_without_a_row_and_a_row_without_a_limit_are_named() {
        let limits = Limits::table();
        let rows: Vec<String> = limits.iter().map(|limit| row(limit, "1", "2")).collect();
        let lacking = page(&table(&rows[1..].concat())).unwrap_err();
        assert!(lacking.starts_with("`fuel` has no row"), "{lacking}");
        let twice = page(&table(&(rows.concat() + &rows[0]))).unwrap_err();
        assert!(twice.starts_with("`fuel` is not a limit, or has two rows"), "{twice}");
    }
}

//! Tests that `docs/manifest.md` lists exactly the keys that are parsed.

use super::super::reference::sections;
use super::*;

/// Returns the keys of a table, as the error for an unknown key lists them.
#[track_caller]
fn known(manifest: &str) -> Vec<&'static str> {
    match Manifest::parse(manifest, "lambda.toml") {
        Err(ManifestError::UnknownKey { known, .. }) => known.to_vec(),
        other => panic!("{other:?}"),
    }
}

#[test]
fn the_reference_has_exactly_the_keys_that_are_parsed() {
    for section in sections() {
        let manifest = match section.title {
            "[lambda]" => TICKER.replace("[lambda]", "[lambda]\nnone = 1"),
            "[schedule]" => TICKER.replace("[schedule]", "[schedule]\nnone = 1"),
            "qos" => BRAKE_DARK.replace("\"auto\"", "{ none = 1 }"),
            "[config]" => format!("{TICKER}[config]\nx = {{ none = 1 }}\n"),
            title => format!("{TICKER}{title}\nnone = 1\n"),
        };
        let (mut known, mut listed) =
            (known(&manifest), section.keys.iter().map(|key| key.name).collect::<Vec<_>>());
        known.sort_unstable();
        listed.sort_unstable();
        assert_eq!(listed, known, "{}", section.title);
    }
    let top = known(&format!("none = 1\n{TICKER}"));
    let titles: Vec<_> =
        sections().iter().map(|section| section.title.trim_matches(['[', ']'])).collect();
    assert!(top.iter().all(|table| titles.contains(table)), "{top:?} and {titles:?}");
}

#[test]
fn the_reference_has_the_defaults_of_the_parser() {
    let page = reference();
    let manifest = Manifest::parse(TICKER, "lambda.toml").unwrap();
    for (key, value) in manifest.limits.describe() {
        let row = page.lines().find(|line| line.starts_with(&format!("| `{key}` |"))).unwrap();
        let plain = row.replace([',', '`', '"'], "");
        assert!(plain.contains(&format!("| {value} |")), "{value}: {row}");
    }
    for (number, is_there) in
        [("50,000,000", true), ("1,000 to 1,000,000,000,000", true), ("49,999,999", false)]
    {
        assert_eq!(page.contains(number), is_there, "{number}");
    }
}

//! The known name closest to one that was mistyped.

/// The one of `known` with the fewest edits from `wanted`, if it is close enough to be a guess
/// worth showing: at most a third of the longer name may differ.
pub(crate) fn nearest<'a>(wanted: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    // Edits take time in proportion to both lengths, and nobody mistypes a name of a page.
    if wanted.len() > 64 {
        return None;
    }
    known
        .into_iter()
        .map(|name| (strsim::levenshtein(wanted, name), name))
        .filter(|(edits, name)| *edits <= wanted.len().max(name.len()).div_ceil(3))
        .min_by_key(|(edits, _)| *edits)
        .map(|(_, name)| name)
}

/// " (did you mean `x`?)" or nothing, for error messages.
pub(crate) fn hint(nearest: &Option<String>) -> String {
    nearest.as_ref().map(|name| format!(" (did you mean `{name}`?)")).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_typo_finds_its_name_and_nonsense_finds_none() {
        let known = ["linear_acceleration", "angular_velocity", "orientation"];
        assert_eq!(nearest("linear_aceleration", known), Some("linear_acceleration"));
        assert_eq!(nearest("zzzzzz", known), None);
    }

    #[test]
    fn a_text_longer_than_any_name_is_no_typo() {
        let (longest, longer) = ("n".repeat(64), "n".repeat(65));
        assert_eq!(nearest(&longest, [longer.as_str()]), Some(longer.as_str()));
        assert_eq!(nearest(&longer, [longer.as_str()]), None);
    }
}

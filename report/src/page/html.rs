//! Renders the page as one file with its style, script and data.
//!
//! Everything that comes from result files is in the data. The content security policy lets a
//! browser run only the script whose digest the page names.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;
use sha2::{Digest, Sha256};

const PAGE: &str = include_str!("../../assets/page/page.html");
const STYLE: [&str; 2] =
    [include_str!("../../assets/uPlot.min.css"), include_str!("../../assets/page/page.css")];
const PLOTS: &str = include_str!("../../assets/uPlot.iife.min.js");
const PLOTS_LICENSE: &str = include_str!("../../assets/uPlot.LICENSE");
/// The scripts of the page, each after those that it uses.
const SCRIPTS: &[&str] = &[
    include_str!("../../assets/page/elements.js"),
    include_str!("../../assets/page/format.js"),
    include_str!("../../assets/page/colours.js"),
    include_str!("../../assets/page/timeline.js"),
    include_str!("../../assets/page/lanes.js"),
    include_str!("../../assets/page/curves.js"),
    include_str!("../../assets/page/details.js"),
    include_str!("../../assets/page/head.js"),
    include_str!("../../assets/page/spreads.js"),
    include_str!("../../assets/page/tables.js"),
    include_str!("../../assets/page/gallery.js"),
    include_str!("../../assets/page/differences.js"),
    include_str!("../../assets/page/main.js"),
];

pub(super) fn html(page: &impl Serialize) -> String {
    let script = script();
    let policy = format!(
        "default-src 'none'; img-src data:; style-src 'unsafe-inline'; script-src 'sha256-{}'; base-uri 'none'; form-action 'none'",
        STANDARD.encode(Sha256::digest(&script))
    );
    let mut text = String::new();
    for (index, piece) in PAGE.split("{{").enumerate() {
        let Some((name, after)) = piece.split_once("}}").filter(|_| index > 0) else {
            text.push_str(piece);
            continue;
        };
        match name {
            "policy" => text.push_str(&policy),
            "licence" => text.push_str(PLOTS_LICENSE),
            "style" => STYLE.iter().for_each(|style| text.push_str(style)),
            "data" => text.push_str(&json(page)),
            "script" => text.push_str(&script),
            other => unreachable!("page.html has a placeholder `{other}`"),
        }
        text.push_str(after);
    }
    text
}

/// Returns the script as one function, so that it adds no global names.
fn script() -> String {
    format!("\n{PLOTS}\n(() => {{\n\"use strict\";\n{}\n}})();\n", SCRIPTS.join("\n"))
}

/// Returns `value` as JSON without characters that could end an HTML element or a line of a script.
pub(super) fn json(value: &impl Serialize) -> String {
    let plain = serde_json::to_string(value).expect("page data has only text keys");
    let mut text = String::with_capacity(plain.len());
    // JSON has these characters only inside texts.
    for character in plain.chars() {
        match character {
            '<' | '>' | '&' | '\u{2028}' | '\u{2029}' => {
                text.push_str(&format!("\\u{:04x}", character as u32))
            }
            other => text.push(other),
        }
    }
    text
}

pub(super) fn jpeg_address(jpeg: &[u8]) -> String {
    format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_can_end_its_element() {
        let text = "</script><script>alert(1)</script>&amp;\u{2028}\u{2029}\\\"";
        let json = json(&text);
        assert!(json.is_ascii() && !json.contains(['<', '>', '&']), "{json}");
        assert_eq!(serde_json::from_str::<String>(&json).unwrap(), text);
    }

    #[test]
    fn the_hash_is_that_of_the_script_in_its_element() {
        let page = html(&"");
        let (_, after) = page.split_once("<script>").unwrap();
        let (inside, rest) = after.split_once("</script>").unwrap();
        assert_eq!(inside, script());
        // An HTML comment in a script would change where it ends.
        assert!(!inside.contains("<!--") && !inside.contains('\r'));
        assert!(!rest.contains("<script"));
        let hash = STANDARD.encode(Sha256::digest(inside));
        assert!(page.contains(&format!("script-src 'sha256-{hash}'")));
    }

    #[test]
    fn the_page_fetches_nothing_and_sets_no_text_as_html() {
        let sources = [PAGE, STYLE[1]].iter().chain(SCRIPTS).copied().collect::<String>();
        for word in [
            "http://",
            "https://",
            "innerHTML",
            "outerHTML",
            "insertAdjacentHTML",
            "document.write",
            "eval(",
        ] {
            assert!(!sources.contains(word), "{word}");
        }
        assert!(PAGE.find("{{policy}}").unwrap() < PAGE.find("{{style}}").unwrap());
    }
}

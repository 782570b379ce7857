//! The page as one file: its style, its script and its data, and nothing that it would have to
//! fetch.
//!
//! All that comes from files is in the data, and the data is no program: a browser runs only the
//! script whose digest the page names.

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde::Serialize;
use sha2::{Digest, Sha256};

use super::Page;

const PAGE: &str = include_str!("../../assets/page/page.html");
const STYLE: [&str; 2] =
    [include_str!("../../assets/uPlot.min.css"), include_str!("../../assets/page/page.css")];
/// The plots, which others made.
const PLOTS: &str = include_str!("../../assets/uPlot.iife.min.js");
const PLOTS_LICENSE: &str = include_str!("../../assets/uPlot.LICENSE");
/// In the order in which they use each other.
const SCRIPTS: &[&str] = &[
    include_str!("../../assets/page/elements.js"),
    include_str!("../../assets/page/words.js"),
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

/// The page for `page`.
pub(super) fn html(page: &Page) -> String {
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
            other => unreachable!("page.html asks for `{other}`"),
        }
        text.push_str(after);
    }
    text
}

/// One closed function, so that the page has no names of ours beside those of the browser.
fn script() -> String {
    format!("\n{PLOTS}\n(() => {{\n\"use strict\";\n{}\n}})();\n", SCRIPTS.join("\n"))
}

/// `value` as JSON that ends no element of a page, and no line of a script, whatever its texts are.
pub(super) fn json(value: &impl Serialize) -> String {
    let plain = serde_json::to_string(value).expect("what a page shows has text keys");
    let mut text = String::with_capacity(plain.len());
    // Outside of texts JSON has none of these characters.
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

/// The address of a picture that is in the page itself.
pub(super) fn jpeg_address(jpeg: &[u8]) -> String {
    format!("data:image/jpeg;base64,{}", STANDARD.encode(jpeg))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn no_text_ends_the_element_that_it_is_in() {
        let text = "</script><script>alert(1)</script>&amp;\u{2028}\u{2029}\\\"";
        let json = json(&text);
        assert!(json.is_ascii() && !json.contains(['<', '>', '&']), "{json}");
        assert_eq!(serde_json::from_str::<String>(&json).unwrap(), text);
    }

    #[test]
    fn the_script_stands_in_its_element_as_it_is_hashed() {
        let page = html(&Page { made_by: String::new(), runs: Vec::new(), diff: None });
        let (_, after) = page.split_once("<script>").unwrap();
        let (inside, rest) = after.split_once("</script>").unwrap();
        assert_eq!(inside, script());
        // A comment of HTML in a script changes where it ends.
        assert!(!inside.contains("<!--") && !inside.contains('\r'));
        assert!(!rest.contains("<script"));
        let hash = STANDARD.encode(Sha256::digest(inside));
        assert!(page.contains(&format!("script-src 'sha256-{hash}'")));
    }

    #[test]
    fn the_page_fetches_nothing_and_sets_no_text_as_html() {
        let ours = [PAGE, STYLE[1]].iter().chain(SCRIPTS).copied().collect::<String>();
        for word in [
            "http://",
            "https://",
            "innerHTML",
            "outerHTML",
            "insertAdjacentHTML",
            "document.write",
            "eval(",
        ] {
            assert!(!ours.contains(word), "{word}");
        }
        assert!(PAGE.find("{{policy}}").unwrap() < PAGE.find("{{style}}").unwrap());
    }
}

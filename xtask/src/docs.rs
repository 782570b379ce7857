//! `cargo xtask docs`: builds the pages as a book in `target/book`. Tests read the pages directly.
//!
//! Pages link to files all over the checkout, but mdBook reads only one folder. So the text files
//! of the checkout are copied to a folder, beside `SUMMARY.md` of `docs` with adapted links.

use std::fs;
use std::path::Path;

use gleaner_base::{Exit, Failure};

use crate::checkout::Checkout;
use crate::steps::{self, Steps};

/// The version that the book was checked with.
const MDBOOK: &str = "0.5.4";

/// Files that pages link to, as patterns of git.
const LINKED: [&str; 10] =
    ["*.md", "*.png", "*.rs", "*.py", "*.toml", "*.txt", "*.wit", "*.ipynb", "*LICENSE", "*.json"];

/// Fetches mdBook if it is not there, and builds the book.
pub(crate) fn run(checkout: &Checkout) -> Result<Exit, Failure> {
    let mut steps = Steps::of(2);
    let home = checkout.target().join("mdbook");
    let mdbook = home.join("bin/mdbook");
    steps.begin(&format!("mdBook {MDBOOK} in target/mdbook (the first time this takes minutes)"));
    let has = checkout.command(&mdbook).arg("--version").output();
    if !has.is_ok_and(|output| String::from_utf8_lossy(&output.stdout).trim().ends_with(MDBOOK)) {
        let mut install = checkout.cargo();
        install.args(["install", "mdbook", "--locked", "--version", MDBOOK, "--root"]).arg(&home);
        let help = "check the network; the pages can also be read without a book";
        steps::download(&mut install, help)?;
    }
    steps.begin("the book");
    let source = checkout.target().join("book-source");
    let mut list = checkout.command("git");
    let files = steps::output(
        list.args(["ls-files", "--cached", "--others", "--exclude-standard", "--"]).args(LINKED),
        "run it in a checkout",
    )?;
    copy_pages(checkout, &files, &source).map_err(|error| {
        Failure::caused_by(Exit::Internal, "cannot copy the pages of the book", &error)
    })?;
    let mut build = checkout.command(&mdbook);
    let book = checkout.target().join("book");
    build.arg("build").arg(&source).arg("--dest-dir").arg(&book);
    steps::run(
        &mut build,
        "see the error above; `cargo test --release -p gleaner-tests --test architecture docs` \
         checks the links",
    )?;
    println!("built {}", book.join("index.html").display());
    Ok(Exit::Ok)
}

/// Copies the pages and linked files to `to`, for mdBook.
fn copy_pages(checkout: &Checkout, files: &str, to: &Path) -> std::io::Result<()> {
    if to.exists() {
        fs::remove_dir_all(to)?;
    }
    for path in files.lines() {
        let (file, copy) = (checkout.path(path), to.join("src").join(path));
        // One that was removed is listed until that is committed.
        if !file.exists() {
            continue;
        }
        fs::create_dir_all(copy.parent().unwrap_or(to))?;
        if path.ends_with(".md") {
            // mdBook renames the page of a README to `index.html`, but not links to it.
            let page = fs::read_to_string(file)?;
            let page = page.replace("README.md)", "index.md)").replace("README.md#", "index.md#");
            fs::write(copy, page)?;
        } else {
            fs::copy(file, copy)?;
        }
    }
    let summary = fs::read_to_string(checkout.path("docs/SUMMARY.md"))?;
    fs::write(to.join("src/SUMMARY.md"), from_the_root(&summary))?;
    fs::copy(checkout.path("docs/book.toml"), to.join("book.toml")).map(drop)
}

/// Adapts the links of `docs/SUMMARY.md` to the root of the checkout.
fn from_the_root(summary: &str) -> String {
    summary.replace("](", "](docs/").replace("](docs/../", "](")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn links_are_relative_to_the_root() {
        let summary = "[Gleaner](../README.md)\n\n- [Clips](clips.md)\n    - [X](../examples/hello/README.md)";
        let moved =
            "[Gleaner](README.md)\n\n- [Clips](docs/clips.md)\n    - [X](examples/hello/README.md)";
        assert_eq!(from_the_root(summary), moved);
    }
}

//! Parses Markdown pages as far as tests need: fenced blocks, links, headings.

/// A block between fences.
#[derive(Debug)]
pub struct Block {
    /// Line of its opening fence, from 1.
    pub line: usize,
    /// Text after the fence, such as `rust`.
    pub language: String,
    /// The path in a comment `<!-- file: PATH -->` directly above it: the file that it quotes.
    pub file: Option<String>,
    /// Its lines, without the indentation of the fence.
    pub lines: Vec<String>,
}

pub fn blocks(page: &str) -> Vec<Block> {
    let mut blocks = Vec::new();
    let mut open: Option<(Block, usize, String)> = None;
    let mut above = "";
    for (index, line) in page.lines().enumerate() {
        let trimmed = line.trim_start();
        let fence: String = trimmed.chars().take_while(|c| *c == '`').collect();
        match &mut open {
            Some((_, _, mark)) if trimmed.trim_end() == *mark => {
                blocks.extend(open.take().map(|(block, ..)| block));
            }
            Some((block, indent, _)) => {
                block.lines.push(line.get(*indent..).unwrap_or_default().to_owned())
            }
            None if fence.len() >= 3 => {
                let file =
                    above.strip_prefix("<!-- file: ").and_then(|rest| rest.strip_suffix(" -->"));
                let language = trimmed[fence.len()..].trim().to_owned();
                let block = Block {
                    line: index + 1,
                    language,
                    file: file.map(str::to_owned),
                    lines: Vec::new(),
                };
                open = Some((block, line.len() - trimmed.len(), fence));
            }
            None => {}
        }
        above = line.trim();
    }
    assert!(open.is_none(), "a block is not closed: {open:?}");
    blocks
}

/// The targets of all links of a page with their lines, from 1; links in code are ignored.
pub fn links(page: &str) -> Vec<(usize, String)> {
    let mut links = Vec::new();
    let mut inside = false;
    for (index, line) in page.lines().enumerate() {
        if line.trim_start().starts_with("```") {
            inside = !inside;
        }
        if inside {
            continue;
        }
        for (at, _) in line.match_indices("](") {
            // Inside of code there is an odd number of backticks before it.
            let in_code = line[..at].matches('`').count() % 2 == 1;
            if let Some((target, _)) = line[at + 2..].split_once(')').filter(|_| !in_code) {
                links.push((index + 1, target.to_owned()));
            }
        }
    }
    links
}

/// The anchors of a page for links with `#`, as GitHub and mdBook derive them from headings.
pub fn anchors(page: &str) -> Vec<String> {
    let mut inside = false;
    let headings = page.lines().filter(|line| {
        inside ^= line.trim_start().starts_with("```");
        !inside && line.starts_with('#')
    });
    headings
        .map(|heading| {
            let text = heading.trim_start_matches('#').trim().to_lowercase();
            let kept = text.chars().filter(|c| c.is_alphanumeric() || " -_".contains(*c));
            kept.map(|c| if c == ' ' { '-' } else { c }).collect()
        })
        .collect()
}

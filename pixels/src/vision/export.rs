//! Statements of an export about its model, in the metadata of the file.

use gleaner_rules::text::shortened;

/// The metadata of a model, as Ultralytics writes it; other exports have none.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct ExportNote {
    /// `detect`, `pose`, `obb`, `segment` or `classify`.
    pub task: Option<String>,
    /// Name of the last layer, such as `Detect` or `RTDETRDecoder`.
    pub head: Option<String>,
    /// Largest stride of its grids.
    pub stride: Option<u32>,
    /// True if the model needs no NMS.
    pub end2end: bool,
    /// Names of its classes; none if they are unknown.
    pub names: Vec<String>,
}

impl ExportNote {
    /// Reads entries of metadata. Other keys are skipped, and so is a value in another form.
    pub fn of<'a>(entries: impl IntoIterator<Item = (&'a str, &'a str)>) -> Self {
        let mut note = Self::default();
        for (key, value) in entries {
            match key {
                "task" => note.task = Some(value.to_owned()),
                "head" => note.head = Some(value.to_owned()),
                "stride" => note.stride = value.parse().ok(),
                "end2end" => note.end2end = value.eq_ignore_ascii_case("true"),
                "names" => note.names = names(value).unwrap_or_default(),
                _ => {}
            }
        }
        note
    }

    /// Returns the kind of a model that no layout decodes.
    pub(crate) fn foreign_kind(&self) -> Option<String> {
        if self.head.as_deref() == Some("RTDETRDecoder") {
            return Some("RT-DETR".to_owned());
        }
        let task = self.task.as_deref().filter(|task| *task != "detect")?;
        Some(format!("for task `{}`", shortened(task)))
    }

    /// Returns the first label that is the name of another class, with its index and that class.
    pub fn contradicted<'a>(&self, labels: &'a [String]) -> Option<(usize, &'a str, usize)> {
        labels.iter().enumerate().find_map(|(index, label)| {
            let is_here = self.names.get(index).is_none_or(|name| name == label);
            let class = self.names.iter().position(|name| name == label)?;
            (!is_here).then_some((index, label.as_str(), class))
        })
    }
}

/// Reads the names of classes: a dictionary of Python, `{0: 'person', 1: "child's seat"}`, whose
/// keys count up.
fn names(text: &str) -> Option<Vec<String>> {
    let mut rest = text.trim().strip_prefix('{')?.trim_start();
    let mut names = Vec::new();
    while !rest.starts_with('}') {
        let (key, value) = rest.split_once(':')?;
        if key.trim().parse() != Ok(names.len()) {
            return None;
        }
        let value = value.trim_start();
        let quote = value.chars().next().filter(|quote| matches!(quote, '\'' | '"'))?;
        let (mut name, mut letters) = (String::new(), value[1..].chars());
        loop {
            match letters.next()? {
                '\\' => name.push(letters.next()?),
                letter if letter == quote => break,
                letter => name.push(letter),
            }
        }
        names.push(name);
        rest = letters.as_str().trim_start();
        rest = rest.strip_prefix(',').unwrap_or(rest).trim_start();
    }
    Some(names)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_from_a_dictionary_of_python() {
        let read = |text| ExportNote::of([("names", text)]).names;
        assert_eq!(read("{0: 'person', 1: \"child's seat\"}"), ["person", "child's seat"]);
        assert_eq!(read(r"{0: 'a\'b: c', 1: 'd,e}',}"), ["a'b: c", "d,e}"]);
        for text in ["", "{", "{0: 'a'", "{0: 'a", "{1: 'a'}", "['a']", "{0: a}", "{0: 'ä"] {
            assert!(read(text).is_empty(), "{text}");
        }
    }

    #[test]
    fn a_label_contradicts_names_if_it_is_that_of_another_class() {
        let note = ExportNote::of([("names", "{0: 'person', 1: 'bicycle', 2: 'car'}")]);
        let found = |labels: [&str; 3]| {
            note.contradicted(&labels.map(str::to_owned))
                .map(|(index, label, class)| (index, label.to_owned(), class))
        };
        assert_eq!(found(["person", "bicycle", "car"]), None);
        // A translation is none.
        assert_eq!(found(["Mensch", "Rad", "car"]), None);
        assert_eq!(found(["person", "car", "bicycle"]), Some((1, "car".to_owned(), 2)));
    }
}

//! The page of all calls, `docs/sdk.md`: meaning and errors from `wit/`, signatures from the
//! sources of both SDKs, prices from the list of operations.

use std::fs;

use gleaner_test_support::operations::{CALL, Deadline, Operation, Price};
use wit_bindgen_core::wit_parser::{Function, Resolve, Type, TypeDefKind};

use super::path;

pub(super) const PAGE: &str = "docs/sdk.md";

const INTRODUCTION: &str = "\
# All calls of a lambda

Each row is a function of the [WIT](../wit/world.wit), and its form in Rust (`gleaner_sdk`) and Python (`gleaner`).
[types.wit](../wit/types.wit) has the fields of records with their units.
In Rust, `event` and `start` get attributes by `.with(key, value)`, and take effect with `.send()?`.
Both SDKs have more on top, such as `Frame::copy_to`, `Tensor::from_values` and `frame.array()`: see their docs.

- **Unit and shape** are in the words of the WIT: its `at-ns` is `at_ns` in both languages.
- **Fuel** is what a component pays; a Python lambda has none. `bytes` are those that the host copies, and of pixels
  those that it [works on](limits.md#fuel-of-host-work). [Data](data.md) has times.
- **Errors** are kinds: in Rust `error.is(DataErrorKind::NoRoom)`, in Python `error.kind == \"no-room\"`.
  A call beyond `handles` or `call_bytes` ends the wake instead ([limits](limits.md)).

<!-- `cargo xtask bless` writes this page. -->
";

/// Interfaces of the WIT, each with the object in Python that has its functions.
const INTERFACES: [(&str, &str); 5] = [
    ("data", "ctx."),
    ("trigger", "ctx."),
    ("inference", ""),
    ("log", "ctx."),
    ("scratch", "ctx.scratch."),
];

pub(super) fn page(resolve: &Resolve) -> String {
    let mut page = INTRODUCTION.to_owned();
    for (name, object) in INTERFACES {
        let mut interfaces = resolve.interfaces.iter().map(|(_, interface)| interface);
        let interface = interfaces.find(|it| it.name.as_deref() == Some(name)).expect(name);
        let read = |file: String| fs::read_to_string(path(&file)).expect(&file);
        let rust = read(format!("guest-sdk-rust/src/{name}.rs"));
        let python = read(format!("guest-sdk-python/gleaner/{name}.py"));
        page += &format!(
            "\n## {name}\n\n\
             | WIT | Rust | Python | unit and shape | fuel | errors |\n|---|---|---|---|---|---|\n"
        );
        for function in interface.functions.values() {
            let call = function.name.rsplit(']').next().expect("a part");
            let (resource, item) = call.split_once('.').unwrap_or(("", call));
            let (resource, item) = (camel(resource), item.replace('-', "_"));
            let (class, in_rust, in_python) = match &*resource {
                "" => (camel(name), format!("{name}::"), object.to_owned()),
                _ => (resource.clone(), format!("{resource}::"), format!("{resource}.")),
            };
            let in_rust = format!("`{in_rust}{}`", rust_signature(&rust, &resource, &item));
            let in_python = format!("`{in_python}{}`", python_signature(&python, &class, &item));
            let (meaning, errors) = documented(resolve, function);
            let fuel = fuel(&format!("{name}.{call}"));
            let cells = [format!("`{call}`"), in_rust, in_python, meaning, fuel, errors];
            page += &format!("| {} |\n", cells.map(|cell| cell.replace('|', "\\|")).join(" | "));
        }
    }
    page
}

/// Returns the meaning of a function and its errors. The WIT states errors where there are some.
fn documented(resolve: &Resolve, function: &Function) -> (String, String) {
    let docs = function.docs.contents.as_deref().expect(&function.name).replace('\n', " ");
    let (meaning, errors) = docs.split_once("  Errors: ").unwrap_or((&docs, ""));
    let can_fail = matches!(function.result, Some(Type::Id(id))
        if matches!(resolve.types[id].kind, TypeDefKind::Result(_)));
    assert_eq!(can_fail, !errors.is_empty(), "`{}` needs `Errors: ` in `wit/`", function.name);
    (meaning.trim().to_owned(), errors.trim().to_owned())
}

fn fuel(name: &str) -> String {
    let operation = Operation::ALL.iter().find(|it| it.name() == name).expect(name);
    let price = match operation.price() {
        Price::Bytes([cheap, expensive]) if cheap.bytes.max(expensive.bytes) == 0 => "",
        Price::Bytes(_) | Price::Never => " + bytes / 8",
    };
    let waits = if operation.deadline() == Deadline::Waiting { "; waits" } else { "" };
    format!("{CALL}{price}{waits}")
}

/// Returns the signature of a function, or of a method of `class`.
fn rust_signature(source: &str, class: &str, item: &str) -> String {
    let (block, indent) = match class {
        "" => (source, ""),
        _ => (between(source, &format!("\nimpl {class} {{"), "\n}\n"), "    "),
    };
    let parameters = between(block, &format!("\n{indent}pub fn {item}("), " {\n");
    format!("{item}({}", in_one_line(parameters))
}

/// Returns the signature of a method or property of `class`, without `self`.
fn python_signature(source: &str, class: &str, item: &str) -> String {
    let is_class = |it: &&str| it.strip_prefix(class).is_some_and(|it| it.starts_with(['(', ':']));
    let block = source.split("\nclass ").find(is_class).expect(class);
    let signature = in_one_line(between(block, &format!("    def {item}("), ":\n"));
    let signature = signature.strip_prefix("self").unwrap_or(&signature);
    match block.contains(&format!("@property\n    def {item}(")) {
        true => format!("{item}{}", signature.trim_start_matches(')')),
        false => format!("{item}({}", signature.trim_start_matches(", ")),
    }
}

/// Returns the text after the first `begin`, up to the next `end` or to the end.
#[track_caller]
fn between<'a>(text: &'a str, begin: &str, end: &str) -> &'a str {
    let (_, rest) = text.split_once(begin).unwrap_or_else(|| panic!("no `{begin}` in an SDK"));
    rest.split_once(end).map_or(rest, |(found, _)| found)
}

fn in_one_line(text: &str) -> String {
    let text = text.split_whitespace().collect::<Vec<_>>().join(" ");
    text.replace("( ", "(").replace(", )", ")").replace(" )", ")")
}

fn camel(name: &str) -> String {
    name.get(..1).unwrap_or("").to_uppercase() + name.get(1..).unwrap_or("")
}

//! The APIs only grow, so that programs of an older version work with newer ones.

use std::collections::BTreeSet;
use std::fs;

use gleaner_tests::root;
use serde_json::{Value, json};

/// A fact about an API: a place, `is` or `needs`, and a type, a value, or the name of a field.
type Fact = (String, &'static str, String);

fn entries(value: &Value) -> impl Iterator<Item = (&String, &Value)> {
    value.as_object().into_iter().flatten()
}

fn items(value: &Value) -> impl Iterator<Item = &Value> {
    value.as_array().into_iter().flatten()
}

fn resolved<'d>(document: &'d Value, part: &'d Value) -> &'d Value {
    part["$ref"].as_str().map_or(part, |path| document.pointer(&path[1..]).expect(path))
}

fn add(facts: &mut BTreeSet<Fact>, at: &str, document: &Value, schema: &Value) {
    let schema = resolved(document, schema);
    let mut fact = |verb, what: &str| facts.insert((at.to_owned(), verb, what.to_owned()));
    fact("is", "there");
    for value in items(&schema["enum"]).chain(schema.get("const")) {
        fact("is", &value.to_string());
    }
    for kind in items(&schema["type"]).chain(schema.get("type")).filter_map(Value::as_str) {
        fact("is", kind);
    }
    for name in items(&schema["required"]).filter_map(Value::as_str) {
        fact("needs", name);
    }
    if schema["additionalProperties"] == false {
        fact("is", "closed");
    }
    for form in items(&schema["anyOf"]).chain(items(&schema["oneOf"])) {
        // A value of its own is the difference between forms with the same fields.
        let tag = entries(&form["properties"]).find_map(|(_, it)| it.get("const"));
        facts.extend(tag.map(|tag| (at.to_owned(), "is", tag.to_string())));
        add(facts, &tag.map_or(at.to_owned(), |tag| format!("{at}={tag}")), document, form);
    }
    for (name, field) in entries(&schema["properties"]) {
        add(facts, &format!("{at} {name}"), document, field);
    }
    for key in ["items", "additionalProperties"].into_iter().filter(|key| schema[key].is_object()) {
        add(facts, &format!("{at} *"), document, &schema[key]);
    }
}

fn facts(document: &Value, is_request: bool) -> BTreeSet<Fact> {
    let mut facts = BTreeSet::new();
    for (path, methods) in entries(&document["paths"]) {
        for (method, operation) in entries(methods) {
            let at = format!("{method} {path}");
            facts.insert((at.clone(), "is", "there".to_owned()));
            for it in items(&operation["parameters"]).filter(|_| is_request) {
                let name = it["name"].as_str().expect("a name");
                add(&mut facts, &format!("{at} {name}"), document, &it["schema"]);
                let is_needed = it["required"] == true;
                facts.extend(is_needed.then(|| (at.clone(), "needs", name.to_owned())));
            }
            let request = json!({ "body": operation["requestBody"] });
            let bodies = if is_request { &request } else { &operation["responses"] };
            for (name, body) in entries(bodies) {
                for (media, it) in entries(&resolved(document, body)["content"]) {
                    facts.insert((at.clone(), "needs", format!("{name} {media}")));
                    add(&mut facts, &format!("{at} {name} {media}"), document, &it["schema"]);
                }
            }
        }
    }
    facts
}

/// Returns each change of a description that is no addition. Old programs get answers of a newer
/// one, and if `has_old_servers`, also its requests.
fn breaks(before: &Value, now: &Value, has_old_servers: bool) -> Vec<String> {
    let of = |is_request| {
        let [old, new] = [before, now].map(|it| facts(it, is_request));
        let was = |at: &str, what: &str| old.contains(&(at.to_owned(), "is", what.to_owned()));
        let is_value = |what: &str| what.starts_with('"');
        let had_values = |at: &str| old.iter().any(|(of, _, it)| of == at && is_value(it));
        let is_break = |(at, verb, what): &&Fact, is_gone| match (is_gone, *verb, &**what) {
            (_, "needs", _) => is_request != is_gone && (is_gone || was(at, "there")),
            (true, _, what) => what != "closed",
            (false, _, "null") => !is_request && was(at, "there"),
            // An older program refuses what it does not know.
            (false, _, "there") if !is_request || has_old_servers => {
                at.rsplit_once(' ').is_some_and(|(of, _)| was(of, "closed"))
            }
            (false, _, what) if is_value(what) && is_request => was(at, "there") && !had_values(at),
            (false, _, what) if is_value(what) => was(at, "there"),
            _ => false,
        };
        let gone = old.difference(&new).filter(|it| is_break(it, true));
        let gone = gone.map(|(at, verb, what)| format!("{at} no longer {verb} {what}"));
        let added = new.difference(&old).filter(|it| is_break(it, false));
        let added = added.map(|(at, verb, what)| format!("{at} now {verb} {what}"));
        gone.chain(added).collect::<Vec<_>>()
    };
    [of(true), of(false)].concat()
}

#[test]
fn apis_only_grow() {
    for name in ["fleet.json", "link.json", "vehicle.json"] {
        let [before, now] = ["docs/api/base", "docs/api"].map(|folder| {
            let text = fs::read_to_string(root().join(folder).join(name)).expect(name);
            serde_json::from_str(&text).expect(name)
        });
        let help = "add a path, and keep the old one; if no program uses it any more, write its \
                    base: `python3 -m json.tool --compact docs/api/NAME docs/api/base/NAME`";
        let breaks = breaks(&before, &now, name == "link.json");
        assert!(breaks.is_empty(), "{name}: {help}\n{}", breaks.join("\n"));
    }
}

#[test]
fn each_kind_of_change_that_is_no_addition_is_found() {
    let before = json!({
        "paths": { "/a": { "post": {
            "parameters": [{ "name": "limit", "schema": { "type": "integer" } }],
            "requestBody": { "content": { "json": { "schema": { "$ref": "#/New" } } } },
            "responses": { "200": { "content": { "json": { "schema": { "$ref": "#/Made" } } } } },
        } } },
        "New": { "required": ["name"], "properties": {
            "name": { "type": "string" },
            "days": { "type": ["null"] },
            "plan": { "additionalProperties": false },
        } },
        "Made": { "required": ["age"], "properties": {
            "age": { "type": "integer" },
            "plan": { "properties": {}, "additionalProperties": false },
            "state": { "oneOf": [{ "const": "on" }, { "const": "off" }] },
        } },
    });
    let cases = [
        ("/paths", json!({}), "post /a no longer is there"),
        ("/paths/~1a/post/parameters", json!([]), "post /a limit no longer is there"),
        ("/paths/~1a/post/responses", json!({}), "post /a 200 json no longer is there"),
        ("/New/required", json!(["name", "days"]), "post /a body json now needs days"),
        ("/New/properties/days", json!({}), "post /a body json days no longer is null"),
        ("/Made/properties", json!({}), "post /a 200 json age no longer is there"),
        ("/Made/properties/age/type", json!(["integer", "null"]), "json age now is null"),
        ("/Made/properties/state", json!({ "const": "on" }), "state no longer is \"off\""),
        ("/Made/properties/plan/properties", json!({ "x": {} }), "plan x now is there"),
        ("/Made/properties/state/oneOf/0", json!({ "const": "half" }), "state now is \"half\""),
        ("/New/properties/name", json!({ "type": "string", "enum": ["a"] }), "name now is \"a\""),
        ("/New/properties/plan/properties", json!({ "x": {} }), "plan x now is there"),
        ("/paths/~1a/post/parameters/0/required", json!(true), "post /a now needs limit"),
        ("/Made/required", json!([]), "post /a 200 json no longer needs age"),
    ];
    for (path, value, expected) in cases {
        let mut now = before.clone();
        let (of, key) = path.rsplit_once('/').expect(path);
        let part = now.pointer_mut(of).expect(path);
        match key.parse::<usize>() {
            Ok(index) => part[index] = value,
            Err(_) => part[key] = value,
        }
        let found = breaks(&before, &now, true).join("\n");
        assert!(found.contains(expected), "{path}: {found}");
    }
    let mut more = before.clone();
    more["paths"]["/b"] = more["paths"]["/a"].clone();
    more["New"]["properties"]["more"] = json!({ "required": ["x"] });
    more["Made"]["properties"]["more"] = json!({ "type": "null" });
    more["Made"]["required"] = json!(["age", "more"]);
    assert_eq!(breaks(&before, &more, true), [""; 0]);
}

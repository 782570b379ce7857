//! Tests refusals of one key or value: unknown, missing, of another type or form.

use super::*;

#[test]
fn unknown_keys_are_refused_at_every_level() {
    refused_below(
        "[limit]",
        "lambda.toml, line 8: unknown key `limit` at the top level",
        "did you mean `limits`?",
    );
    refused_with(
        "event = \"camera\"",
        "evnt = \"camera\"",
        "lambda.toml, line 8: unknown key `evnt` in [schedule]",
        "did you mean `event`?",
    );
    refused_with(
        "depth = 512",
        "colour = 1",
        "lambda.toml, line 21: unknown key `colour` in [[input]]",
        "the known keys are `name`, `topic`, `type`, `depth`, `max_size`, `decoded_size`, `hold` \
         and `qos`",
    );
    refused_with(
        "qos = \"auto\"",
        "qos = { relaibility = \"reliable\" }",
        "lambda.toml, line 16: unknown key `relaibility` in `input.qos`",
        "did you mean `reliability`?",
    );
    let in_config = "lambda.toml, line 9: unknown key `defualt` in `config.gain`";
    refused_below("[config]\ngain = { defualt = 1 }", in_config, "did you mean `default`?");
    // The first of several, in the order of the file.
    let (last, others) = Limits::KEYS.split_last().unwrap();
    refused_below(
        "[limits]\nzz = 1\naa = 1",
        "lambda.toml, line 9: unknown key `zz` in [limits]",
        &format!("the known keys are `{}` and `{last}`", others.join("`, `")),
    );
}

#[test]
fn missing_keys_and_tables_are_refused_with_an_example() {
    refused(
        "",
        "lambda.toml has no [lambda] table",
        "add [lambda] with name, version, kind and entry",
    );
    refused(
        &TICKER.replace("[schedule]\nperiod = \"100ms\"\n", ""),
        "lambda.toml has no [schedule] table",
        "add [schedule] with event = \"<an input's name>\" or period = \"100ms\"",
    );
    refused_with(
        "version = \"0.1.0\"",
        "",
        "lambda.toml, line 1: [lambda] has no `version`",
        "add version = \"0.1.0\"",
    );
    refused_with(
        "topic = \"/imu/data\"",
        "",
        "lambda.toml, line 17: [[input]] has no `topic`",
        "add topic = \"/camera/front/compressed\"",
    );
    refused_below(
        "[config]\ngain = { min = 1 }",
        "lambda.toml, line 9: `config.gain` has no `default`",
        "add default = 1.0, or another value of the type that the lambda expects",
    );
}

#[test]
fn only_a_component_can_be_deterministic() {
    let python = TICKER.replace("[schedule]", "deterministic = true\n[schedule]");
    refused(
        &python,
        "lambda.toml, line 6: `lambda.deterministic` has no meaning with kind = \"python\"",
        "remove it: Python's numbers are those of the machine",
    );
    let wasm = python.replace("\"python\"", "\"wasm\"");
    assert!(Manifest::parse(&wasm, "lambda.toml").unwrap().lambda.deterministic);
    refused(
        &wasm.replace("= true", "= 1"),
        "lambda.toml, line 6: `lambda.deterministic` is a whole number",
        "give true or false",
    );
}

#[test]
fn data_files_are_those_of_a_python_lambda_that_gleaner_does_not_write() {
    let with =
        |path: &str| TICKER.replace("[schedule]", &format!("files = [\"{path}\"]\n[schedule]"));
    let manifest = Manifest::parse(&with("calib/a.json"), "lambda.toml").unwrap();
    assert_eq!(manifest.to_json()["lambda"]["files"].to_string(), r#"["calib/a.json"]"#);
    for (path, why, help) in [
        ("build/a", "names `build/a`, which Gleaner itself writes", "give the data another name"),
        ("a/.b", "names `a/.b`, which is hidden", "give it a name that does not begin with a dot"),
        ("a/*", "names `a/*`, which is a pattern", "name each file, or their folder"),
    ] {
        refused(&with(path), &format!("lambda.toml, line 6: `lambda.files` {why}"), help);
    }
    refused(
        &with("a").replace("\"python\"", "\"wasm\""),
        "lambda.toml, line 6: `lambda.files` has no meaning with kind = \"wasm\"",
        "remove it: put them into `src/`, and use `include_bytes!`",
    );
}

#[test]
fn values_of_another_type_are_refused() {
    let text = "give a text in quotes";
    refused_with(
        "version = \"0.1.0\"",
        "version = 1",
        "lambda.toml, line 3: `lambda.version` is a whole number",
        text,
    );
    refused_with(
        "depth = 512",
        "depth = \"many\"",
        "lambda.toml, line 21: `input.depth` is a text",
        "give a whole number",
    );
    refused_with(
        "deadline = \"50ms\"",
        "deadline = 50",
        "lambda.toml, line 30: `limits.deadline` is a whole number",
        "give a duration in quotes, for example \"50ms\"",
    );
    refused_with(
        "memory = \"64 MiB\"",
        "memory = 1.5",
        "lambda.toml, line 31: `limits.memory` is a number with a fraction",
        "give a size in quotes, for example \"2 MiB\", or a whole number of bytes",
    );
    refused_with(
        "qos = \"auto\"",
        "qos = true",
        "lambda.toml, line 16: `input.qos` is true or false",
        "give \"auto\", or a table such as { reliability = \"reliable\", \
         durability = \"volatile\", depth = 10 }",
    );
    refused_below(
        "[input]\nname = \"imu\"",
        "lambda.toml, line 8: `input` is a table",
        "give entries that begin with [[input]]",
    );
    refused_below(
        "limits = 1979-05-27",
        "lambda.toml, line 8: unknown key `limits` in [schedule]",
        "the known keys are `event`, `period` and `backlog`",
    );
    refused("lambda = []", "lambda.toml, line 1: `lambda` is an array", "give a table");
    refused_below(
        "[config]\nwhen = 1979-05-27",
        "lambda.toml, line 9: `config.when` is a date or time",
        "give a number, a text, true or false, or a table such as { default = 1.0, unit = \"m\" }",
    );
}

#[test]
fn names_of_another_form_are_refused() {
    refused_with(
        "name = \"brake-dark\"",
        "name = \"Brake Dark\"",
        "lambda.toml, line 2: `lambda.name` is `Brake Dark`, which is not a lambda name",
        "a lambda name has 1 to 63 lower-case letters, digits and hyphens and begins with a \
         letter, for example `brake-dark`",
    );
    refused_with(
        "entry = \"brake_dark.wasm\"",
        "entry = \"../brake_dark.wasm\"",
        "lambda.toml, line 5: `lambda.entry` is `../brake_dark.wasm`, which is not a path inside \
         the lambda's folder",
        "give a path relative to the lambda's folder, without `..`, for example \
         `models/detector.onnx`",
    );
    refused_with(
        "type = \"sensor_msgs/msg/Imu\"",
        "type = \"sensor_msgs/Imu\"",
        "lambda.toml, line 20: `input.type` is `sensor_msgs/Imu`, which is not a message type",
        "a ROS 2 type has three parts, `package/msg/Type`, for example `sensor_msgs/msg/Imu`",
    );
    refused_with(
        "topic = \"/imu/data\"",
        "topic = \"imu/data\"",
        "lambda.toml, line 19: `input.topic` is `imu/data`, which is not a topic name",
        "a topic begins with `/` and has parts of letters, digits and `_`, none beginning with a \
         digit, for example `/camera/front`",
    );
    refused_with(
        "version = \"0.1.0\"",
        "version = \"1.0\"",
        "lambda.toml, line 3: `lambda.version` is `1.0`, which is not a version",
        "a version is `major.minor.patch`, for example `0.1.0` or `1.0.0-rc.1`",
    );
    refused_below(
        "[[model]]\nname = \"m\"\nfile = \"m.onnx\"\nsha256 = \"abc\"",
        "lambda.toml, line 11: `model.sha256` is `abc`, which is not a sha256",
        "a sha256 has 64 lower-case hexadecimal digits: the first column that `sha256sum FILE` \
         prints",
    );
    refused_below(
        "[config]\n\"a=b\" = 1",
        "lambda.toml, line 9: `config.a=b` is `a=b`, which is not a name",
        "a name has 1 to 63 lower-case letters, digits, `_` and `-` and begins with a letter, for \
         example `front_camera`",
    );
    refused_with(
        "preroll = \"5s\"",
        "preroll = \"5 seconds\"",
        "lambda.toml, line 24: `record.preroll` is `5 seconds`, which is not a duration",
        "write a number and its unit, us, ms, s, min or h, for example \"50ms\" or \"1.5s\"",
    );
    refused_with(
        "max_size = \"2 MiB\"",
        "max_size = \"2 MB\"",
        "lambda.toml, line 15: `input.max_size` is `2 MB`, which is not a size",
        "write a whole number and its unit, B, KiB, MiB or GiB, for example \"2 MiB\"",
    );
}

#[test]
fn words_outside_of_a_choice_are_refused() {
    refused_with(
        "kind = \"wasm\"",
        "kind = \"rust\"",
        "lambda.toml, line 4: `lambda.kind` is `rust`, not `wasm` or `python`",
        "write `wasm` or `python`",
    );
    refused_with(
        "backlog = \"latest\"",
        "backlog = \"last\"",
        "lambda.toml, line 9: `schedule.backlog` is `last`, not `each` or `latest`",
        "write `each` or `latest`",
    );
    refused_with(
        "store = \"ram\"",
        "store = \"rom\"",
        "lambda.toml, line 26: `record.store` is `rom`, not `ram` or `disk`",
        "did you mean `ram`?",
    );
    refused_with(
        "qos = \"auto\"",
        "qos = \"best\"",
        "lambda.toml, line 16: `input.qos` is `best`, not `auto`",
        "write `auto`",
    );
}

#[test]
fn models_have_known_layouts_providers_and_digests() {
    let model = |more: &str| {
        let digest = "0".repeat(64);
        format!("[[model]]\nname = \"m\"\nfile = \"m.onnx\"\nsha256 = \"{digest}\"\n{more}")
    };
    refused_below(
        &model("layout = \"yolov3\""),
        "lambda.toml, line 12: `model.layout` is `yolov3`, not `ultralytics`, `yolox`, `nms-free` \
         or `nanodet`",
        "did you mean `yolox`?",
    );
    refused_below(
        &model("providers = [\"cpu\", \"gpu\"]"),
        "lambda.toml, line 12: `model.providers` is `gpu`, not `tensorrt`, `cuda`, `cpu`, \
         `onnxruntime` or `rten`",
        "did you mean `cpu`?",
    );
}

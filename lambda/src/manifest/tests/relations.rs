//! Tests refusals that involve several keys, or a file.

use super::*;
use gleaner_test_support::TestFolder;

#[test]
fn a_duplicate_is_refused_with_both_lines() {
    let topics = input("a", "/x", "") + &input("b", "/x", "");
    let help = "keep one [[input]] entry per topic";
    refused_below(&topics, "topic `/x` is listed twice in lambda.toml, lines 10 and 15", help);
    let names = input("a", "/x", "") + &input("a", "/y", "");
    let help = "give each [[input]] a name of its own";
    refused_below(&names, "input `a` is listed twice in lambda.toml, lines 9 and 14", help);
    refused_below(
        "[record]\ntopics = [\n\"/a\",\n\"/b\",\n\"/a\"]",
        "topic `/a` is listed twice in lambda.toml, lines 10 and 12",
        "list each topic of [record] once",
    );
    let model = format!("[[model]]\nname = \"m\"\nfile = \"m\"\nsha256 = \"{}\"\n", "0".repeat(64));
    let help = "give each [[model]] a name of its own";
    refused_below(
        &model.repeat(2),
        "model `m` is listed twice in lambda.toml, lines 9 and 13",
        help,
    );
    let help = "keep one of the two";
    refused_below(
        "[limits]\nfuel = 1000\nfuel = 2000",
        "key `fuel` is listed twice in lambda.toml, lines 9 and 10",
        help,
    );
    refused_below(
        "[schedule]",
        "table `schedule` is listed twice in lambda.toml, lines 6 and 8",
        help,
    );
}

#[test]
fn a_schedule_is_one_input_or_one_period() {
    refused_with(
        "backlog = \"latest\"",
        "period = \"1s\"",
        "lambda.toml, line 9: `schedule.period` conflicts with the other kind of schedule",
        "keep `event` or `period`: a lambda runs on one input or on the clock",
    );
    refused_with(
        "event = \"camera\"",
        "",
        "lambda.toml, line 7: `schedule` has neither `event` nor `period`",
        "add event = \"<an input's name>\" or period = \"100ms\"",
    );
    refused_with(
        "event = \"camera\"",
        "period = \"1s\"",
        "lambda.toml, line 9: `schedule.backlog` has no meaning with `period`",
        "remove it: missed ticks are counted, never queued",
    );
}

#[test]
fn an_event_is_an_input() {
    refused_with(
        "event = \"camera\"",
        "event = \"camrea\"",
        "lambda.toml, line 8: `schedule.event` is `camrea`, which is not the name of an input",
        "did you mean `camera`? the inputs are `camera` and `imu`",
    );
    refused_with(
        "event = \"camera\"",
        "event = \"lidar\"",
        "lambda.toml, line 8: `schedule.event` is `lidar`, which is not the name of an input",
        "the inputs are `camera` and `imu`",
    );
    refused(
        &TICKER.replace("period = \"100ms\"", "event = \"imu\""),
        "lambda.toml, line 7: `schedule.event` is `imu`, which is not the name of an input",
        "add an [[input]] with name = \"imu\"; there is none yet",
    );
}

#[test]
fn keys_without_meaning_where_they_stand_are_refused() {
    refused_below(
        &input("imu", "/imu", "decoded_size = \"1 MiB\""),
        "lambda.toml, line 12: `input.decoded_size` has no meaning for sensor_msgs/msg/Imu",
        "remove it: only sensor_msgs/msg/CompressedImage is decoded",
    );
    refused_below(
        "[record]\ntopics = []",
        "lambda.toml, line 9: `record.topics` is empty",
        "list what a clip holds, or remove [record]",
    );
    for (key, problem, help) in [
        (
            "rate_hz = 3",
            "`demand.rate_hz` has no meaning with `period`",
            "remove it: the period states the rate",
        ),
        (
            "fuel = 1000",
            "`demand.fuel` has no meaning with kind = \"python\"",
            "state `cpu`, the CPU time of a wake: Python has no fuel",
        ),
        (
            "model_time = \"1ms\"",
            "`demand.model_time` has no meaning without a [[model]]",
            "remove it, or add the model",
        ),
    ] {
        let problem = format!("lambda.toml, line 9: {problem}");
        refused_below(&format!("[demand]\n{key}"), &problem, help);
    }
    refused_below(
        "[config]\non = { default = true, min = 0 }",
        "lambda.toml, line 9: `config.on.min` has no meaning here",
        "remove it: only numbers have limits",
    );
}

#[test]
fn invalid_toml_is_refused_with_its_line() {
    let help = "write `key = value` with texts in quotes, and tables as [name], \
                or as [[name]] where there can be several";
    refused_below(
        "[limits]\nfuel 3",
        "lambda.toml, line 9: invalid TOML: key with no value, expected `=`",
        help,
    );
    let deep = format!("x = {}", "[".repeat(100_000));
    refused(
        &deep,
        "lambda.toml, line 1: invalid TOML: cannot recurse further; max recursion depth met",
        help,
    );
}

#[test]
fn messages_are_short_and_have_no_control_characters() {
    let long = format!("{}\\u001B[2J", "x".repeat(70)) + &"y".repeat(100_000);
    let error = Manifest::parse(
        &BRAKE_DARK.replace("\"camera\"\nbacklog", &format!("\"{long}\"\nbacklog")),
        "lambda.toml",
    );
    let message = error.unwrap_err().to_string();
    assert!(message.len() < 200 && message.contains("\\u{1b}[2Jyy"), "{message}");
}

#[test]
fn no_prefix_of_a_manifest_makes_the_parser_panic() {
    for end in 0..BRAKE_DARK.len() {
        let _ = Manifest::parse(&BRAKE_DARK[..end], "lambda.toml");
        let _ = Manifest::parse(&BRAKE_DARK[end..], "lambda.toml");
        let without = format!("{}{}", &BRAKE_DARK[..end], &BRAKE_DARK[end + 1..]);
        let _ = Manifest::parse(&without, "lambda.toml");
    }
}

#[test]
fn a_manifest_is_loaded_from_its_folder_and_named_by_its_path() {
    let dir = TestFolder::new();
    let path = dir.write("lambda.toml", TICKER);
    assert_eq!(
        Manifest::load(dir.root()).unwrap(),
        Manifest::parse(TICKER, "lambda.toml").unwrap()
    );
    dir.write("lambda.toml", "\n[lamda]");
    let message = Manifest::load(dir.root()).unwrap_err().to_string();
    assert_eq!(
        message,
        format!("{}, line 2: unknown key `lamda` at the top level", path.display())
    );
}

#[test]
fn a_file_that_cannot_be_a_manifest_is_refused() {
    let dir = TestFolder::new();
    let path = dir.path("lambda.toml");
    let refused = |message: String, help: &str| {
        let error = Manifest::load(dir.root()).unwrap_err();
        assert_eq!((error.to_string(), error.help().as_deref()), (message, Some(help)));
    };
    refused(format!("cannot read `{}`", path.display()), "name a folder that has a lambda.toml");
    std::fs::write(&path, b"\xff\xfe").unwrap();
    refused(format!("cannot read `{}`", path.display()), "save it as UTF-8");
    std::fs::write(&path, " ".repeat((1 << 20) + 1)).unwrap();
    refused(
        format!("`{}` is longer than 1 MiB", path.display()),
        "check that this is a manifest; data of a lambda belongs in files of its own",
    );
}

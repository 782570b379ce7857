//! Tests that every number has a minimum and a maximum, and every list a maximum length.

use super::super::limit::Limit;
use super::*;

/// Asserts that the value in line `line` is refused as out of range.
#[track_caller]
fn out_of_bounds(more: &str, line: usize, problem: &str, help: &str) {
    refused_below(more, &format!("lambda.toml, line {line}: {problem}"), help);
}

#[test]
fn every_limit_has_a_minimum_and_a_maximum() {
    let help = "give a value from 1000 to 1000000000000";
    out_of_bounds(
        "[limits]\nfuel = 999",
        9,
        "`limits.fuel` is 999, below the minimum of 1000",
        help,
    );
    out_of_bounds("[limits]\nfuel = -1", 9, "`limits.fuel` is -1, below the minimum of 1000", help);
    let problem = "`limits.fuel` is 1000000000001, above the maximum of 1000000000000";
    out_of_bounds("[limits]\nfuel = 1_000_000_000_001", 9, problem, help);
    let help = "give a value from 1ms to 1min";
    let problem = "`limits.deadline` is 999us, below the minimum of 1ms";
    out_of_bounds("[limits]\ndeadline = \"999us\"", 9, problem, help);
    let problem = "`limits.deadline` is 61s, above the maximum of 1min";
    out_of_bounds("[limits]\ndeadline = \"61s\"", 9, problem, help);
    let help = "give a value from 1 MiB to 1 GiB";
    let problem = "`limits.memory` is 1 KiB, below the minimum of 1 MiB";
    out_of_bounds("[limits]\nmemory = \"1 KiB\"", 9, problem, help);
    out_of_bounds(
        "[limits]\nmemory = -5",
        9,
        "`limits.memory` is -5, below the minimum of 1 MiB",
        help,
    );
    let problem = "`limits.memory` is 2 GiB, above the maximum of 1 GiB";
    out_of_bounds("[limits]\nmemory = 2147483648", 9, problem, help);
}

#[test]
fn a_demand_has_bounds_and_needs_none_of_its_keys() {
    let demand = |text: &str| {
        let text = format!("{TICKER}[demand]\n{text}");
        Manifest::parse(&text, "lambda.toml").unwrap().demand
    };
    assert_eq!(demand(""), Demand::default());
    let cpu = Some(Duration::from_micros(1500));
    assert_eq!(demand("cpu = \"1.5ms\""), Demand { cpu, ..Demand::default() });
    out_of_bounds(
        "[demand]\ncpu = \"0s\"",
        9,
        "`demand.cpu` is 0s, below the minimum of 1us",
        "give a value from 1us to 1min",
    );
    let event = BRAKE_DARK.replace("[schedule]", "[demand]\nrate_hz = RATE\n[schedule]");
    let rate = |rate: &str| Manifest::parse(&event.replace("RATE", rate), "lambda.toml");
    assert_eq!(rate("30").unwrap().demand.rate_hz, Some(30.0));
    assert_eq!(rate("0.5").unwrap().demand.rate_hz, Some(0.5));
    for wrong in ["0", "inf", "-1.0", "10_001", "\"30 Hz\""] {
        let error = rate(wrong).unwrap_err().to_string();
        assert!(error.contains("`demand.rate_hz` is "), "{wrong}: {error}");
    }
}

#[test]
fn every_limit_is_refused_just_outside_of_its_bounds() {
    for Limit { key, unit, plain: [min, _, max], .. } in Limits::table() {
        let shown = |plain: u64| match unit {
            "number" => plain.to_string(),
            "size" => ByteSize::new(plain).to_string(),
            _ => format_duration(Duration::from_nanos(plain)),
        };
        let written = |plain: u64| match unit {
            "duration" => format!("\"{}\"", shown(plain)),
            _ => plain.to_string(),
        };
        let help = format!("give a value from {} to {}", shown(min), shown(max));
        let below = min
            .checked_sub(1)
            .map_or(("-1".to_owned(), "-1".to_owned()), |less| (written(less), shown(less)));
        for ((value, value_shown), side) in [
            (below, format!("below the minimum of {}", shown(min))),
            ((written(max + 1), shown(max + 1)), format!("above the maximum of {}", shown(max))),
        ] {
            let problem = format!("`limits.{key}` is {value_shown}, {side}");
            out_of_bounds(&format!("[limits]\n{key} = {value}"), 9, &problem, &help);
        }
    }
}

#[test]
fn recording_and_models_have_bounds() {
    let help = "give a value from 0s to 10min";
    for key in ["preroll", "postroll"] {
        let problem = format!("`record.{key}` is 11min, above the maximum of 10min");
        out_of_bounds(
            &format!("[record]\ntopics = [\"/a\"]\n{key} = \"11min\""),
            10,
            &problem,
            help,
        );
    }
    let problem = "`record.cooldown` is 61min, above the maximum of 1h";
    out_of_bounds(
        "[record]\ntopics = [\"/a\"]\ncooldown = \"61min\"",
        10,
        problem,
        "give a value from 0s to 1h",
    );
    let help = "give a value from 1s to 1h";
    for (length, problem) in
        [("999ms", "999ms, below the minimum of 1s"), ("61min", "61min, above the maximum of 1h")]
    {
        let problem = format!("`record.max_length` is {problem}");
        out_of_bounds(
            &format!("[record]\ntopics = [\"/a\"]\nmax_length = \"{length}\""),
            10,
            &problem,
            help,
        );
    }
    let sha256 = "0".repeat(64);
    let model =
        format!("[[model]]\nname = \"m\"\nfile = \"m\"\nsha256 = \"{sha256}\"\nthreads = 65");
    out_of_bounds(
        &model,
        12,
        "`model.threads` is 65, above the maximum of 64",
        "give a value from 1 to 64",
    );
}

#[test]
fn the_bounds_of_the_preroll_size_are_those_of_its_store() {
    let (ram, disk) = ("give a value from 1 MiB to 1 GiB", "give a value from 16 MiB to 256 GiB");
    for (store, size, problem, help) in [
        ("ram", "1023 KiB", "1023 KiB, below the minimum of 1 MiB", ram),
        ("ram", "1025 MiB", "1025 MiB, above the maximum of 1 GiB", ram),
        ("disk", "15 MiB", "15 MiB, below the minimum of 16 MiB", disk),
        ("disk", "257 GiB", "257 GiB, above the maximum of 256 GiB", disk),
    ] {
        let more =
            format!("[record]\ntopics = [\"/a\"]\npreroll_size = \"{size}\"\nstore = \"{store}\"");
        out_of_bounds(&more, 10, &format!("`record.preroll_size` is {problem}"), help);
    }
    let more = "[record]\ntopics = [\"/a\"]\npreroll_size = -1";
    out_of_bounds(more, 10, "`record.preroll_size` is -1, below the minimum of 1 MiB", ram);
}

#[test]
fn inputs_and_the_period_have_bounds() {
    let cases = [
        ("depth = 0", "`input.depth` is 0, below the minimum of 1", "give a value from 1 to 65536"),
        (
            "depth = 65537",
            "`input.depth` is 65537, above the maximum of 65536",
            "give a value from 1 to 65536",
        ),
        ("hold = 0", "`input.hold` is 0, below the minimum of 1", "give a value from 1 to 1024"),
        (
            "hold = 1025",
            "`input.hold` is 1025, above the maximum of 1024",
            "give a value from 1 to 1024",
        ),
        (
            "max_size = 0",
            "`input.max_size` is 0 B, below the minimum of 1 B",
            "give a value from 1 B to 256 MiB",
        ),
        (
            "max_size = \"257 MiB\"",
            "`input.max_size` is 257 MiB, above the maximum of 256 MiB",
            "give a value from 1 B to 256 MiB",
        ),
        (
            "qos = { depth = 0 }",
            "`input.qos.depth` is 0, below the minimum of 1",
            "give a value from 1 to 65536",
        ),
    ];
    for (line, problem, help) in cases {
        out_of_bounds(&input("imu", "/imu", line), 12, problem, help);
    }
    for (period, problem) in
        [("900us", "900us, below the minimum of 1ms"), ("2h", "2h, above the maximum of 1h")]
    {
        let message = format!("lambda.toml, line 7: `schedule.period` is {problem}");
        refused(&TICKER.replace("100ms", period), &message, "give a value from 1ms to 1h");
    }
}

#[test]
fn numbers_beyond_every_integer_type_are_only_too_large() {
    let nines = "9".repeat(60);
    let max = i128::MAX;
    let problem = format!("`limits.fuel` is {max}, above the maximum of 1000000000000");
    out_of_bounds(
        &format!("[limits]\nfuel = {nines}"),
        9,
        &problem,
        "give a value from 1000 to 1000000000000",
    );
    let problem = format!("`config.x` is {max}, above the maximum of {}", i64::MAX);
    let help = format!("give a value from {} to {}", i64::MIN, i64::MAX);
    out_of_bounds(&format!("[config]\nx = {nines}"), 9, &problem, &help);
}

#[test]
fn inputs_may_not_exceed_their_total_memory() {
    let text = input("wide", "/wide", "depth = 2\nhold = 1\nmax_size = \"256 MiB\"")
        + &input("deep", "/deep", "depth = 65536\nhold = 1024\nmax_size = \"20 KiB\"");
    refused_below(
        &text,
        "the inputs in lambda.toml need 2325 MiB together, above the maximum of 2 GiB: \
         `wide` (line 8) 1024 MiB, `deep` (line 15) 1301 MiB",
        "lower `depth`, `hold` or `max_size`: an input takes (depth + hold + 1) x max_size, \
         and (hold + 1) x decoded_size for compressed images",
    );
}

#[test]
fn config_items_agree_with_their_own_limits() {
    let item = |text: &str| format!("[config]\nx = {{ {text} }}");
    let help = "give a value from 0.0 to 2.0";
    out_of_bounds(
        &item("default = 3.0, min = 0, max = 2"),
        9,
        "`config.x.default` is 3.0, above the maximum of 2.0",
        help,
    );
    out_of_bounds(
        &item("default = -3, min = 0"),
        9,
        "`config.x.default` is -3, below the minimum of 0",
        "give 0 or more",
    );
    out_of_bounds(
        &item("default = 3, max = 2"),
        9,
        "`config.x.default` is 3, above the maximum of 2",
        "give 2 or less",
    );
    let problem = "`config.x.max` is 1, below `min`, which is 2";
    out_of_bounds(&item("default = 1, min = 2, max = 1"), 9, problem, "give a `max` above `min`");
    let problem = "`config.x.min` is a number with a fraction";
    out_of_bounds(
        &item("default = 1, min = 0.5"),
        9,
        problem,
        "give a whole number, as `default` is one",
    );
    out_of_bounds(
        &item("default = 1.0, min = \"a\""),
        9,
        "`config.x.min` is a text",
        "give a number, as `default` is one",
    );
    let problem = "`config.x.default` is `nan`, which is not a finite number";
    out_of_bounds(
        &item("default = nan"),
        9,
        problem,
        "give a number that is neither infinite nor nan",
    );
}

#[test]
fn lists_have_a_maximum() {
    let topics: Vec<_> = (0..257).map(|n| format!("\"/t{n}\"")).collect();
    let problem = "`record.topics` has 257 entries, above the maximum of 256";
    out_of_bounds(
        &format!("[record]\ntopics = [{}]", topics.join(", ")),
        9,
        problem,
        "keep 256 or fewer",
    );
    let items: String = (0..257).map(|n| format!("x{n} = 1\n")).collect();
    let problem = "`config` has 257 keys, above the maximum of 256";
    out_of_bounds(&format!("[config]\n{items}"), 8, problem, "keep 256 or fewer");
}

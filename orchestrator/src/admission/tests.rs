//! Tests of demands, of refusals and of measurements, without any process.

use std::collections::BTreeMap;

use gleaner_base::{ByteSize, Failure};
use gleaner_lambda::manifest::{ItemName, LambdaKind, Sha256};
use gleaner_lambda::{Manifest, Vehicle};
use gleaner_protocol::LiveStatus;
use gleaner_protocol::inference::{InferenceStatus, LoadedModel, ModelState};
use gleaner_protocol::supervision::{LambdaPhase, LambdaStatus, ProcessStatus, SupervisorStatus};

use super::demand::DemandModel;
use super::measured::MeasuredUse;
use super::{Budgets, LambdaDemand, Measurements};
use crate::durable::DurableFile;

fn digest(digit: char) -> Sha256 {
    digit.to_string().repeat(64).parse().unwrap()
}

fn id(text: &str) -> ItemName {
    text.parse().unwrap()
}

/// A manifest with this schedule, and with more tables.
fn manifest(kind: &str, schedule: &str, more: &str) -> Manifest {
    let text = format!(
        "[lambda]\nname = \"test\"\nversion = \"0.1.0\"\nkind = \"{kind}\"\nentry = \"main.py\"\n\
         [schedule]\n{schedule}\n{more}\n"
    );
    Manifest::parse(&text, "lambda.toml").unwrap()
}

fn input(topic: &str, type_name: &str, more: &str) -> String {
    format!(
        "[[input]]\nname = \"it\"\ntopic = \"{topic}\"\ntype = \"sensor_msgs/msg/{type_name}\"\n{more}\n"
    )
}

fn model(more: &str) -> String {
    let sha256 = digest('c');
    format!("[[model]]\nname = \"m\"\nfile = \"m.onnx\"\nsha256 = \"{sha256}\"\n{more}\n")
}

/// The demand of a manifest on a machine with 1e9 fuel units per second.
fn demand(manifest: &Manifest, used: Option<MeasuredUse>, run_s: Option<f64>) -> LambdaDemand {
    let uses = used.into_iter().map(|used| (digest('a'), used)).collect();
    let models = run_s.into_iter().map(|run_s| (digest('c'), run_s)).collect();
    let model = DemandModel { fuel_per_s: 1e9, uses: &uses, models: &models };
    model.of(&[(digest('a'), manifest.clone())]).unwrap()
}

fn used(cpu: f64, wakes: f64, model_time: f64) -> Option<MeasuredUse> {
    Some(MeasuredUse { cpu, wakes, model_time, is_reported: false })
}

#[test]
fn what_is_stated_counts_before_what_was_measured_and_that_before_an_assumption() {
    let imu = input("/imu", "Imu", "");
    let camera = input("/camera", "Image", "");
    let stated = |keys: &str| format!("{imu}[demand]\n{keys}");
    let (event, period) = ("event = \"it\"", "period = \"10ms\"");
    let tick = "[demand]\ncpu = \"2ms\"";
    let cases = [
        ("wasm", period, String::new(), None, 0.1, "assumed: 100 wakes/s of 1 ms"),
        ("python", period, String::new(), None, 0.2, "assumed: 100 wakes/s of 2 ms"),
        ("python", "period = \"1ms\"", String::new(), None, 0.5, "assumed: 1000 wakes/s of 2 ms"),
        ("wasm", event, imu.clone(), None, 0.1, "assumed: 100 wakes/s of 1 ms"),
        ("wasm", event, camera, None, 0.03, "assumed: 30 wakes/s of 1 ms"),
        ("wasm", event, imu.clone(), used(0.3, 50.0, 0.0), 0.3, "measured: its busiest minute"),
        ("wasm", period, tick.into(), None, 0.2, "stated: 100 wakes/s of 2ms"),
        ("wasm", period, tick.into(), used(0.1, 100.0, 0.0), 0.2, "stated: 100 wakes/s of 2ms"),
        (
            "wasm",
            period,
            tick.into(),
            used(0.4, 100.0, 0.0),
            0.4,
            "measured: its busiest minute, above stated: 100 wakes/s of 2ms",
        ),
        (
            "wasm",
            event,
            stated("rate_hz = 200\nfuel = 1_700_000"),
            None,
            0.4,
            "stated: 200 wakes/s of 1,700,000 fuel units at 1,000 M/s",
        ),
        // A rate that is not stated makes the product uncertain.
        ("wasm", event, stated("cpu = \"2ms\""), None, 0.2, "assumed: 100 wakes/s of 2ms"),
        (
            "wasm",
            event,
            stated("cpu = \"2ms\""),
            used(0.01, 10.0, 0.0),
            0.02,
            "measured: 10 wakes/s of 2ms",
        ),
    ];
    for (kind, schedule, more, used, cores, source) in cases {
        let cpu = demand(&manifest(kind, schedule, &more), used, None).cpu;
        assert!((cpu.amount - cores).abs() < 1e-9, "{source}: {cpu:?}");
        assert_eq!(cpu.source(), source);
        assert_eq!(cpu.peak, used.map(|used| used.cpu));
    }
}

#[test]
fn only_what_exceeds_the_stated_demand_clearly_is_reported() {
    let of = |more: &str, cores: f64| {
        let manifest = manifest("wasm", "period = \"10ms\"", more);
        let cpu = demand(&manifest, used(cores, 100.0, 0.0), None).cpu;
        (cpu.amount, cpu.exceeds)
    };
    let stated = "[demand]\ncpu = \"2ms\"";
    assert_eq!(of(stated, 0.19), (0.2, false));
    assert_eq!(of(stated, 0.22), (0.22, false));
    assert_eq!(of(stated, 0.24), (0.24, true));
    assert_eq!(of("[demand]\ncpu = \"1us\"", 0.005), (0.005, false), "of the process itself");
    assert_eq!(of("", 0.9), (0.9, false));
}

#[test]
fn models_take_model_time_and_cores_unless_they_run_on_an_accelerator() {
    let of = |more: &str, used, run_s| {
        let manifest = manifest("wasm", "period = \"100ms\"", more);
        let demand = demand(&manifest, used, run_s);
        let rounded = |number: f64| (number * 1000.0).round() / 1000.0;
        let (cpu, models) = (rounded(demand.cpu.amount), rounded(demand.model_time.amount));
        (cpu, models, demand.model_time.source())
    };
    let text = |source: &str| source.to_owned();
    assert_eq!(of("", None, None), (0.01, 0.0, text("of its limits")));
    let assumed = "assumed: 10 wakes/s of 20 ms";
    assert_eq!(of(&model(""), None, None), (0.21, 0.2, text(assumed)));
    assert_eq!(of(&model("providers = [\"cuda\", \"cpu\"]"), None, None).0, 0.01);
    // Of a model that another lambda runs, the time is known.
    let known = "measured: 10 wakes/s of 5 ms";
    assert_eq!(of(&model("threads = 2"), None, Some(0.005)), (0.11, 0.05, text(known)));
    let stated = model("[demand]\nmodel_time = \"3ms\"");
    let source = "stated: 10 wakes/s of 3ms";
    assert_eq!(of(&stated, used(0.02, 10.0, 0.01), Some(0.005)), (0.05, 0.03, text(source)));
    let (_, models, source) = of(&stated, used(0.02, 10.0, 0.09), Some(0.005));
    assert_eq!((models, source.starts_with("measured: ")), (0.09, true));
}

/// A demand of nothing but these.
fn asks(cpu: &str, topic: Option<(&str, u64)>) -> LambdaDemand {
    let more = format!("[demand]\ncpu = \"{cpu}\"");
    let mut demand = demand(&manifest("wasm", "period = \"100ms\"", &more), None, None);
    demand.topics =
        topic.into_iter().map(|(name, mib)| (name.parse().unwrap(), mib << 20)).collect();
    demand
}

fn admit(
    budgets: &Budgets,
    name: &str,
    asked: &LambdaDemand,
    wanted: &[(&str, &LambdaDemand)],
) -> Result<(), Failure> {
    let wanted = wanted.iter().map(|(name, demand)| (id(name), (*demand).clone())).collect();
    budgets.admit(&id(name), asked, &wanted)
}

fn budgets(cores: usize) -> Budgets {
    Budgets::on(&Vehicle::default(), ByteSize::gib(4).bytes(), cores)
}

#[test]
fn a_refusal_names_the_resource_all_numbers_and_their_origin() {
    let small = asks("10ms", None);
    let large = asks("160ms", None);
    let refused = admit(&budgets(2), "large", &large, &[("a", &small)]).unwrap_err();
    assert_eq!(refused.message, "there is no CPU time for deployment `large`");
    assert_eq!(
        refused.causes,
        [
            "it asks for 1.60 cores, the other deployments for 0.10 cores, and all may ask for \
             1.60 cores (80 % of the machine's 2 cores)",
            "its demand is stated: 10 wakes/s of 160ms"
        ]
    );
    admit(&budgets(2), "large", &large, &[]).unwrap();
    admit(&budgets(3), "large", &large, &[("a", &small)]).unwrap();
}

#[test]
fn a_deployment_counts_instead_of_the_one_that_it_replaces() {
    let [less, half, more] = ["40ms", "80ms", "120ms"].map(|cpu| asks(cpu, None));
    let one = budgets(1);
    admit(&one, "a", &half, &[("a", &half)]).unwrap();
    admit(&one, "a", &more, &[("a", &half)]).unwrap_err();
    // Others use more than they did when they were admitted: what asks for less is no reason to
    // refuse it.
    let busy = asks("90ms", None);
    admit(&one, "a", &less, &[("a", &half), ("b", &busy)]).unwrap();
    admit(&one, "a", &more, &[("a", &half), ("b", &busy)]).unwrap_err();
    admit(&one, "c", &less, &[("b", &busy)]).unwrap_err();
}

#[test]
fn lambdas_share_the_memory_of_a_topic() {
    let [small, large] = [600, 900].map(|mib| asks("1ms", Some(("/image", mib))));
    admit(&budgets(1), "b", &large, &[("a", &small)]).unwrap();
    let other = asks("1ms", Some(("/lidar", 200)));
    let refused = admit(&budgets(1), "b", &large, &[("a", &small), ("c", &other)]).unwrap_err();
    assert!(refused.message.contains("shared memory for the topics of deployment `b`"));
    let numbers =
        "it asks for 300 MiB, the other deployments for 800 MiB, and all may ask for 1 GiB";
    assert!(refused.causes[0].starts_with(numbers), "{refused:?}");
}

#[test]
fn a_deployment_asks_for_the_larger_of_its_revision_and_its_fallback() {
    let revision = manifest("wasm", "period = \"100ms\"", "[limits]\nmemory = \"1 MiB\"");
    let fallback = manifest("python", "period = \"10ms\"", &input("/imu", "Imu", ""));
    let (uses, models) = (BTreeMap::new(), BTreeMap::new());
    let model = DemandModel { fuel_per_s: 1e9, uses: &uses, models: &models };
    let both = model.of(&[(digest('a'), revision), (digest('b'), fallback.clone())]).unwrap();
    assert_eq!(both, demand(&fallback, None, None));
}

/// A status with one lambda, which has run for `up_s`.
fn status(up_s: f64, cpu_s: f64, wakes: u64, restarts: u32, runs: u64) -> SupervisorStatus {
    let status = LiveStatus::new("test", "0.1.0", LambdaKind::Wasm, "out".into());
    let live = LiveStatus { restarts, up_s, wakes, rss_bytes: 1000, cpu_s, ..status };
    let lambda = LambdaStatus {
        id: "test".to_owned(),
        name: "test".to_owned(),
        revision: digest('a').to_string(),
        attempt: 1,
        phase: LambdaPhase::Running,
        phase_s: up_s,
        restarts,
        live: Some(Box::new(live)),
        ..LambdaStatus::default()
    };
    let model = LoadedModel {
        sha256: digest('c').to_string(),
        path: "m.onnx".to_owned(),
        threads: 1,
        lambdas: vec!["test".to_owned(), "other".to_owned()],
        state: ModelState::Ready,
        runs,
        run_ns: runs * 5_000_000,
        ..LoadedModel::default()
    };
    let last = InferenceStatus { models: vec![model], ..InferenceStatus::default() };
    let inference = ProcessStatus { last: Some(Box::new(last)), ..ProcessStatus::default() };
    SupervisorStatus {
        lambdas: vec![lambda],
        inference: Some(inference),
        ..SupervisorStatus::default()
    }
}

#[test]
fn the_busiest_minute_counts_and_survives_a_restart_of_the_program() {
    let folder = tempfile::tempdir().unwrap();
    let load = || Measurements::load(DurableFile::new(folder.path().join("measured.json")));
    let (mut measured, damage) = load();
    assert_eq!(damage, None);
    let peak = |measured: &Measurements| measured.model().uses.get(&digest('a')).copied();
    // What was used before, as by `init`, does not count.
    assert!(!measured.observe(&status(100.0, 50.0, 1000, 0, 100)));
    assert!(!measured.observe(&status(130.0, 53.0, 1300, 0, 400)));
    assert_eq!(peak(&measured), None);
    assert_eq!(measured.current(&status(130.0, 53.0, 1300, 0, 400)).cpu, Some(0.1));
    // The runs of two lambdas; each of them has had one at each wake at most.
    assert!(measured.observe(&status(160.0, 62.0, 1600, 0, 1900)));
    let busy = used(0.2, 10.0, 0.05).unwrap();
    assert_eq!(peak(&measured), Some(busy));
    assert_eq!(measured.model().models.get(&digest('c')), Some(&0.005));
    assert!(measured.observe(&status(220.0, 65.0, 1900, 0, 1900)), "a quiet minute");
    assert_eq!(peak(&measured), Some(busy));
    // After a restart, the time of its start does not count.
    assert!(!measured.observe(&status(221.0, 165.0, 1901, 1, 1900)));
    assert!(!measured.observe(&status(280.0, 168.0, 2000, 1, 1900)));
    assert!(measured.report(&digest('a')) && !measured.report(&digest('a')), "once");
    measured.set_speed("board".to_owned(), 3e9);
    let (measured, _) = load();
    assert_eq!(peak(&measured), Some(MeasuredUse { is_reported: true, ..busy }));
    assert!(measured.has_speed_of("board") && !measured.has_speed_of("other"));
    assert_eq!(measured.model().fuel_per_s, 3e9);
}

#[test]
fn absurd_measurements_in_the_file_do_not_count() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("measured.json");
    let of = |uses: serde_json::Value, models: serde_json::Value, machine: serde_json::Value| {
        let content = serde_json::json!({ "machine": machine, "uses": uses, "models": models });
        DurableFile::new(path.clone()).save(&content).unwrap();
        Measurements::load(DurableFile::new(path.clone()))
    };
    let used = |cpu: f64, wakes: f64, model_time: f64| serde_json::json!({ "cpu": cpu, "wakes": wakes, "model_time": model_time });
    let manifest = manifest("python", "period = \"10ms\"", "");
    for (cpu, wakes, time) in [(1e308, 1.0, 0.0), (0.1, -1.0, 0.0), (0.1, 1.0, f64::MAX)] {
        let uses = serde_json::json!({ digest('a').as_str(): used(cpu, wakes, time) });
        let models = serde_json::json!({ digest('c').as_str(): -1e308 });
        let (measured, damage) = of(uses, models, serde_json::json!(["machine", 1e308]));
        assert_eq!(damage, None);
        assert!(!measured.has_speed_of("machine"));
        let demand = measured.model().of(&[(digest('a'), manifest.clone())]).unwrap();
        assert!(demand.cpu.source().starts_with("assumed: "), "{demand:?}");
        assert!(demand.cpu.amount.is_finite() && demand.cpu.peak.is_none(), "{demand:?}");
    }
    // What is no table of measurements at all is damage, and all is measured again.
    for uses in [serde_json::json!(vec![0; 1_000_000]), serde_json::json!({ "x": {} })] {
        let (measured, damage) = of(uses, serde_json::json!({}), serde_json::Value::Null);
        let damage = damage.unwrap();
        assert!(damage.contains("measured.json") && damage.contains("measured again"), "{damage}");
        assert!(measured.model().uses.is_empty());
    }
}

//! Lambdas that run, and whose wakes fault.

use gleaner_protocol::supervision::{EventKind, LambdaPhase};
use gleaner_tests::vehicle::{TestVehicle, text};

use super::{PythonLambda, events};

const HARMLESS: &str = "def on_tick(self, ctx):\n    pass";
/// Seven wakes of eight are faults: never as many in a row as make the host skip wakes.
const FAULTY: &str = "wakes = 0\n\
                      def __init__(self, ctx):\n\
                      \u{20}   pass\n\
                      def on_tick(self, ctx):\n\
                      \u{20}   Lambda.wakes += 1\n\
                      \u{20}   if Lambda.wakes % 8:\n\
                      \u{20}       raise ValueError('no')";

pub fn probation() {
    let mut vehicle = TestVehicle::started();
    let lambda = PythonLambda::new("guard", HARMLESS);
    vehicle.deploy(lambda.path(), &[]);
    lambda.write("guard", "0.2.0", FAULTY);
    vehicle.deploy(lambda.path(), &[]);
    vehicle
        .until("the fallback", |vehicle| vehicle.deployment("guard").runs_fallback.then_some(()));
    vehicle.until_running(&["guard"]);
    let failed = vehicle.deployment("guard");
    let reason = failed.failed.clone().unwrap_or_default();
    assert!(reason.contains("wakes faulted"), "{failed:?}");
    assert_eq!(failed.status.expect("it runs").restarts, 0);
    // The event has the numbers, and the revision is not tried again.
    let rolled_back = events(&vehicle, EventKind::RolledBack);
    assert!(rolled_back.len() == 1 && rolled_back[0].contains(&reason), "{rolled_back:?}");
    vehicle.stop();
    vehicle.start();
    vehicle.until_running(&["guard"]);
    assert!(vehicle.deployment("guard").runs_fallback);
    assert_eq!(events(&vehicle, EventKind::RolledBack).len(), 1);
}

pub fn proven() {
    let mut vehicle = TestVehicle::new();
    std::fs::write(vehicle.path("vehicle.toml"), "[deployments]\nprobation = \"1s\"\n")
        .expect("a file is written");
    vehicle.start();
    let lambda = PythonLambda::new("guard", HARMLESS);
    vehicle.deploy(lambda.path(), &[]);
    // The first wakes are none with a fault, until it is proven.
    let late = FAULTY.replace("if Lambda", "if Lambda.wakes > 15 and Lambda");
    lambda.write("guard", "0.2.0", &late);
    vehicle.deploys(lambda.path());
    vehicle.until("its probation", |vehicle| vehicle.deployment("guard").is_proven.then_some(()));
    let shown = vehicle.until("a warning", |vehicle| {
        let shown = text(&vehicle.gleaner(&["status"]));
        shown.contains("wakes faulted").then_some(shown)
    });
    let deployment = vehicle.deployment("guard");
    assert!(!deployment.runs_fallback && deployment.failed.is_none(), "{shown}");
    let status = deployment.status.expect("it runs");
    assert_eq!((status.phase, status.restarts), (LambdaPhase::Running, 0), "{shown}");
    let warnings = events(&vehicle, EventKind::Warning);
    let faults = warnings.iter().filter(|text| text.contains("wakes faulted"));
    assert_eq!(faults.count(), 1, "{warnings:?}");
}

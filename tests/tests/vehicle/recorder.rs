//! A vehicle whose recorder cannot be started, and ends at once.

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;

use gleaner_protocol::supervision::{EventKind, LambdaStatus, SupervisorStatus};
use gleaner_tests::program;
use gleaner_tests::vehicle::TestVehicle;

use super::{clips, events, recording, ticker};

pub fn missing() {
    let mut vehicle = TestVehicle::new();
    let home = vehicle.path("home");
    fs::create_dir(&home).expect("a folder is made");
    let link = |name: &str| symlink(program(name), home.join(name)).expect("a link is made");
    // Makes the folder an installation.
    link("gleaner-runtime");
    let recorder = home.join("gleaner-recorder");
    write_program(&recorder, "#!/no/such/program\n");
    vehicle.start();
    let lambdas = [ticker("rust", "second"), recording("rust", "first")];
    for lambda in &lambdas {
        vehicle.deploys(lambda.path());
    }
    // It decides, and the status has both reasons.
    let (_, lambda) = until(&vehicle, "the wakes without a recorder", |supervisor, lambda| {
        let recorder = supervisor.recorder.as_ref()?;
        let reason = recorder.last_end.as_ref()?;
        let is_explained = reason.contains("cannot start") && reason.contains("No such file");
        (is_explained && !recorder.is_ready && absent_s(lambda)? > 0).then_some(())
    });
    assert!(lambda.live.expect("it has reported").wakes > 0);
    let shown = vehicle.succeeds(&["status"]);
    assert!(shown.contains("it records nothing"), "{shown}");
    // One that ends at once is explained by its own message.
    write_program(&recorder, "#!/bin/sh\necho 'error: the disk is full' >&2\nexit 1\n");
    until(&vehicle, "the message of the recorder", |supervisor, _| {
        let reason = supervisor.recorder.as_ref()?.last_end.clone()?;
        reason.ends_with("(exit status: 1): the disk is full").then_some(())
    });
    fs::remove_file(&recorder).expect("it was written");
    link("gleaner-recorder");
    let (supervisor, lambda) = until(&vehicle, "a recorder", |supervisor, lambda| {
        (supervisor.recorder.as_ref()?.is_ready && absent_s(lambda)? == 0).then_some(())
    });
    vehicle.until("a clip", |vehicle| (!clips(vehicle).is_empty()).then_some(()));
    let warnings = events(&vehicle, EventKind::Warning);
    let absent = warnings.iter().filter(|text| text.contains("no recorder")).count();
    assert_eq!(absent, 1, "{warnings:?}");
    assert_eq!((supervisor.ingress.restarts, lambda.restarts), (0, 0), "they ran on");
    assert_eq!(vehicle.deployment("second").status.expect("it runs").restarts, 0);
}

/// Waits for statuses of the supervisor and of the lambda that records.
fn until(
    vehicle: &TestVehicle,
    what: &str,
    wanted: impl Fn(&SupervisorStatus, &LambdaStatus) -> Option<()>,
) -> (SupervisorStatus, LambdaStatus) {
    vehicle.until(what, |vehicle| {
        let status = vehicle.try_status()?;
        let deployment = status.deployments.into_iter().find(|it| it.id == "first")?;
        let (supervisor, lambda) = (status.supervisor?, deployment.status?);
        wanted(&supervisor, &lambda).map(|()| (supervisor, lambda))
    })
}

/// Returns the time for which the lambda has had no recorder, once it has reported.
fn absent_s(lambda: &LambdaStatus) -> Option<u64> {
    Some(lambda.live.as_ref()?.recorder_link?.absent_s)
}

/// Replaces a program as a whole: the file of one that is being started cannot be written.
fn write_program(path: &Path, text: &str) {
    let next = path.with_extension("next");
    fs::write(&next, text).expect("a file is written");
    fs::set_permissions(&next, fs::Permissions::from_mode(0o755)).expect("it is ours");
    fs::rename(&next, path).expect("it is renamed");
}

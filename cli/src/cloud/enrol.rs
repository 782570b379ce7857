//! `gleaner enrol` and `gleaner unenrol`: the connection of this vehicle to a cloud.

use std::thread;
use std::time::{Duration, Instant};

use gleaner_base::{ByteSize, Exit, Failure, PlainFile, format_duration, in_one_line, visible};
use gleaner_fleet::Enrolment;
use serde_json::json;

use super::show;
use crate::args::{EnrolArgs, UnenrolArgs};
use crate::render::Paint;
use crate::vehicle::{self, VehicleClient};

const FILE_MAX: ByteSize = ByteSize::kib(64);

const POLL_INTERVAL: Duration = Duration::from_millis(100);

pub(super) fn enrol(args: &EnrolArgs) -> Result<Exit, Failure> {
    let file = args.file.display();
    let unusable = |error: &dyn std::error::Error| {
        Failure::caused_by(Exit::Usage, format!("cannot use `{file}`"), error)
            .with_help("an admin of the cloud writes one: `gleaner vehicles enrol NAME --to FILE`")
    };
    let bytes = PlainFile::named(&args.file, FILE_MAX).and_then(PlainFile::read_whole);
    let bytes = bytes.map_err(|error| unusable(&error))?;
    let enrolment = Enrolment::parse(&bytes).map_err(|error| unusable(&error))?;
    let client = VehicleClient::new(&args.vehicle)?;
    client.put("/v1/cloud", bytes)?;
    let started = Instant::now();
    loop {
        let cloud = client.status()?.cloud.filter(|cloud| cloud.address == enrolment.address);
        let state = cloud.as_ref().map(|cloud| &*cloud.state);
        if state == Some("connected") {
            return show(args.vehicle.json, &cloud, |cloud| {
                vehicle::cloud_line(cloud.as_ref(), Paint::of_stdout()).trim_start().to_owned()
            });
        }
        let address = visible(&enrolment.address);
        let mut failure = match state {
            Some("refused") => {
                let message = format!("the cloud at {address} refuses this vehicle");
                Failure::new(Exit::Denied, message)
                    .with_help("enrol it again: `gleaner vehicles enrol NAME --to FILE`")
            }
            _ if started.elapsed() >= args.timeout => {
                let seconds = format_duration(args.timeout);
                let message = format!("no connection to the cloud at {address} after {seconds}");
                Failure::new(Exit::Differs, message)
                    .with_help("it is tried again and again: `gleaner status` has the reason")
            }
            _ => {
                thread::sleep(POLL_INTERVAL);
                continue;
            }
        };
        let (reason, help) = cloud.map(|cloud| (cloud.reason, cloud.help)).unwrap_or_default();
        // Its help is nearer to the cause.
        failure.help = help.or(failure.help);
        failure.causes.extend(reason.map(|reason| in_one_line(&reason)));
        return Err(failure);
    }
}

pub(super) fn unenrol(args: &UnenrolArgs) -> Result<Exit, Failure> {
    let UnenrolArgs { new_identity, vehicle } = args;
    let query = if *new_identity { "?new_identity=true" } else { "" };
    VehicleClient::new(vehicle)?.delete(&format!("/v1/cloud{query}"))?;
    let result = json!({ "enrolled": false, "new_identity": new_identity });
    show(vehicle.json, &result, |_| match new_identity {
        false => "disconnected from the cloud; what was deployed runs on\n".to_owned(),
        true => "disconnected from the cloud, and without a key: stop gleaner-orchestrator, and \
                 copy the disk; each start makes a new key\n"
            .to_owned(),
    })
}

//! `gleaner vehicles`: the vehicles of a cloud.

use std::path::Path;
use std::time::Duration;

use gleaner_base::{Exit, Failure, format_duration, visible};
use gleaner_fleet::Enrolment;
use gleaner_fleet::people::{NewVehicle, VehicleSummary};
use gleaner_trust::{PublicKey, VehicleName};
use hyper::Method;
use serde_json::json;

use super::{client, list, show};
use crate::account::write_private;
use crate::args::{NewVehicleArgs, VehiclesArgs, VehiclesCommand};
use crate::render::{Paint, or_dash, table};
use crate::since_1970;

pub(super) fn vehicles(args: &VehiclesArgs) -> Result<Exit, Failure> {
    match &args.command {
        None => {
            let vehicles: Vec<VehicleSummary> = list::all(&client()?, "/v1/vehicles", &[])?;
            let now = since_1970().as_secs();
            show(args.json, &vehicles, |vehicles| text(vehicles, now, Paint::of_stdout()))
        }
        Some(VehiclesCommand::Enrol(vehicle)) => enrol(vehicle, args.json),
        Some(VehiclesCommand::Keys) => {
            let vehicles: Vec<VehicleSummary> = list::all(&client()?, "/v1/vehicles", &[])?;
            show(args.json, &keys(&vehicles), |keys| {
                let line = |(name, key): &(VehicleName, PublicKey)| format!("{name} {key}\n");
                keys.iter().map(line).collect()
            })
        }
        Some(VehiclesCommand::Agree { name }) => {
            client()?.change(Method::POST, &format!("/v1/vehicles/{name}/agree"), None)?;
            show(args.json, &json!({ "name": name, "agreed": true }), |_| {
                format!("{name} follows the state of this cloud now\n")
            })
        }
        Some(VehiclesCommand::Revoke { name }) => {
            client()?.delete(&format!("/v1/vehicles/{name}"))?;
            show(args.json, &json!({ "name": name, "revoked": true }), |_| {
                format!("revoked {name}\n")
            })
        }
    }
}

fn enrol(args: &NewVehicleArgs, json: bool) -> Result<Exit, Failure> {
    let (name, file) = (args.name.to_string(), args.to.display().to_string());
    // Before the request: its secret is not sent again.
    if args.to.symlink_metadata().is_ok() {
        return Err(Failure::new(Exit::Usage, format!("`{file}` exists"))
            .with_help("name a new file with --to FILE, or remove this one"));
    }
    let folder = args.to.parent().filter(|folder| !folder.as_os_str().is_empty());
    if !folder.unwrap_or(Path::new(".")).is_dir() {
        return Err(Failure::new(Exit::Usage, format!("there is no folder for `{file}`"))
            .with_help("create it, or name another file with --to FILE"));
    }
    let enrolment: Enrolment =
        client()?.create("/v1/vehicles", &NewVehicle { name: name.clone() })?;
    let text = serde_json::to_vec_pretty(&enrolment).expect("an enrolment is text");
    write_private(&args.to, &text, false).map_err(|error| {
        Failure::caused_by(Exit::Usage, format!("cannot write `{file}`"), &error)
            .with_help(format!("enrol `{name}` again, into another file: --to FILE"))
    })?;
    show(json, &json!({ "name": name, "address": enrolment.address, "file": file }), |_| {
        format!(
            "wrote {file}: a one-time secret for {name}. Copy it there securely, then run:\n  \
             gleaner enrol {file}\n"
        )
    })
}

fn keys(vehicles: &[VehicleSummary]) -> Vec<(VehicleName, PublicKey)> {
    let key = |it: &VehicleSummary| Some((it.name.parse().ok()?, it.key.parse().ok()?));
    vehicles.iter().filter_map(key).collect()
}

/// Formats the vehicles at the time `now`, in s since 1970.
fn text(vehicles: &[VehicleSummary], now: u64, paint: Paint) -> String {
    if vehicles.is_empty() {
        return "there are no vehicles: `gleaner vehicles enrol NAME --to FILE`\n".to_owned();
    }
    let head = ["name", "state", "seen", "version", "running", "desired", "applied"];
    let rows = vehicles.iter().map(|vehicle| {
        [
            visible(&vehicle.name),
            json!(vehicle.state).as_str().unwrap_or_default().to_owned(),
            or_dash(vehicle.seen, |seen| seen_before(now, seen)),
            or_dash(vehicle.version.as_deref(), visible),
            format!("{}/{}", vehicle.running, vehicle.deployments),
            vehicle.wanted.to_string(),
            vehicle.handled.to_string(),
        ]
    });
    let mut text = table(&head, rows, &[4, 5, 6]);
    for vehicle in vehicles {
        if vehicle.is_double {
            let line = format!(
                "{}: two machines have its identity, and one is not let in: `gleaner unenrol \
                 --new-identity` on the copy, and enrol both again",
                visible(&vehicle.name)
            );
            text += &format!("{}\n", paint.yellow(&line));
        }
        for problem in &vehicle.problems {
            let line = format!("{}: {}", visible(&vehicle.name), problem.explained());
            text += &format!("{}\n", paint.yellow(&line));
        }
    }
    text
}

/// Formats the time since a sign of life.
pub(super) fn seen_before(now: u64, seen: u64) -> String {
    let seconds = now.saturating_sub(seen);
    let unit = [86_400, 3600, 60].into_iter().find(|unit| seconds >= 2 * unit).unwrap_or(1);
    format!("{} ago", format_duration(Duration::from_secs(seconds / unit * unit)))
}

#[cfg(test)]
mod tests {
    use gleaner_fleet::WantedProblem;
    use gleaner_fleet::people::VehicleState;

    use super::*;

    fn problem(title: &str) -> WantedProblem {
        WantedProblem { title: title.to_owned(), ..WantedProblem::default() }
    }

    #[test]
    fn the_list_has_each_vehicle_with_its_problems() {
        let vehicle = |name: &str, seen, problems: &[&str]| VehicleSummary {
            seen,
            wanted: 7,
            handled: 6,
            problems: problems.iter().map(|text| problem(text)).collect(),
            running: 1,
            deployments: 2,
            ..super::super::test_vehicle(name, VehicleState::Online)
        };
        let vehicles = [
            vehicle("car-7", Some(100), &["deployment `brake`: no\u{1b}[31m key"]),
            vehicle("car-8", None, &[]),
        ];
        let text = text(&vehicles, 103, Paint::new(false));
        assert_eq!(
            text,
            "name   state   seen    version  running  desired  applied\n\
             car-7  online  3s ago  -            1/2        7        6\n\
             car-8  online  -       -            1/2        7        6\n\
             car-7: deployment `brake`: no\\u{1b}[31m key\n"
        );
    }

    #[test]
    fn the_time_since_a_sign_of_life_has_one_unit() {
        let times = [(0, "0s ago"), (59, "59s ago"), (150, "2min ago"), (7300, "2h ago")];
        for (seconds, text) in times {
            assert_eq!(seen_before(seconds, 0), text);
        }
        assert_eq!(seen_before(0, 5), "0s ago");
    }
}

//! Queries of the page: parts of lists, as a person looks at them.

use std::collections::BTreeMap;

use gleaner_fleet::people::{VehicleState, VehicleSummary};

use super::CloudStore;
use super::links::FAILED;
use super::records::line_of;
use super::sql::json;
use super::vehicles::{vehicle_state, vehicle_summary};
use crate::error::CloudResult;

/// Longest line that is shown, in bytes: a page has a thousand at most.
pub(crate) const LINE_MAX: i64 = 4096;
/// Maximum number of streams of a vehicle in one time line.
const STREAMS_MAX: usize = 64;

/// Number of vehicles that a search looks at, at a time.
const VEHICLES_AT_ONCE: i64 = 100;

#[derive(Debug, Default)]
pub(crate) struct VehicleFilter {
    /// The whole name; any if it is empty.
    pub(crate) only: String,
    pub(crate) name: String,
    /// A label with its value; any value if that is empty.
    pub(crate) label: Option<(String, String)>,
    pub(crate) state: Option<VehicleState>,
    /// True for those with a problem or a failed deployment only.
    pub(crate) has_problem: bool,
}

typed! {
    /// Values that a filter looks at.
    struct FilteredVehicle {
        name: String,
        has_problems: bool,
        labels: String,
        state: VehicleState,
    }
}

#[derive(Debug, Default)]
pub(crate) struct VehiclePage {
    /// Those of this part, with the number of failed deployments of each.
    pub(crate) vehicles: Vec<(VehicleSummary, u64)>,
    /// Number of those that the filter chooses.
    pub(crate) found: usize,
    /// Number of all by state: online, offline, invited and revoked.
    pub(crate) states: [usize; 4],
    /// Number of all with a problem or a failed deployment.
    pub(crate) with_problems: usize,
}

#[derive(Debug, Default)]
pub(crate) struct NewestRecords {
    /// Number of the arrival and the line of each, the newest first.
    pub(crate) lines: Vec<(i64, String)>,
    /// Number of the last arrival that was looked at.
    pub(crate) position: i64,
    /// Number of the oldest arrival that was read.
    pub(crate) oldest_read: i64,
    /// True if older ones in the same range were left out.
    pub(crate) has_more: bool,
}

impl NewestRecords {
    pub(crate) fn texts(&self) -> impl DoubleEndedIterator<Item = &str> {
        self.lines.iter().map(|(_, line)| &**line)
    }
}

impl CloudStore {
    /// Returns the numbers of vehicles, and of releases, by their states.
    pub(crate) async fn states(&self) -> CloudResult<(Vec<(String, i64)>, Vec<(String, i64)>)> {
        let vehicles = rows!(self;
            concat!("SELECT ", vehicle_state!(), ", COUNT(*) FROM vehicles GROUP BY 1"));
        let releases = rows!(self; "SELECT state, COUNT(*) FROM releases GROUP BY state");
        Ok((vehicles, releases))
    }

    /// Returns the `index`-th part, of `size` each, of the vehicles that `filter` chooses, by name.
    pub(crate) async fn vehicle_page(
        &self,
        filter: &VehicleFilter,
        index: usize,
        size: usize,
    ) -> CloudResult<VehiclePage> {
        // Of all vehicles, only what the filters look at: texts of thousands take their time.
        let rows: Vec<FilteredVehicle> = rows!(self;
            concat!("SELECT name, CASE WHEN problems = '[]' THEN 0 ELSE 1 END AS has_problems,
             CASE WHEN $2 = 0 THEN '' ELSE labels END AS labels, ", vehicle_state!(),
             " FROM vehicles WHERE $1 = '' OR name = $1 ORDER BY name");
            &filter.only, filter.label.is_some());
        let failed: Vec<(String, u64)> = rows!(self; "SELECT vehicle, COUNT(*) FROM reported WHERE
             state = $1 AND ($2 = '' OR vehicle = $2) GROUP BY vehicle"; FAILED, &filter.only);
        let failed: BTreeMap<_, _> = failed.into_iter().collect();
        let mut page = VehiclePage::default();
        let mut names = Vec::new();
        for FilteredVehicle { name, has_problems, labels, state } in rows {
            let failures = failed.get(&name).copied().unwrap_or(0);
            let has_problem = state != VehicleState::Revoked && (has_problems || failures > 0);
            let index_of = match state {
                VehicleState::Online => 0,
                VehicleState::Offline => 1,
                VehicleState::Invited => 2,
                VehicleState::Revoked => 3,
            };
            page.states[index_of] += 1;
            page.with_problems += usize::from(has_problem);
            let is_chosen = filter.state.is_none_or(|wanted| wanted == state)
                && (has_problem || !filter.has_problem)
                && name.contains(&filter.name)
                && filter.has(&labels);
            if !is_chosen {
                continue;
            }
            if (index * size..(index + 1) * size).contains(&page.found) {
                names.push((name, failures));
            }
            page.found += 1;
        }
        for (name, failures) in names {
            let row: Option<VehicleSummary> =
                row!(self; vehicle_summary!("WHERE name = $1"); &name);
            page.vehicles.extend(row.map(|row| (row, failures)));
        }
        Ok(page)
    }

    /// Returns the vehicles that have reported the deployment of this envelope, with their states,
    /// of which `fallback` is a failure with a fallback that runs, and reasons: first those with a
    /// failure, at most `most`.
    pub(crate) async fn reports(
        &self,
        deployment: &str,
        envelope: &str,
        most: i64,
    ) -> CloudResult<Vec<(String, String, String)>> {
        Ok(rows!(self;
            "SELECT vehicle, CASE WHEN on_fallback = 1 THEN 'fallback' ELSE state END, reason
             FROM reported WHERE deployment = $1 AND envelope = $2
             ORDER BY CASE WHEN state = $3 THEN 0 ELSE 1 END, vehicle LIMIT $4";
            deployment, envelope, FAILED, most))
    }

    /// Returns vehicles by name after this one, or from it on, and whether the filter chooses each
    /// by its name and its labels: some at a time.
    pub(crate) async fn vehicles_from(
        &self,
        filter: &VehicleFilter,
        name: &str,
        is_included: bool,
    ) -> CloudResult<Vec<(String, bool)>> {
        let rows: Vec<(String, String)> = rows!(self; "SELECT name, labels
             FROM vehicles WHERE (name > $1 OR (name = $1 AND $2 = 1)) AND ($3 = '' OR name = $3)
             ORDER BY name LIMIT $4"; name, is_included, &filter.only, VEHICLES_AT_ONCE);
        let chosen = |(name, labels): (String, String)| {
            let is_chosen = filter.has(&labels);
            (name, is_chosen)
        };
        Ok(rows.into_iter().map(chosen).collect())
    }

    /// Returns names of streams of a vehicle from `first` on: at most `most`.
    pub(crate) async fn streams_from(
        &self,
        vehicle: &str,
        first: &str,
        most: usize,
    ) -> CloudResult<Vec<String>> {
        Ok(rows!(self; "SELECT stream FROM streams WHERE vehicle = $1 AND stream >= $2 ORDER BY
             stream LIMIT $3"; vehicle, first, most))
    }

    /// Returns the names of the streams of a vehicle: at most as many as one time line shows.
    pub(crate) async fn streams(&self, vehicle: &str) -> CloudResult<Vec<String>> {
        self.streams_from(vehicle, "", STREAMS_MAX).await
    }
}

/// Returns the line of a record that is too long to show.
pub(crate) fn large_line(stream: &str, bytes: u64) -> String {
    let text = format!("a record of {bytes} bytes is not shown here: `gleaner logs` has it");
    line_of(stream, "large", serde_json::json!({ "text": text }))
}

impl VehicleFilter {
    /// Returns whether these labels, as JSON without spaces, have the one that is asked for.
    pub(super) fn has(&self, labels: &str) -> bool {
        let Some((name, value)) = &self.label else { return true };
        let label = match value.is_empty() {
            true => format!("{}:", json(name)),
            false => format!("{}:{}", json(name), json(value)),
        };
        // A quote after one of these begins a name: in a text, it would be escaped.
        ["{", ","].iter().any(|before| labels.contains(&format!("{before}{label}")))
    }
}

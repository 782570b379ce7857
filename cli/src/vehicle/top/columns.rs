//! The table of the lambdas: its columns, as text and for the page.

use std::cmp::Ordering;

use gleaner_base::visible;
use gleaner_report::format::{grouped, size};

use super::super::status::{NO_DEPLOYMENTS, shared};
use super::metrics::{LambdaMetrics, ProgramMetrics, VehicleMetrics};
use crate::render::{or_dash, table};

/// Spaces between two columns, as in [`table`].
pub(super) const GAP: usize = 2;

pub(super) struct Column {
    pub(super) head: &'static str,
    pub(super) cell: fn(&LambdaMetrics) -> String,
    /// Place in the order in which columns are given room: 0 is the first.
    rank: u8,
}

static COLUMNS: [Column; 15] = [
    Column { head: "id", rank: 0, cell: |it| visible(&it.id) },
    Column { head: "state", rank: 1, cell: |it| it.state.to_owned() },
    Column { head: "wakes/s", rank: 3, cell: |it| decimal(it.wakes_per_s) },
    Column { head: "p50 ms", rank: 12, cell: |it| ms(it.wake_p50_ns) },
    Column { head: "p99 ms", rank: 5, cell: |it| ms(it.wake_p99_ns) },
    Column { head: "run p99", rank: 10, cell: |it| ms(it.run_p99_ns) },
    Column { head: "CPU %", rank: 2, cell: |it| decimal(it.cpu_percent) },
    Column { head: "memory", rank: 4, cell: |it| or_dash(it.rss_bytes, size) },
    Column { head: "lost", rank: 6, cell: |it| or_dash(it.losses, grouped) },
    Column { head: "faults", rank: 7, cell: |it| or_dash(it.faults, grouped) },
    Column { head: "restarts", rank: 8, cell: |it| or_dash(it.restarts, grouped) },
    Column { head: "triggers", rank: 9, cell: |it| or_dash(it.triggers, grouped) },
    Column { head: "clips", rank: 11, cell: |it| or_dash(it.clips, grouped) },
    Column { head: "recorded", rank: 13, cell: |it| or_dash(it.clip_bytes, size) },
    Column { head: "wakes", rank: 14, cell: |it| or_dash(it.wakes, grouped) },
];

impl Column {
    /// Returns whether its cells are numbers, which are aligned to the right.
    pub(super) fn is_number(&self) -> bool {
        self.rank > 1
    }

    /// Returns the number of characters of its longest cell.
    pub(super) fn width(&self, lambdas: &[LambdaMetrics]) -> usize {
        let cells = lambdas.iter().map(|it| (self.cell)(it).chars().count());
        cells.chain([self.head.len()]).max().unwrap_or(0)
    }
}

/// Returns the columns that fit into `width` characters, with the width of each.
pub(super) fn fitting(
    lambdas: &[LambdaMetrics],
    width: usize,
) -> impl Iterator<Item = (&'static Column, usize)> {
    let mut ranked: Vec<_> = COLUMNS.iter().map(|it| (it.rank, it.width(lambdas) + GAP)).collect();
    ranked.sort();
    let mut left = width.saturating_add(GAP);
    let fits = ranked.iter().take_while(|(_, width)| {
        let fits = *width <= left;
        left -= if fits { *width } else { 0 };
        fits
    });
    let end = fits.count() as u8;
    // If there is no room at all, the id is cut.
    COLUMNS.iter().filter(move |it| it.rank < end.max(1)).map(|it| (it, it.width(lambdas)))
}

/// Formats all figures as text, with the columns that fit into `width` characters.
pub(super) fn text(metrics: &VehicleMetrics, width: usize) -> String {
    let mut text: String = head(metrics, width).iter().map(|line| format!("{line}\n")).collect();
    text += "\n";
    if metrics.lambdas.is_empty() {
        return text + NO_DEPLOYMENTS + "\n";
    }
    let columns: Vec<_> = fitting(&metrics.lambdas, width).map(|(column, _)| column).collect();
    let head: Vec<_> = columns.iter().map(|column| column.head).collect();
    let cells =
        |lambda: &LambdaMetrics| columns.iter().map(|it| (it.cell)(lambda)).collect::<Vec<_>>();
    let numbers: Vec<_> = (0..head.len()).filter(|index| columns[*index].is_number()).collect();
    text += &table(&head, metrics.lambdas.iter().map(cells), &numbers);
    for lambda in &metrics.lambdas {
        for reason in &lambda.reasons {
            text += &format!("{}: {reason}\n", visible(&lambda.id));
        }
    }
    text
}

/// Returns the lines on the vehicle as a whole, of at most `width` characters.
pub(super) fn head(metrics: &VehicleMetrics, width: usize) -> Vec<String> {
    let trust = match &metrics.trust {
        None => "no trust root".to_owned(),
        Some(trust) if trust.is_expired => format!("trust root {} has expired", trust.version),
        Some(trust) => format!("trust root {}", trust.version),
    };
    let supervisor = match &metrics.supervisor {
        None => "the supervisor does not run".to_owned(),
        Some(supervisor) => format!("supervisor {}", program(supervisor)),
    };
    let services = metrics.services.iter().map(|service| {
        let state = if service.is_ready { "" } else { " not ready" };
        let memory = service.rss_bytes.map(|it| format!(" {}", size(it))).unwrap_or_default();
        let restarts = match service.restarts {
            0 => String::new(),
            count => format!(", restarts {count}"),
        };
        format!("{}{state}{memory}{restarts}", service.name)
    });
    let capacity = metrics.capacity.iter().map(shared);
    let age = metrics.age_s.map(|age_s| format!("as of {age_s:.0} s ago"));
    let vehicle = [visible(&metrics.vehicle), trust].into_iter().chain(age);
    let programs = [format!("orchestrator {}", program(&metrics.orchestrator)), supervisor];
    let mut lines = wrapped(vehicle, width);
    lines.extend(wrapped(programs, width));
    lines.extend(wrapped(services, width));
    lines.extend(wrapped(capacity, width));
    lines
}

/// Joins parts to lines of at most `width` characters.
fn wrapped(parts: impl IntoIterator<Item = String>, width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for part in parts {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 3 + part.chars().count() <= width => {
                *line += &format!("   {part}");
            }
            _ => lines.push(part),
        }
    }
    lines
}

fn program(program: &ProgramMetrics) -> String {
    format!("CPU {} %, {}", decimal(program.cpu_percent), size(program.rss_bytes))
}

fn decimal(value: Option<f64>) -> String {
    or_dash(value, |value| format!("{value:.1}"))
}

fn ms(ns: Option<u64>) -> String {
    or_dash(ns, |ns| format!("{:.2}", ns as f64 / 1e6))
}

#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum RowOrder {
    #[default]
    Id,
    Cpu,
    Memory,
    Wakes,
    Latency,
    Losses,
}

/// An order, with the head and the number of its column.
type OrderColumn = (RowOrder, &'static str, fn(&LambdaMetrics) -> Option<f64>);

impl RowOrder {
    /// All of them as they are declared: `self as usize` is the index.
    const ALL: [OrderColumn; 6] = [
        (Self::Id, "id", |_| None),
        (Self::Cpu, "CPU %", |it| it.cpu_percent),
        (Self::Memory, "memory", |it| it.rss_bytes.map(|it| it as f64)),
        (Self::Wakes, "wakes/s", |it| it.wakes_per_s),
        (Self::Latency, "p99 ms", |it| it.wake_p99_ns.map(|it| it as f64)),
        (Self::Losses, "lost", |it| it.losses.map(|it| it as f64)),
    ];

    pub(super) fn next(self) -> Self {
        Self::ALL[(self as usize + 1) % Self::ALL.len()].0
    }

    pub(super) fn head(self) -> &'static str {
        Self::ALL[self as usize].1
    }

    /// Sorts rows: ids from A to Z, numbers from the highest down, unknown ones last.
    pub(super) fn sort(self, lambdas: &mut [LambdaMetrics]) {
        let number = Self::ALL[self as usize].2;
        lambdas.sort_by(|a, b| {
            let [one, other] = [a, b].map(|it| number(it).unwrap_or(f64::NEG_INFINITY));
            other.partial_cmp(&one).unwrap_or(Ordering::Equal).then_with(|| a.id.cmp(&b.id))
        });
    }
}

//! The page of `gleaner top`: the vehicle, a row for each lambda, and the details of one.

use std::time::Duration;

use gleaner_base::{format_duration, visible};
use gleaner_protocol::vehicle_api::{DeploymentStatus, VehicleStatus};
use gleaner_protocol::{LiveStatus, LiveTopic};
use gleaner_report::format::grouped;
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Modifier, Style, Stylize};
use ratatui::text::Line;
use ratatui::widgets::{Block, Borders, Paragraph, Row, Table, TableState, Wrap};

use super::super::status::NO_DEPLOYMENTS;
use super::columns::{self, RowOrder};
use super::metrics::{LambdaMetrics, losses};
use super::{POLL_INTERVAL, Polls};
use crate::render::{in_ms, isolation, table};

/// Time without an answer from which the page shows it.
const SILENCE: Duration = POLL_INTERVAL.saturating_mul(3);

#[derive(Default)]
pub(super) struct Page {
    polls: Polls,
    failure: Option<String>,
    order: RowOrder,
    selected: Option<String>,
    rows: TableState,
}

impl Page {
    pub(super) fn new(polls: Polls) -> Self {
        Self { polls, ..Self::default() }
    }

    pub(super) fn add(&mut self, polled: Result<VehicleStatus, String>) {
        self.failure = polled.map(|status| self.polls.add(status)).err();
    }

    /// Sorts the rows by the next column.
    pub(super) fn sort(&mut self) {
        self.order = self.order.next();
    }

    /// Selects the row that is `by` rows below the selected one.
    pub(super) fn select(&mut self, by: isize) {
        let lambdas = self.lambdas();
        let row = self.row(&lambdas).saturating_add_signed(by);
        self.selected =
            lambdas.get(row.min(lambdas.len().saturating_sub(1))).map(|it| it.id.clone());
    }

    fn lambdas(&self) -> Vec<LambdaMetrics> {
        let mut lambdas = self.polls.metrics().lambdas;
        self.order.sort(&mut lambdas);
        lambdas
    }

    /// Returns the number of the selected row; the first without one, or if it is gone.
    fn row(&self, lambdas: &[LambdaMetrics]) -> usize {
        lambdas.iter().position(|it| Some(&it.id) == self.selected.as_ref()).unwrap_or(0)
    }

    /// Draws everything. `silent` is the time since the last answer of the orchestrator.
    pub(super) fn draw(&mut self, frame: &mut Frame, silent: Duration) {
        let Some(status) = self.polls.newest() else { return };
        let mut metrics = self.polls.metrics();
        self.order.sort(&mut metrics.lambdas);
        let lambdas = metrics.lambdas.as_slice();
        let mut head: Vec<Line> = columns::head(&metrics, usize::from(frame.area().width))
            .into_iter()
            .map(Line::from)
            .collect();
        head[0] = head[0].clone().bold();
        if self.failure.is_some() || silent >= SILENCE {
            let since = format_duration(Duration::from_secs(silent.as_secs()));
            let why = self.failure.as_deref().unwrap_or("it does not answer");
            let line = format!("no connection for {since}: {}", visible(why));
            head.insert(0, Line::from(line).style(Style::new().fg(Color::Red).bold()));
        }
        let [top, middle, bottom, foot] = areas(frame.area(), head.len(), lambdas.len());
        frame.render_widget(Paragraph::new(head), top);

        let row = self.row(lambdas);
        let columns: Vec<_> = columns::fitting(lambdas, usize::from(middle.width)).collect();
        let cells = |cell: &dyn Fn(&columns::Column) -> String| -> Vec<Line<'static>> {
            let aligned = columns.iter().map(|(column, _)| {
                let line = Line::from(cell(column));
                if column.is_number() { line.right_aligned() } else { line }
            });
            aligned.collect()
        };
        let rows = lambdas
            .iter()
            .map(|lambda| Row::new(cells(&|column| (column.cell)(lambda))).style(style(lambda)));
        let widths = columns.iter().map(|(_, width)| Constraint::Length(*width as u16));
        let head = Row::new(cells(&|column| column.head.to_owned()));
        let table = Table::new(rows, widths)
            .header(head.style(Modifier::UNDERLINED))
            .column_spacing(columns::GAP as u16)
            .row_highlight_style(Modifier::REVERSED);
        self.rows.select(Some(row).filter(|_| !lambdas.is_empty()));
        frame.render_stateful_widget(table, middle, &mut self.rows);

        let selected = lambdas.get(row);
        let deployment =
            selected.and_then(|it| status.deployments.iter().find(|of| of.id == it.id));
        match selected.zip(deployment) {
            Some((lambda, deployment)) => {
                let block =
                    Block::new().borders(Borders::TOP).title(format!("─ {} ", visible(&lambda.id)));
                let lines = Paragraph::new(details(lambda, deployment)).wrap(Wrap { trim: false });
                frame.render_widget(lines.block(block), bottom);
            }
            None => {
                frame.render_widget(Paragraph::new(NO_DEPLOYMENTS), bottom);
            }
        }
        let keys = format!("q quit   up/down select   s sort: {}", self.order.head());
        frame.render_widget(Paragraph::new(keys).style(Modifier::DIM), foot);
    }
}

/// Divides the page: the rows have up to half of the height below the head.
fn areas(area: Rect, head: usize, rows: usize) -> [Rect; 4] {
    let head = (head as u16).min(area.height);
    let left = area.height.saturating_sub(head + 2);
    // With the names of the columns.
    let rows = u16::try_from(rows).unwrap_or(u16::MAX).saturating_add(1);
    let rows = rows.min((left / 2).max(4)).min(left);
    Layout::vertical([
        Constraint::Length(head + 1),
        Constraint::Length(rows + 1),
        Constraint::Fill(1),
        Constraint::Length(1),
    ])
    .areas(area)
}

fn style(lambda: &LambdaMetrics) -> Style {
    match lambda.state {
        "quarantined" => Style::new().fg(Color::Red),
        "running" | "on probation" => Style::new(),
        _ => Style::new().fg(Color::Yellow),
    }
}

/// Returns the details of a lambda, the most important ones first.
fn details(lambda: &LambdaMetrics, deployment: &DeploymentStatus) -> Vec<Line<'static>> {
    let status = deployment.status.as_ref();
    let mut title = format!("{} {}, {}", visible(&lambda.lambda), lambda.version, lambda.state);
    if let Some(status) = status {
        let seconds = Duration::from_secs(status.phase_s as u64);
        title += &format!(" for {}", format_duration(seconds));
        title += &status.pid.map(|pid| format!(", process {pid}")).unwrap_or_default();
    }
    let mut lines = vec![Line::from(title)];
    let yellow = |text: String| Line::from(text).fg(Color::Yellow);
    lines.extend(lambda.reasons.iter().cloned().map(yellow));
    let Some(status) = status else { return lines };
    if let Some(live) = status.live.as_deref() {
        let lost = losses(live).into_iter();
        lines.extend(lost.map(|(_, what)| yellow(format!("lost: {what}"))));
        lines.extend(durations(live).map(Line::from));
        lines.extend(topics(live).lines().map(|line| Line::from(line.to_owned())));
    }
    if !status.layers.is_empty() {
        lines.push(Line::from(isolation(&status.layers).trim_end().to_owned()));
    }
    lines
}

fn durations(live: &LiveStatus) -> Option<String> {
    let [latency, run] = [live.wake_latency?, live.run_time?].map(|stats| in_ms(&stats, 2));
    Some(format!("wake latency {latency}, run time {run} ms (p50 / p99 / max)"))
}

fn topics(live: &LiveStatus) -> String {
    let row = |topic: &LiveTopic| {
        let lost = topic.lost.map_or_else(|| "unknown".to_owned(), grouped);
        let age = topic
            .age_ns
            .map_or_else(|| "none".to_owned(), |ns| format!("{:.1} s", ns as f64 / 1e9));
        [visible(&topic.topic), format!("{:.1}", topic.rate_hz), lost, age]
    };
    table(&["topic", "Hz", "lost", "age"], live.topics.iter().map(row), &[1, 2, 3])
}

"""Contents of a report: sections with their tables, made of the results."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Sequence

import numpy as np

from results import Group, Growth, Measurement, Results, Series
from stats import CAVEAT, Difference, Sample, Summary, difference
from tables import COMPARED, SMOKE_TEST, Table, difference_cells, goal_number, micro, number

STATISTICS = ("min", "mean", "median", "MAD", "p95", "p99", "max")
# Sides of the summary. Each is a column, and a reader compares a few.
MAX_COLUMNS = 10
INCOMPLETE = "The measurement is not complete: workloads or rows are missing."


@dataclass(frozen=True)
class Side:
    """A series, its values ready for statistics, and its summary."""

    series: Series
    sample: Sample
    summary: Summary | None

    @property
    def name(self) -> str:
        return self.series.name

    @property
    def is_compared(self) -> bool:
        return self.summary is not None and not self.series.invalid

    @property
    def has_plot(self) -> bool:
        # A single value has no distribution.
        return len(self.sample) >= 2


@dataclass(frozen=True)
class GroupReport:
    """A group with its sides, its differences by base and side, and its tables."""

    group: Group
    slug: str
    sides: list[Side]
    differences: dict[tuple[str, str], Difference]
    tables: list[Table] = field(default_factory=list)

    @property
    def unit(self) -> str:
        return micro(self.group.unit)


@dataclass(frozen=True)
class GrowthReport:
    """A growth and its tables."""

    growth: Growth
    slug: str
    tables: list[Table]


@dataclass(frozen=True)
class Report:
    """All that the files of a report have in common."""

    results: Results
    title: str
    headline: Table | None
    goals: str
    groups: list[GroupReport]
    growths: list[GrowthReport]
    measurements: Table | None

    def sections(self) -> list[GroupReport | GrowthReport]:
        return [*self.groups, *self.growths]

    def side_names(self) -> list[str]:
        sides = [side.name for group in self.groups for side in group.sides]
        return sides + [curve.name for one in self.growths for curve in one.growth.curves]


def make_report(results: Results) -> Report:
    """Computes all statistics of the results."""
    quick = results.is_quick
    slugs = _slugs([*(one.name for one in results.groups), *(one.name for one in results.growths)])
    groups = []
    for group, slug in zip(results.groups, slugs):
        one = _group_report(group, slug)
        tables = [table.marked(quick) for table in _group_tables(one)]
        groups.append(GroupReport(group, slug, one.sides, one.differences, tables))
    growths = [
        GrowthReport(growth, slug, [table.marked(quick) for table in _growth_tables(growth)])
        for growth, slug in zip(results.growths, slugs[len(groups) :])
    ]
    headline = _headline(groups)
    rows = results.figures
    return Report(
        results=results,
        title=f"Gleaner bench: {results.bench}"
        + (" (smoke test: values are not meaningful)" if quick else "")
        + ("" if results.is_complete else " (incomplete)"),
        headline=headline.marked(quick) if headline else None,
        goals=_goals(results),
        groups=groups,
        growths=growths,
        measurements=_measurements(rows, quick).marked(quick) if rows else None,
    )


def _slugs(names: Sequence[str]) -> list[str]:
    """Names of files, each of them once."""
    found: list[str] = []
    for name in names:
        slug = re.sub(r"[^a-z0-9]+", "-", name.lower()).strip("-")[:60].strip("-") or "group"
        further = (f"{slug}-{count}" for count in range(2, len(names) + 2))
        found.append(slug if slug not in found else next(it for it in further if it not in found))
    return found


def _group_report(group: Group, slug: str) -> GroupReport:
    samples = [(series, Sample(series.values, series.turns)) for series in group.series]
    sides = [Side(series, sample, sample.summary()) for series, sample in samples]
    compared = {side.name: side for side in sides if side.is_compared}
    differences = {}
    for base in (compared[name] for name in group.bases if name in compared):
        for side in compared.values():
            found = difference(base.sample, side.sample) if side is not base else None
            if found is not None:
                differences[base.name, side.name] = found
    return GroupReport(group, slug, sides, differences)


def cost_names(sides: Sequence[Side]) -> list[str]:
    """Names of the costs, in the order of their first appearance."""
    return list(dict.fromkeys(name for side in sides for name in side.series.costs))


def _group_tables(report: GroupReport) -> list[Table]:
    sides, names = report.sides, [side.name for side in report.sides]
    costs = cost_names(sides)
    has_reception = any(side.series.reception for side in sides)
    count = "n (answered of sent)" if has_reception else "n"
    heads = ["side", count, *STATISTICS, *map(micro, costs)]
    notes = []
    if any(len(values) > 1 for side in sides for values in side.series.costs.values()):
        notes.append("CPU, memory and power are medians over the turns.")
    for side in sides:
        if side.series.invalid:
            notes.append(f"{side.name} is invalid: {'; '.join(side.series.invalid)}.")
    title = f"{report.group.name}, in {report.unit}"
    rows = [_statistics_row(side, costs) for side in sides]
    tables = [Table(title, heads, rows, notes, names)]
    for base in report.group.bases:
        found = {side: one for (of, side), one in report.differences.items() if of == base}
        if found:
            rows = [
                [side, *difference_cells(one), ", ".join(map(number, one.turn_ratios)) or "-"]
                for side, one in found.items()
            ]
            caveat = [CAVEAT] if any(one.p is not None for one in found.values()) else []
            heads = ["side", *COMPARED, "ratio of each turn"]
            tables.append(Table(f"Against {base}", heads, rows, caveat, list(found)))
    details = list(dict.fromkeys(name for side in sides for name in side.series.details))
    if details:
        rows = [
            [side.name, *(side.series.details.get(name, "-") for name in details)] for side in sides
        ]
        tables.append(Table("Details", ["side", *map(micro, details)], rows, [], names))
    return tables


def _statistics_row(side: Side, costs: Sequence[str]) -> list[str]:
    series, found = side.series, side.summary
    count = str(len(side.sample))
    if series.reception:
        count += f" ({series.reception.answered} of {series.reception.sent})"
    cells = ["-"] * len(STATISTICS)
    if found:
        values = (found.min, found.mean, found.median, found.mad, found.p95, found.p99, found.max)
        cells = [number(value) for value in values]
        if found.n == 1:
            # One value has no spread.
            cells[3:6] = ["-"] * 3
    for cost in costs:
        turns = series.costs.get(cost)
        cells.append(number(float(np.median(turns))) if turns else "-")
    return [f"{side.name} (invalid)" if series.invalid else side.name, count, *cells]


def _headline(groups: Sequence[GroupReport]) -> Table | None:
    """Medians by workload and side, with the ratio to the best base that a workload has."""
    shown = [(one, [side for side in one.sides if side.is_compared]) for one in groups]
    shown = [(one, sides) for one, sides in shown if sides]
    counts: dict[str, int] = {}
    for _, sides in shown:
        for side in sides:
            counts[side.name] = counts.get(side.name, 0) + 1
    columns = list(counts)
    notes = ["In brackets: the median divided by that of the side marked with 1."]
    if len(columns) > MAX_COLUMNS:
        ranks = sorted(columns, key=lambda name: -counts[name])[:MAX_COLUMNS]
        columns = [name for name in columns if name in ranks]
        notes.append("Sides of fewer workloads are in the tables below only.")
    if not columns:
        return None
    rows = []
    for one, sides in shown:
        base = next((name for name in one.group.bases if (name in {s.name for s in sides})), None)
        cells = {side.name: _headline_cell(one, side, base) for side in sides}
        row = [f"{one.group.name}, {one.unit}", *(cells.get(name, "-") for name in columns)]
        rows.append(row)
    if not any("(" in cell for row in rows for cell in row[1:]):
        notes = notes[1:]
    if any(side.series.invalid for one in groups for side in one.sides):
        notes.append("Invalid sides are left out.")
    return Table("Medians", ["workload", *columns], rows, notes, columns)


def _headline_cell(one: GroupReport, side: Side, base: str | None) -> str:
    median = number(side.summary.median) if side.summary else "-"
    if side.name == base:
        return f"{median} (1)"
    found = one.differences.get((base or "", side.name))
    ratio = number(found.ratio) if found and found.ratio is not None else None
    return f"{median} ({ratio})" if ratio else median


def _growth_tables(growth: Growth) -> list[Table]:
    unit, names = micro(growth.unit), [curve.name for curve in growth.curves]
    found = [dict(curve.points) for curve in growth.curves]
    places = sorted({x for points in found for x in points})
    rows = [
        [goal_number(x), *(number(points[x]) if x in points else "-" for points in found)]
        for x in places
    ]
    heads = [growth.of, *(f"{name}, {unit}" for name in names)]
    tables = [Table(f"{growth.name}, in {unit}", heads, rows, [], [])]
    slopes = []
    for curve in growth.curves:
        x, y = (np.array([point[at] for point in curve.points]) for at in (0, 1))
        if len(set(x)) >= 2:
            off = x - x.mean()
            slope = float((off * (y - y.mean())).sum() / (off * off).sum())
            ends = f"{goal_number(x.min())}, {goal_number(x.max())}"
            slopes.append([curve.name, ("+" if slope > 0 else "") + number(slope), ends])
    if slopes:
        heads = ["side", f"{unit} for each further one of the {growth.of}", "from, to"]
        tables.append(Table("Slopes (least squares)", heads, slopes, [], names))
    return tables


def _measurements(rows: Sequence[Measurement], is_quick: bool) -> Table:
    heads = ["measurement", "goal", "median", "spread", "runs", "result"]
    cells = [_measurement_row(row) for row in rows]
    if is_quick:
        # A smoke test has no goals.
        heads, cells = [heads[0], *heads[2:5]], [[row[0], *row[2:5]] for row in cells]
    return Table("Measurements", heads, cells)


def _measurement_row(row: Measurement) -> list[str]:
    unit, goal = micro(row.unit), "-"
    for kind, bound in (row.goal or {}).items():
        sign = "<=" if kind == "at_most" else ">="
        goal = f"{sign} {goal_number(bound)} {unit}".strip()
    median, spread = "not measured", "-"
    if row.measured is not None:
        # Whole numbers count something: they have no digits below 1.
        is_count = all(value == int(value) for value in row.measured)
        found = (float(np.median(row.measured)), min(row.measured), max(row.measured))
        texts = [f"{value:.10g}" if is_count else number(value) for value in found]
        median, spread = f"{texts[0]} {unit}".strip(), f"{texts[1]} to {texts[2]}"
    result = {True: "met", False: "not met", None: "-"}[row.is_met]
    return [row.name, goal, median, spread, str(len(row.values)), result]


def _goals(results: Results) -> str:
    """A sentence about the goals; empty without any, or in a quick or incomplete run."""
    met = [row.is_met for row in results.figures if row.is_met is not None]
    is_meaningful = met and results.is_complete and not results.is_quick
    return f"{sum(met)} of {len(met)} goals are met." if is_meaningful else ""


def smoke_title(title: str, is_quick: bool) -> str:
    return f"{title} ({SMOKE_TEST})" if is_quick else title

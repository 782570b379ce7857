"""Files of a report but for its page and figures: Markdown, CSV and LaTeX."""

from __future__ import annotations

from typing import Iterator, Sequence

from report import INCOMPLETE, GroupReport, Report, cost_names
from styles import styles
from tables import SMOKE_TEST, markdown_text, micro, to_csv, to_latex, to_markdown


def markdown(report: Report) -> str:
    """The text of results.md."""
    results = report.results
    parts = [f"# {markdown_text(report.title)}\n"]
    if not results.is_complete:
        parts.append(f"{INCOMPLETE}\n")
    if report.goals:
        parts.append(f"{report.goals}\n")
    if report.headline:
        parts.append(to_markdown(report.headline))
    for section in report.sections():
        for index, table in enumerate(section.tables):
            heading = f"## {table.title}\n\n" if index == 0 else ""
            text = to_markdown(table)
            parts.append(heading + (text.split("\n\n", 1)[1] if heading else text))
    if report.measurements:
        parts.append("## Measurements\n\n" + to_markdown(report.measurements).split("\n\n", 1)[1])
    if results.notes:
        parts.append("## Notes\n\n" + _list(results.notes))
    facts = [f"{name}: {value}" for name, value in results.machine.facts.items()]
    parts.append("## Machine\n\n" + _list(facts))
    return "\n".join(parts)


def _list(texts: Sequence[str]) -> str:
    return "".join(f"- {markdown_text(text)}\n" for text in texts)


def table_files(report: Report) -> Iterator[tuple[str, str]]:
    """Names and contents of the files of `tables`."""
    for name, heads, rows in _csv_tables(report):
        if report.results.is_quick:
            heads, rows = [*heads, "status"], [(*row, SMOKE_TEST) for row in rows]
        yield name, to_csv(heads, rows)
    for section in report.sections():
        name = section.tables[0].title
        texts = [
            to_latex(table, f"{section.slug}-{index}", _caption(name, table.title))
            for index, table in enumerate(section.tables, start=1)
        ]
        yield f"{section.slug}.tex", "\n".join(texts)
    for table, name in ((report.headline, "medians"), (report.measurements, "measurements")):
        if table:
            yield f"all_{name}.tex", to_latex(table, f"all_{name}", f"{table.title}.")


def _csv_tables(report: Report) -> Iterator[tuple[str, list[str], Sequence[tuple[object, ...]]]]:
    """Names, heads and rows of the files with all digits."""
    rows = [row for group in report.groups for row in _statistics(group)]
    heads = "group,side,unit,invalid,sent,answered,n,min,mean,median,median_low_95,median_high_95"
    yield "statistics.csv", (heads + ",mad,p95,p99,max").split(","), rows
    costs = [
        (group.group.name, side.name, micro(cost), turn + 1, value)
        for group in report.groups
        for side in group.sides
        for cost in cost_names([side])
        for turn, value in enumerate(side.series.costs[cost])
    ]
    yield "costs.csv", ["group", "side", "cost_and_unit", "turn", "value"], costs
    heads = "group,base,side,unit,base_median,side_median,ratio,ratio_low_95,ratio_high_95"
    differences = [
        (group.group.name, base, side, group.unit, *found.medians, found.ratio)
        + (*(found.interval or (None, None)), found.delta, found.p)
        + (" ".join(map(str, found.turn_ratios)),)
        for group in report.groups
        for (base, side), found in group.differences.items()
    ]
    heads += ",cliffs_delta,mann_whitney_p,ratio_of_each_turn"
    yield "differences.csv", heads.split(","), differences
    points = [
        (one.growth.name, curve.name, one.growth.of, x, micro(one.growth.unit), y)
        for one in report.growths
        for curve in one.growth.curves
        for x, y in curve.points
    ]
    yield "growths.csv", ["growth", "curve", "of", "x", "unit", "value"], points
    values = [
        (row.name, micro(row.unit), *map(goal.get, ("at_least", "at_most")), run + 1, value)
        for row in report.results.figures
        for goal in [{} if report.results.is_quick else row.goal or {}]
        for run, value in enumerate(row.values)
    ]
    heads = "measurement,unit,at_least,at_most,run,value"
    yield "measurements.csv", heads.split(","), values
    looks = [
        (name, style.colour, " ".join(map(str, style.dashes)), style.marker, style.hatch)
        for name, style in styles(report.side_names()).items()
    ]
    yield "styles.csv", ["side", "colour", "dashes", "marker", "hatch"], looks


def _caption(name: str, title: str) -> str:
    return f"{name}." if title == name else f"{name}. {title}."


def _statistics(report: GroupReport) -> Iterator[tuple[object, ...]]:
    for side in report.sides:
        series, found = side.series, side.summary
        first = (report.group.name, side.name, report.unit, "; ".join(series.invalid))
        numbers: tuple[object, ...] = (None,) * 9
        if found:
            low, high = side.sample.median_interval() or (None, None)
            numbers = (found.min, found.mean, found.median, low, high)
            numbers += (found.mad, found.p95, found.p99, found.max)
        counts = series.reception
        received = (counts.sent, counts.answered) if counts else (None, None)
        yield (*first, *received, len(side.sample), *numbers)

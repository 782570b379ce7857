"""Figures of a report in the sizes of a paper, as SVG and PDF."""

from __future__ import annotations

import io
import textwrap
from typing import Any, Iterator, Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator

from report import GroupReport, GrowthReport, Report, Side, smoke_title
from stats import Floats, quantile
from styles import Style, styles
from tables import micro, number

# Widths of one column and of both, in inches.
SINGLE, DOUBLE = 3.4, 7.0
# All points of a side are drawn up to this number.
MAX_POINTS = 60
# Steps of a distribution below and above its 99th percentile: a tail has few values, which matter.
STEPS = (200, 100)
# Fewest values that have a tail.
MIN_TAIL = 100
# Panels of one figure: more do not fit on a page.
MAX_PANELS = 8

SETTINGS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "grid.linewidth": 0.4,
    "grid.color": "#d0d0d0",
    "hatch.linewidth": 0.5,
    # Letters of SVG files are outlines, and PDF files contain their fonts: both look the same
    # everywhere. The rest keeps files equal between runs.
    "svg.fonttype": "path",
    "svg.hashsalt": "gleaner",
    "pdf.fonttype": 42,
}
METADATA: dict[str, dict[str, Any]] = {
    "svg": {"Date": None, "Creator": None},
    "pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}


def plain(text: str, width: int = 200) -> str:
    """The text in lines of `width`, without formulas, which matplotlib would read in it."""
    lines = textwrap.wrap(text, width, break_long_words=True) or [""]
    return "\n".join(lines).replace("$", r"\$")


def draw_all(report: Report) -> Iterator[tuple[str, str, dict[str, bytes]]]:
    """Draws all figures of the report: for each the slug of its section, its name, and its files
    by their ending. Figures of the summary have an empty slug, or one that no section has."""
    looks = styles(report.side_names())
    is_quick = report.results.is_quick
    with matplotlib.rc_context(SETTINGS):
        shown = [(one, [side for side in one.sides if _has_bar(side)]) for one in report.groups]
        shown = [(one, sides) for one, sides in shown if sides]
        for first in range(0, len(shown), MAX_PANELS):
            name = "summary" if first == 0 else f"summary-{first // MAX_PANELS + 1}"
            panels = shown[first : first + MAX_PANELS]
            yield "both columns", name, _files(_summary(panels, looks, is_quick))
        for one, sides in shown:
            yield "", f"{one.slug}-bars", _files(_summary([(one, sides)], looks, is_quick))
        for one in report.groups:
            plotted = [side for side in one.sides if side.has_plot]
            title = smoke_title(one.group.name, is_quick)
            if plotted:
                ecdf = _ecdf(title, one.unit, plotted, looks)
                yield one.slug, f"{one.slug}-ecdf", _files(ecdf)
                yield one.slug, f"{one.slug}-box", _files(_boxes(title, one.unit, plotted, looks))
        for growth in report.growths:
            if any(curve.points for curve in growth.growth.curves):
                curves = _curves(growth, looks, is_quick)
                yield growth.slug, f"{growth.slug}-curves", _files(curves)


def _files(figure: Figure) -> dict[str, bytes]:
    found = {}
    for kind, metadata in METADATA.items():
        content = io.BytesIO()
        figure.savefig(content, format=kind, metadata=metadata)
        found[kind] = content.getvalue()
    return found


def _has_bar(side: Side) -> bool:
    return side.is_compared and side.has_plot


def _line(style: Style, is_valid: bool = True) -> dict[str, Any]:
    pattern = (0, style.dashes) if style.dashes else "-"
    look = {"color": style.colour, "linestyle": pattern, "linewidth": 1.2, "markersize": 3.5}
    return {**look, "marker": style.marker, "alpha": 1.0 if is_valid else 0.35}


def _legend(axes: Axes, names: Sequence[tuple[str, dict[str, Any]]]) -> None:
    """Fills `axes` with a legend, whose lines are long enough for the dashes."""
    axes.axis("off")
    handles = [Line2D([], [], **look) for _, look in names]
    # A name that begins with an underscore would be left out.
    labels = [plain(name if not name.startswith("_") else f" {name}", 46) for name, _ in names]
    axes.legend(handles, labels, loc="center left", handlelength=5, frameon=False, ncol=1)


def _legend_height(names: Sequence[str]) -> float:
    return 0.06 + sum(0.155 * len(textwrap.wrap(name, 46) or [""]) for name in names)


def _scale(axes: Axes, values: Sequence[Floats], unit: str) -> None:
    """Sets the scale of x: logarithmic where the values spread by more than a factor of ten."""
    low, high = min(one[0] for one in values), max(one[-1] for one in values)
    if low > 0 and high > 10 * low:
        axes.set_xscale("log")
        # Two or three labels in each power of ten, as long as there is room for them.
        steps = (1.0, 2.0, 5.0) if high < 300 * low else (1.0,)
        axes.xaxis.set_major_locator(LogLocator(10, subs=steps, numticks=12))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.xaxis.set_minor_formatter(lambda value, _: "")
    axes.set_xlabel(plain(unit))
    axes.grid(True, axis="x")


def _head(figure: Figure, title: str, width: int = 54) -> None:
    figure.suptitle(plain(title, width), x=0.02, ha="left", fontsize=8)


def _foot(figure: Figure, text: str, width: int = 72) -> None:
    figure.supxlabel(plain(text, width), x=0.02, ha="left", fontsize=6.5, color="#404040")


def _ecdf(title: str, unit: str, sides: Sequence[Side], looks: dict[str, Style]) -> Figure:
    """Cumulative distributions in steps, and below them the tail on a logarithmic scale."""
    has_tail = max(len(side.sample) for side in sides) >= MIN_TAIL
    names = [_invalid_name(side) for side in sides]
    heights = [1.9, *([1.5] if has_tail else []), _legend_height(names)]
    figure = Figure(figsize=(SINGLE, sum(heights) + 0.9), constrained_layout=True)
    rows = figure.subplots(len(heights), 1, gridspec_kw={"height_ratios": heights})
    for side in sides:
        look = _line(looks[side.name], not side.series.invalid)
        count, ascending = len(side.sample), side.sample.ascending
        kept = _kept(count)
        x, shares = ascending[kept], (kept + 1) / count
        marks = [int(np.searchsorted(shares, share)) + 1 for share in (0.25, 0.5, 0.75, 0.95)]
        steps = np.concatenate([[x[0]], x]), np.concatenate([[0.0], shares])
        rows[0].plot(*steps, drawstyle="steps-post", markevery=marks, **look)
        if has_tail:
            last = [int(np.searchsorted(shares, share)) for share in (0.99, 0.999) if count > 99]
            rows[1].plot(x, (count - kept) / count, drawstyle="steps-pre",
                         markevery=sorted({min(mark, len(x) - 1) for mark in last}), **look)
    for axes in rows[:-1]:
        _scale(axes, [side.sample.ascending for side in sides], unit)
        axes.grid(True, axis="y")
    _head(figure, title)
    rows[0].set_ylabel("share of values\nup to x")
    rows[0].set_ylim(0, 1.02)
    if has_tail:
        rows[0].set_xlabel("")
        rows[1].set_yscale("log")
        rows[1].set_ylim(top=1.2)
        rows[1].set_ylabel("share of values\nfrom x (tail)")
    looks_of = [_line(looks[side.name], not side.series.invalid) for side in sides]
    _legend(rows[-1], list(zip(names, looks_of)))
    return figure


def _invalid_name(side: Side) -> str:
    return f"{side.name} (invalid)" if side.series.invalid else side.name


def _kept(count: int) -> Any:
    """Places of the ascending values that a distribution is drawn by: all of a short series."""
    below, above = STEPS
    if count <= below + above:
        return np.arange(count)
    shares = np.concatenate([np.linspace(0, 0.99, below), np.linspace(0.99, 1, above)])
    places = np.ceil(shares * count).astype(int) - 1
    # The last values are single steps.
    return np.unique(np.concatenate([np.clip(places, 0, None), np.arange(count - 20, count)]))


def _boxes(title: str, unit: str, sides: Sequence[Side], looks: dict[str, Style]) -> Figure:
    """Quartiles with whiskers from p5 to p95, p99 and the extremes; all points of short series."""
    labels = [plain(_invalid_name(side), 22) for side in sides]
    height = 0.9 + sum(max(0.24, 0.13 * (label.count("\n") + 1) + 0.06) for label in labels)
    figure = Figure(figsize=(SINGLE, height), constrained_layout=True)
    axes = figure.subplots()
    for place, side in enumerate(sides):
        style, ascending = looks[side.name], side.sample.ascending
        alpha = 0.35 if side.series.invalid else 1.0
        shares = (0.05, 0.25, 0.5, 0.75, 0.95, 0.99)
        p5, p25, p50, p75, p95, p99 = (quantile(ascending, share) for share in shares)
        ink: dict[str, Any] = {"color": style.colour, "alpha": alpha}
        axes.plot([p5, p95], [place, place], linewidth=0.9, **ink)
        axes.barh(place, p75 - p25, 0.56, left=p25, facecolor="white", edgecolor=style.colour,
                  hatch="xxxxxx" if side.series.invalid else style.hatch, linewidth=0.8,
                  alpha=alpha, zorder=2)
        median = float(np.median(ascending))
        axes.plot([median] * 2, [place - 0.34, place + 0.34], linewidth=2.0, zorder=4, **ink)
        if len(ascending) <= MAX_POINTS:
            # Points of equal values lie beside each other, in the order of measurement.
            offsets = 0.22 * np.sin(2.4 * np.arange(len(ascending)))
            axes.plot(side.sample.values, place + offsets, style.marker, markersize=2.4, zorder=3,
                      markeredgewidth=0.3, markeredgecolor="white", **ink)
        else:
            axes.plot([p99], [place], "|", markersize=7, markeredgewidth=1.0, **ink)
            axes.plot(ascending[[0, -1]], [place] * 2, style.marker, markersize=2.6, **ink)
    axes.set_yticks(range(len(sides)))
    axes.set_yticklabels(labels)
    axes.set_ylim(len(sides) - 0.4, -0.6)
    _scale(axes, [side.sample.ascending for side in sides], unit)
    _head(figure, title)
    has_few = all(len(side.sample) <= MAX_POINTS for side in sides)
    last = "points: all values" if has_few else "|: p99; points: extremes"
    _foot(figure, f"box: quartiles, median; line: p5 to p95; {last}")
    return figure


def _summary(
    panels: Sequence[tuple[GroupReport, list[Side]]], looks: dict[str, Style], is_quick: bool
) -> Figure:
    """Medians as bars from 0 with their intervals, and p95 as a mark: a panel for each group."""
    columns = 1 if len(panels) == 1 else 2
    width = SINGLE if columns == 1 else DOUBLE
    lines = [panels[at : at + columns] for at in range(0, len(panels), columns)]
    heights = [max(0.75 + 0.27 * len(sides) for _, sides in line) for line in lines]
    figure = Figure(figsize=(width, sum(heights) + 0.2), constrained_layout=True)
    grid = figure.subplots(len(lines), columns, squeeze=False,
                           gridspec_kw={"height_ratios": heights})
    for axes in grid.flat[len(panels) :]:
        axes.axis("off")
    for index, ((one, sides), axes) in enumerate(zip(panels, grid.flat)):
        _bars(axes, one, sides, looks)
        # Bars beside each other are of one width.
        axes.set_ylim(max(len(sides) for _, sides in lines[index // columns]) - 0.4, -0.6)
        title = smoke_title(one.group.name, is_quick)
        if columns == 1:
            _head(figure, title)
        else:
            # A panel is narrower than its labels and itself: its title begins above its bars.
            axes.set_title(plain(title, 36), loc="left")
    _foot(figure, "bar: median, with its 95 % interval; |: p95; >: p95, further right",
          72 * columns)
    return figure


def _bars(axes: Axes, one: GroupReport, sides: list[Side], looks: dict[str, Style]) -> None:
    found = [(side, side.summary) for side in sides]
    highest = max(summary.median for _, summary in found if summary)
    limit = min(max(summary.p95 for _, summary in found if summary), 3 * highest)
    for place, (side, summary) in enumerate(found):
        if summary is None:
            continue
        style = looks[side.name]
        axes.barh(place, summary.median, 0.62, facecolor="white", edgecolor=style.colour,
                  hatch=style.hatch, linewidth=0.9)
        axes.barh(place, summary.median, 0.62, facecolor=style.colour, alpha=0.35)
        interval = side.sample.median_interval()
        if interval:
            axes.plot(interval, [place, place], color="black", linewidth=1.2, marker="|",
                      markersize=4)
        is_shown = summary.p95 <= limit or highest <= 0
        axes.plot([summary.p95 if is_shown else 1.04 * limit], [place], "|" if is_shown else ">",
                  color=style.colour, markersize=8 if is_shown else 3.5, markeredgewidth=1.6)
        if not is_shown:
            axes.annotate(number(summary.p95), (1.04 * limit, place), (-4, 0), ha="right",
                          textcoords="offset points", va="center", fontsize=6)
    axes.set_yticks(range(len(found)))
    axes.set_yticklabels([plain(side.name, 22) for side, _ in found])
    if highest > 0:
        axes.set_xlim(min(0.0, *(s.median for _, s in found if s)), 1.08 * limit)
    axes.set_xlabel(plain(one.unit))
    axes.grid(True, axis="x")


def _curves(report: GrowthReport, looks: dict[str, Style], is_quick: bool) -> Figure:
    curves = [curve for curve in report.growth.curves if curve.points]
    heights = [1.9, _legend_height([curve.name for curve in curves])]
    figure = Figure(figsize=(SINGLE, sum(heights) + 0.7), constrained_layout=True)
    axes, below = figure.subplots(2, 1, gridspec_kw={"height_ratios": heights})
    for curve in curves:
        ascending = sorted(curve.points)
        axes.plot([x for x, _ in ascending], [y for _, y in ascending], **_line(looks[curve.name]))
    _head(figure, smoke_title(report.growth.name, is_quick))
    axes.set_xlabel(plain(report.growth.of))
    axes.set_ylabel(plain(micro(report.growth.unit)))
    axes.grid(True)
    if all(y >= 0 for curve in curves for _, y in curve.points):
        axes.set_ylim(bottom=0)
    _legend(below, [(curve.name, _line(looks[curve.name])) for curve in curves])
    return figure

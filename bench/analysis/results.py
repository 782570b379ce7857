"""Results of benchmarks, as `results.json` has them: raw values, and the machine."""

from __future__ import annotations

import dataclasses
import json
import math
import re
import statistics
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NoReturn, get_args, get_origin, get_type_hints

FORMAT = 2
FILE = "results.json"
# Larger numbers are errors: sums of their squares would be infinite.
MAX_NUMBER = 1e100
# Control characters and halves of a pair of UTF-16 have no meaning in a file of texts.
NO_TEXT = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]+")
# Facts in which runs of one result should agree.
SAME_FACTS = ("revision", "kernel", "processor")


class InputError(Exception):
    """Input that cannot be used: the message names it, then come the cause and the way out."""

    def __init__(self, message: str, cause: str, way_out: str) -> None:
        super().__init__(message)
        self.cause = cause
        self.way_out = way_out


@dataclass(frozen=True)
class Measurement:
    """A row with a value for each run; None could not be measured. The goal is for the median:
    `at_most` or `at_least`."""

    name: str
    unit: str
    goal: dict[str, float] | None
    values: list[float | None]

    def __post_init__(self) -> None:
        if self.goal is not None and list(self.goal) not in (["at_most"], ["at_least"]):
            raise ValueError(f"the goal of `{self.name}` should be one of `at_most`, `at_least`")

    @property
    def measured(self) -> list[float] | None:
        """All values; None if there are none, or one could not be measured."""
        values = [value for value in self.values if value is not None]
        return values if values and len(values) == len(self.values) else None

    @property
    def is_met(self) -> bool | None:
        """True if the median keeps the goal, which an unmeasured one does not; None without one."""
        if self.goal is None:
            return None
        if self.measured is None:
            return False
        median = statistics.median(self.measured)
        low, high = self.goal.get("at_least", -math.inf), self.goal.get("at_most", math.inf)
        return low <= median <= high


@dataclass(frozen=True)
class Reception:
    """Numbers of messages that were sent and answered."""

    sent: int
    answered: int


@dataclass(frozen=True)
class Series:
    """Measurements of one side, in the order in which they were made. `turns` has the number of
    values of each turn, and is empty for a single one. Costs have a value for each turn; `invalid`
    has the reasons why the values mean nothing."""

    name: str
    details: dict[str, str]
    reception: Reception | None
    values: list[float]
    turns: list[int]
    costs: dict[str, list[float]]
    invalid: list[str]

    def __post_init__(self) -> None:
        total, count = sum(self.turns), len(self.values)
        if self.turns and (total != count or min(self.turns) < 0):
            raise ValueError(f"the turns of `{self.name}` add up to {total} of its {count} values")


@dataclass(frozen=True)
class Group:
    """Series under the same conditions; the others are compared with each of `bases`."""

    name: str
    unit: str
    bases: list[str]
    series: list[Series]

    def __post_init__(self) -> None:
        if len({one.name for one in self.series}) < len(self.series):
            raise ValueError(f"the series of `{self.name}` should have different names")


@dataclass(frozen=True)
class Curve:
    """Pairs of the number that was set, and the measured value."""

    name: str
    points: list[tuple[float, float]]


@dataclass(frozen=True)
class Growth:
    """Curves over a common quantity, as the CPU time over the number of lambdas."""

    name: str
    of: str
    unit: str
    curves: list[Curve]


@dataclass(frozen=True)
class Machine:
    """Facts about the machine."""

    facts: dict[str, str]


@dataclass(frozen=True)
class Results:
    """The measurements of one run of a benchmark, or of several runs."""

    bench: str
    is_quick: bool
    is_complete: bool
    machine: Machine
    figures: list[Measurement]
    groups: list[Group]
    growths: list[Growth]
    notes: list[str]


_NAMES = {str: "a text", bool: "true or false", int: "a whole number"}


def _build(kind: Any, value: Any, place: str) -> Any:
    """Makes a `kind` of a value of the file: the classes above are its form. Raises ValueError
    with the place of what has another form."""
    parts = get_args(kind)
    if type(None) in parts:
        return None if value is None else _build(parts[0], value, place)
    if dataclasses.is_dataclass(kind):
        values = {}
        for name, part in get_type_hints(kind).items():
            below = f"{place}.{name}".lstrip(".")
            if name not in _checked(value, dict, "an object", place):
                raise ValueError(f"the key `{below}` is missing")
            values[name] = _build(part, value[name], below)
        return kind(**values)  # type: ignore[operator]
    if get_origin(kind) is dict:
        items = _checked(value, dict, "an object", place).items()
        return {_text(key): _build(parts[1], one, f"{place}.{key}") for key, one in items}
    if get_origin(kind) is list:
        _checked(value, list, "a list", place)
        # Each value of a long series by itself would take most of the time of a run.
        if kind == list[float] and all(type(one) is float for one in value):
            if max(map(abs, value), default=0.0) <= MAX_NUMBER:
                return value
        return [_build(parts[0], one, f"{place}[{at}]") for at, one in enumerate(value)]
    if get_origin(kind) is tuple:
        if len(_checked(value, list, "a list", place)) != len(parts):
            raise ValueError(f"`{place}` should be {len(parts)} numbers")
        return tuple(_build(part, one, place) for part, one in zip(parts, value))
    if kind is float:
        number = _checked(value, (int, float), "a number", place)
        if abs(number) > MAX_NUMBER:
            raise ValueError(f"`{place}` should be a finite number of at most {MAX_NUMBER:g}")
        return float(number)
    _checked(value, kind, _NAMES[kind], place)
    return _text(value) if kind is str else value


def _text(value: str) -> str:
    return NO_TEXT.sub(" ", value)


def _checked(value: Any, kind: Any, name: str, place: str) -> Any:
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise ValueError(f"`{place}` should be {name}")
    return value


def _refuse_constant(name: str) -> NoReturn:
    raise ValueError(f"it has {name}, which is not a number of JSON")


def load_file(path: Path) -> Results:
    """Reads one results.json. Raises InputError for a file that is missing or has another form."""
    try:
        content = json.loads(path.read_bytes(), parse_constant=_refuse_constant)
        found = _checked(content, dict, "an object", "the file").get("format")
        if type(found) is not int or found != FORMAT:
            raise InputError(
                f"`{path}` has another format",
                f"its format is {found}; this program reads {FORMAT}",
                "measure again, or use the program of the version that wrote it",
            )
        results: Results = _build(Results, content, "")
        return results
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(
            f"cannot read the results `{path}`",
            str(error),
            "name a folder with results, or the results.json in it",
        ) from error


def load(path: Path) -> Results:
    """Reads the results in a file or a folder. A folder with a folder for each of several runs has
    one value for each run, its median, in the order of their names: values of a run are not
    independent of each other, as the speed of the machine differs between runs. Its notes are only
    about how the runs were merged.

    Raises InputError as `load_file`, and for runs of different benchmarks."""
    own = path / FILE
    runs = [own] if own.is_file() else []
    if not runs and path.is_dir():
        runs = sorted(run / FILE for run in path.iterdir() if (run / FILE).is_file())
    if not runs:
        runs = [own if path.is_dir() else path]
    if len(runs) == 1:
        return replace(load_file(runs[0]), notes=[])
    loaded = [load_file(run) for run in runs]
    first = loaded[0]
    for run, other in zip(runs, loaded):
        if (other.bench, other.is_quick) != (first.bench, first.is_quick):
            raise InputError(
                f"`{run}` does not fit the first run `{runs[0]}`",
                f"it has {_kind(other)}, the first one {_kind(first)}",
                "compare runs of one benchmark, all of them quick or none",
            )
    return _merge({run.parent.name: one for run, one in zip(runs, loaded)})


def _kind(results: Results) -> str:
    return f"the benchmark `{results.bench}`" + (" with --quick" if results.is_quick else "")


def _merge(runs: dict[str, Results]) -> Results:
    figures: dict[tuple[str, str], Measurement] = {}
    groups: dict[tuple[str, str], Group] = {}
    for folder, run in runs.items():
        for row in run.figures:
            known = figures.setdefault((row.name, row.unit), replace(row, values=[]))
            known.values.append(None if row.measured is None else statistics.median(row.measured))
        for group in run.groups:
            own = groups.setdefault((group.name, group.unit), replace(group, series=[]))
            for series in group.series:
                _add_run(own, series, folder)
    notes = []
    for fact in SAME_FACTS:
        found = dict.fromkeys(run.machine.facts.get(fact, "unknown") for run in runs.values())
        if len(found) > 1:
            notes.append(f"the runs differ: {fact}: {', '.join(found)}")
    for group in groups.values():
        for one in group.series:
            if one.values and one.invalid:
                # The other runs are valid: the series is, too.
                notes.append(f"left out: {group.name}: {one.name}: {'; '.join(one.invalid)}")
                one.invalid.clear()
    is_complete = all(run.is_complete for run in runs.values())
    return replace(next(iter(runs.values())), is_complete=is_complete, notes=notes,
                   figures=list(figures.values()), groups=list(groups.values()))


def _add_run(group: Group, series: Series, folder: str) -> None:
    """Adds the median of the run in `folder`. An invalid run adds its reasons and no value."""
    known = next((one for one in group.series if one.name == series.name), None)
    if known is None:
        known = replace(series, reception=None, values=[], turns=[], costs={}, invalid=[])
        group.series.append(known)
    if series.invalid:
        known.invalid.extend(f"run `{folder}`: {reason}" for reason in series.invalid)
    elif series.values:
        known.values.append(statistics.median(series.values))

"""Two results compared row by row, and one with itself (A/A)."""

from __future__ import annotations

import numpy as np

from results import Results
from stats import Difference, Sample, block_length, difference
from tables import COMPARED, SMOKE_TEST, difference_cells, markdown_rows, micro, number

# Draws of a check, and those of them that must see no difference: 95 are expected.
SEEDS, LEAST_EQUAL = 100, 90
# Fewest values of a series that is checked.
MIN_CHECKED = 200

Key = tuple[str, str]


def compare(a: Results, b: Results) -> str:
    """Compares `b` with `a`: a table in Markdown, with a verdict for each row."""
    of_a, of_b = _measured(a), _measured(b)
    rows = []
    for (name, unit), values in of_a.items():
        found = difference(Sample(values), Sample(of_b.get((name, unit), [])))
        if found is not None:
            medians = [f"{number(median)} {micro(unit)}".strip() for median in found.medians]
            verdict = SMOKE_TEST if a.is_quick or b.is_quick else _verdict(found)
            rows.append([name, *medians, *difference_cells(found), verdict])
    lines = [markdown_rows(["measurement", "A", "B", *COMPARED, "B is"], rows)]
    for keys, others in ((of_a, of_b), (of_b, of_a)):
        lines += [f"- only in one of them: {name}" for name, unit in keys
                  if (name, unit) not in others]
    for side, results in (("A", a), ("B", b)):
        for group in results.groups:
            for one in group.series:
                if one.invalid:
                    reasons = "; ".join(one.invalid)
                    lines.append(f"- invalid in {side}: {group.name}: {one.name}: {reasons}")
    for fact, value in a.machine.facts.items():
        other = b.machine.facts.get(fact, "unknown")
        if other != value:
            lines.append(f"- the machines differ: {fact}: {value}, and {other}")
    return "\n".join(lines) + "\n"


def _measured(results: Results) -> dict[Key, list[float]]:
    """All values by name and unit. Those of an invalid series mean nothing."""
    found: dict[Key, list[float]] = {}
    for row in results.figures:
        values = [value for value in row.values if value is not None]
        found.setdefault((row.name, row.unit), values)
    for group in results.groups:
        for one in group.series:
            values = [] if one.invalid else one.values
            found.setdefault((f"{group.name}: {one.name}", group.unit), values)
    return found


def _verdict(found: Difference) -> str:
    if found.delta is None:
        return "too few runs for a verdict"
    if found.interval is None or found.ratio is None:
        return "without a ratio"
    if not found.is_seen:
        return "no difference seen"
    ends = sorted(100 * abs(bound - 1) for bound in found.interval)
    word = "higher" if found.ratio > 1 else "lower"
    return f"{word} by {100 * abs(found.ratio - 1):.0f} % ({ends[0]:.0f} to {ends[1]:.0f})"


def check_aa(results: Results) -> tuple[str, bool]:
    """Compares each long series with itself: two sides of blocks of its neighbours, which no
    value is in twice. Returns the counts of draws that see no difference, and whether all are
    high enough."""
    lines, is_good = [], True
    for group in results.groups:
        for one in group.series:
            if len(one.values) >= MIN_CHECKED:
                equal = sum(_is_equal(one.values, seed) for seed in range(SEEDS))
                is_good = is_good and equal >= LEAST_EQUAL
                word = "" if equal >= LEAST_EQUAL else f", fewer than {LEAST_EQUAL}"
                name = f"{group.name}: {one.name}"
                lines.append(f"{name}: no difference seen in {equal} of {SEEDS}{word}")
    if not lines:
        lines.append(f"no series has {MIN_CHECKED} values: nothing to check")
    return "\n".join(lines) + "\n", is_good


def _is_equal(values: list[float], seed: int) -> bool:
    # Half a block of the bootstrap: with its own blocks, it would check itself.
    length = max(block_length(len(values)) // 2, 1)
    blocks = [values[at : at + length] for at in range(0, len(values) - length + 1, length)]
    order = np.random.RandomState(seed).permutation(len(blocks))
    half = len(blocks) // 2
    # Blocks stay in the order of their measurement, as in a real series.
    sides = [
        Sample([value for at in sorted(places) for value in blocks[at]])
        for places in (order[:half], order[half : 2 * half])
    ]
    found = difference(*sides)
    return found is not None and not found.is_seen

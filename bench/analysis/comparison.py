"""Two results compared row by row, and one with itself (A/A)."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from results import Results
from stats import Difference, Floats, Sample, block_length, difference
from tables import COMPARED, SMOKE_TEST, difference_cells, markdown_rows, micro, number

# Draws of a check, and those of them that must see no difference: 95 are expected.
SEEDS, LEAST_EQUAL = 100, 90
# Fewest values of a series that is checked.
MIN_CHECKED = 200

Key = tuple[str, str]


def compare(a: Results, b: Results) -> str:
    """Compares `b` with `a`: a table in Markdown, with a verdict for each row."""
    of_a, of_b = _measured(a), _measured(b)
    # A count that should be 0 has no ratio.
    zeros = {row.name for row in a.figures if (row.goal or {}).get("at_most", 1) <= 0}
    rows, changed = [], []
    for (name, unit), values in of_a.items():
        found = difference(Sample(values), Sample(of_b.get((name, unit), [])))
        if found is not None:
            medians = [f"{number(median)} {micro(unit)}".strip() for median in found.medians]
            verdict = SMOKE_TEST if a.is_quick or b.is_quick else _verdict(found)
            rows.append([name, *medians, *difference_cells(found), verdict])
            if name in zeros and 0 in found.medians and len(set(found.medians)) == 2:
                changed.append(f"- {name}: {medians[0]} in A, {medians[1]} in B")
    lines = [markdown_rows(["measurement", "A", "B", *COMPARED, "B is"], rows)]
    lines += changed
    for side, results, of_side, others in (("A", a, of_a, of_b), ("B", b, of_b, of_a)):
        if not results.is_complete:
            lines.append(f"- {side} is not complete")
        lines += [f"- {side}: {note}" for note in results.notes]
        lines += [f"- only in one of them: {key[0]}" for key in of_side if key not in others]
        invalid = {f"{group.name}: {one.name}": "; ".join(one.invalid)
                   for group in results.groups for one in group.series if one.invalid}
        lines += [f"- invalid in {side}: {name}: {reasons}" for name, reasons in invalid.items()]
        lines += [f"- no values in {side}: {key[0]}" for key, values in of_side.items()
                  if not values and key in others and key[0] not in invalid]
    for fact in {**a.machine.facts, **b.machine.facts}:
        value, other = (one.machine.facts.get(fact, "unknown") for one in (a, b))
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
    high enough; the text is empty without a long series. How turns differ is only stated."""
    lines, is_good = [], True
    for group in results.groups:
        for one in group.series:
            if len(one.values) >= MIN_CHECKED:
                turns = Sample(one.values, one.turns).turns
                equal = sum(_is_equal(turns, seed) for seed in range(SEEDS))
                is_good = is_good and equal >= LEAST_EQUAL
                word = "" if equal >= LEAST_EQUAL else f", fewer than {LEAST_EQUAL}"
                name = f"{group.name}: {one.name}"
                lines.append(f"{name}: no difference seen in {equal} of {SEEDS}{word}")
                pairs = [_is_unseen(Sample(a), Sample(b)) for a, b in combinations(turns, 2)]
                if pairs:
                    lines.append(f"{name}: turn against turn: no difference seen in {sum(pairs)} "
                                 f"of {len(pairs)} pairs")
    return "".join(f"{line}\n" for line in lines), is_good and bool(lines)


def _is_equal(turns: list[Floats], seed: int) -> bool:
    blocks: list[tuple[int, Floats]] = []
    for turn, values in enumerate(turns):
        # Half a block of the bootstrap: with its own blocks, it would check itself.
        length = max(block_length(len(values)) // 2, 1)
        starts = range(0, len(values) - length + 1, length)
        blocks += [(turn, values[at : at + length]) for at in starts]
    order = np.random.RandomState(seed).permutation(len(blocks))
    half = len(blocks) // 2
    return _is_unseen(*(
        # Blocks stay in their turn and in the order of their measurement, as in a real series.
        Sample(
            np.concatenate([blocks[at][1] for at in sorted(places)]),
            [sum(len(blocks[at][1]) for at in places if blocks[at][0] == turn)
             for turn in range(len(turns))],
        )
        for places in (order[:half], order[half : 2 * half])
    ))


def _is_unseen(a: Sample, b: Sample) -> bool:
    found = difference(a, b)
    return found is not None and not found.is_seen

"""Statistics of measured values, and the difference between two sets of them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESAMPLES = 1000
# Neighbours in time depend on each other, so that values are drawn in blocks of them: 1 s of an IMU
# at 100 Hz. With blocks of 25, two halves of one run differed in up to 38 of 100 draws (check-aa).
BLOCK = 100
# Shorter series have shorter blocks, so that there are this many to draw from.
BLOCKS = 20
# Fewer values make no interval, effect or probability.
FEWEST = 5
# Values of one resample: more are not drawn, which bounds the time.
MAX_DRAWN = 20_000
# Values that are drawn at a time, which bounds the memory.
CHUNK = 4_000_000

CAVEAT = (
    "Neighbouring samples depend on each other, and restarts of a side differ. For the interval, "
    f"turns are drawn first, then blocks of up to {BLOCK} neighbours within them. With few turns "
    "it is rather too narrow. The Mann-Whitney U test takes the values as independent, so that p "
    "is too small."
)


def block_length(count: int) -> int:
    """Values in a block of a series of `count` values."""
    return min(BLOCK, -(-count // BLOCKS))


def quantile(ascending: Floats, share: float) -> float:
    """The lowest of `ascending` values that at least `share` of them do not exceed."""
    # A share such as 0.07 of 100 is a little above 7 in binary.
    index = math.ceil(share * len(ascending) - 1e-9)
    return float(ascending[min(max(index, 1), len(ascending)) - 1])


@dataclass(frozen=True)
class Summary:
    """Statistics of a set of values, in their unit."""

    n: int
    min: float
    mean: float
    median: float
    mad: float
    p95: float
    p99: float
    max: float


class Sample:
    """Values in the order of their measurement, and what is computed of them once. `turns` has
    the number of values of each turn; an empty one stands for a single turn."""

    def __init__(self, values: Sequence[float] | Floats, turns: Sequence[int] = ()) -> None:
        self.values: Floats = np.asarray(values, dtype=np.float64)
        self.turns: list[Floats] = np.split(self.values, np.cumsum(turns[:-1], dtype=int))
        self.ascending: Floats = np.sort(self.values)
        self._drawn: dict[int, Floats] = {}

    def __len__(self) -> int:
        return len(self.values)

    def summary(self) -> Summary | None:
        """The statistics; None without values."""
        if len(self) == 0:
            return None
        median = float(np.median(self.values))
        return Summary(
            n=len(self),
            min=float(self.ascending[0]),
            mean=float(np.mean(self.values)),
            median=median,
            mad=float(np.median(np.abs(self.values - median))),
            p95=quantile(self.ascending, 0.95),
            p99=quantile(self.ascending, 0.99),
            max=float(self.ascending[-1]),
        )

    def drawn_medians(self, seed: int) -> Floats:
        """Medians of resamples: turns are drawn with replacement, and within each of them moving
        blocks.

        Source: H. R. Künsch, The Jackknife and the Bootstrap for General Stationary Observations,
        Annals of Statistics 17, 1989; for the turns A. C. Davison and D. V. Hinkley, Bootstrap
        Methods and their Application, 1997, section 3.8."""
        if seed not in self._drawn:
            self._drawn[seed] = self._draw(np.random.RandomState(seed))
        return self._drawn[seed]

    def _draw(self, random: np.random.RandomState) -> Floats:
        turns = [turn for turn in self.turns if len(turn)]
        share = min(1.0, MAX_DRAWN / len(self))
        orders = np.sort(random.randint(0, len(turns), (RESAMPLES, len(turns))), axis=1)
        medians: list[Floats] = []
        # Resamples of the same turns are drawn together, which is faster.
        for order, count in zip(*np.unique(orders, axis=0, return_counts=True)):
            chosen = [turns[at] for at in order]
            at_a_time = max(1, int(CHUNK / (share * sum(map(len, chosen)))))
            for first in range(0, count, at_a_time):
                rows = min(at_a_time, count - first)
                drawn = [_blocks(turn, rows, share, random) for turn in chosen]
                found = np.median(np.concatenate(drawn, axis=1), axis=1)
                if share < 1:
                    # The error of a median falls with the root of the number of values: smaller
                    # resamples have a larger one, by a known factor (the m out of n bootstrap).
                    middle = np.median(np.concatenate(chosen))
                    found = middle + (found - middle) * math.sqrt(share)
                medians.append(found)
        # Two series whose medians have the same order of turns would seem to depend on each other.
        return random.permutation(np.concatenate(medians))

    def median_interval(self) -> tuple[float, float] | None:
        """Interval of 95 % of the median; None with too few values."""
        return _middle_95(self.drawn_medians(2)) if len(self) >= FEWEST else None


def _blocks(turn: Floats, rows: int, share: float, random: np.random.RandomState) -> Floats:
    """Draws moving blocks of a share of the turn, in each of `rows`."""
    count, block = math.ceil(len(turn) * share), block_length(len(turn))
    windows = np.lib.stride_tricks.sliding_window_view(turn, block)
    drawn = windows[random.randint(0, len(windows), (rows, -(-count // block)))]
    return drawn.reshape(rows, -1)[:, :count]


def _middle_95(drawn: Floats) -> tuple[float, float]:
    ascending = np.sort(drawn)
    return quantile(ascending, 0.025), quantile(ascending, 0.975)


@dataclass(frozen=True)
class Difference:
    """The difference of `b` from `a`. With fewer than five values on a side, only the medians and
    their ratio are known; a median of 0 or less has no ratio."""

    medians: tuple[float, float]
    ratio: float | None
    # Ratios of the medians of the first turns, of the second ones, and so on.
    turn_ratios: tuple[float, ...] = ()
    interval: tuple[float, float] | None = None
    # Cliff's delta: the share of pairs in which b is higher, minus that in which a is.
    delta: float | None = None
    # Probability of such a delta by chance, by the Mann-Whitney U test.
    p: float | None = None

    @property
    def is_seen(self) -> bool:
        """True if the interval excludes 1, which means no difference."""
        return self.interval is not None and not self.interval[0] <= 1.0 <= self.interval[1]


def difference(a: Sample, b: Sample) -> Difference | None:
    """Compares `b` with `a`; None if one of them is empty."""
    if len(a) == 0 or len(b) == 0:
        return None
    medians = float(np.median(a.values)), float(np.median(b.values))
    ratio = medians[1] / medians[0] if min(medians) > 0 else None
    turn_ratios = _turn_ratios(a.turns, b.turns)
    if min(len(a), len(b)) < FEWEST:
        return Difference(medians, ratio, turn_ratios)
    interval = None
    if ratio is not None:
        # Different seeds: the same blocks of both sides would hide a common drift.
        below, above = a.drawn_medians(1), b.drawn_medians(2)
        if below.min() > 0:
            interval = _middle_95(above / below)
    delta, p = _mann_whitney(a.values, b.values)
    return Difference(medians, ratio, turn_ratios, interval, delta, p)


def _turn_ratios(a: Sequence[Floats], b: Sequence[Floats]) -> tuple[float, ...]:
    """Empty with fewer than two turns, different numbers of them, or a turn without a ratio."""
    if not len(a) == len(b) >= 2 or not all(map(len, (*a, *b))):
        return ()
    pairs = [(float(np.median(one)), float(np.median(other))) for one, other in zip(a, b)]
    if min(map(min, pairs)) <= 0:
        return ()
    return tuple(above / below for below, above in pairs)


def _mann_whitney(a: Floats, b: Floats) -> tuple[float, float]:
    """Cliff's delta and the two-sided probability, with the corrections for ties and for whole
    numbers.

    Source: H. B. Mann and D. R. Whitney, On a Test of Whether One of Two Random Variables Is
    Stochastically Larger than the Other, Annals of Mathematical Statistics 18, 1947."""
    n, m = float(len(a)), float(len(b))
    _, places, counts = np.unique(np.concatenate([a, b]), return_inverse=True, return_counts=True)
    ranks = np.cumsum(counts) - (counts - 1) / 2.0
    u = float(np.sum(ranks[places[len(a) :]])) - m * (m + 1) / 2
    equal = counts.astype(np.float64)
    ties = float(np.sum(equal**3 - equal))
    variance = n * m / 12 * (n + m + 1 - ties / ((n + m) * (n + m - 1)))
    off = max(abs(u - n * m / 2) - 0.5, 0.0)
    z = off / math.sqrt(variance) if variance > 0 else 0.0
    return 2 * u / (n * m) - 1, math.erfc(z / math.sqrt(2))

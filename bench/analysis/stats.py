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
    "Neighbouring samples depend on each other. The interval is drawn from blocks of "
    f"up to {BLOCK} neighbours; the Mann-Whitney U test takes the values as independent, "
    "so that p is too small."
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
    """Values in the order of their measurement, and what is computed of them once."""

    def __init__(self, values: Sequence[float] | Floats) -> None:
        self.values: Floats = np.asarray(values, dtype=np.float64)
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
        """Medians of resamples by the moving-block bootstrap.

        Source: H. R. Künsch, The Jackknife and the Bootstrap for General Stationary Observations,
        Annals of Statistics 17, 1989."""
        if seed not in self._drawn:
            self._drawn[seed] = self._draw(np.random.RandomState(seed))
        return self._drawn[seed]

    def _draw(self, random: np.random.RandomState) -> Floats:
        count = min(len(self), MAX_DRAWN)
        block = block_length(len(self))
        windows = np.lib.stride_tricks.sliding_window_view(self.values, block)
        medians: list[Floats] = []
        at_a_time = max(1, CHUNK // count)
        for first in range(0, RESAMPLES, at_a_time):
            shape = (min(at_a_time, RESAMPLES - first), -(-count // block))
            drawn = windows[random.randint(0, len(windows), shape)]
            medians.append(np.median(drawn.reshape(shape[0], -1)[:, :count], axis=1))
        found = np.concatenate(medians)
        if count == len(self):
            return found
        # The error of a median falls with the root of the number of values: smaller resamples
        # have a larger one, by a known factor (the m out of n bootstrap).
        median = float(np.median(self.values))
        narrowed: Floats = median + (found - median) * math.sqrt(count / len(self))
        return narrowed

    def median_interval(self) -> tuple[float, float] | None:
        """Interval of 95 % of the median; None with too few values."""
        return _middle_95(self.drawn_medians(2)) if len(self) >= FEWEST else None


def _middle_95(drawn: Floats) -> tuple[float, float]:
    ascending = np.sort(drawn)
    return quantile(ascending, 0.025), quantile(ascending, 0.975)


@dataclass(frozen=True)
class Difference:
    """The difference of `b` from `a`. With fewer than five values on a side, only the medians and
    their ratio are known; a median of 0 or less has no ratio."""

    medians: tuple[float, float]
    ratio: float | None
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
    if min(len(a), len(b)) < FEWEST:
        return Difference(medians, ratio)
    interval = None
    if ratio is not None:
        # Different seeds: the same blocks of both sides would hide a common drift.
        below, above = a.drawn_medians(1), b.drawn_medians(2)
        if below.min() > 0:
            interval = _middle_95(above / below)
    delta, p = _mann_whitney(a.values, b.values)
    return Difference(medians, ratio, interval, delta, p)


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

"""Statistics against values that are worked out another way."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

import stats
from stats import Sample, difference, quantile


def shuffled(count: int, start: float) -> list[float]:
    return [start + n * 7919 % count for n in range(count)]


def test_a_summary_has_the_usual_statistics() -> None:
    found = Sample([3, 1, 2, 4, 100]).summary()
    assert found == stats.Summary(5, 1, 22, 3, 1, 100, 100, 100)
    hundred = Sample(shuffled(100, 1)).summary()
    assert hundred is not None and (hundred.median, hundred.p95, hundred.p99) == (50.5, 95, 99)
    assert Sample([]).summary() is None


def test_a_quantile_is_the_lowest_value_that_the_share_does_not_exceed() -> None:
    hundred = np.arange(1.0, 101.0)
    # 0.07 * 100 is 7.000000000000001.
    assert [quantile(hundred, share) for share in (0, 0.07, 0.95, 1)] == [1, 7, 95, 100]


def test_the_u_test_agrees_with_a_worked_example() -> None:
    # Of 36 pairs of a tortoise and a hare, U = 11 have a hare that took longer.
    found = difference(Sample([1, 7, 8, 9, 10, 11]), Sample([2, 3, 4, 5, 6, 12]))
    assert found is not None and found.delta == pytest.approx(2 * 11 / 36 - 1)
    # The standard score, corrected for whole numbers, is 6.5 / sqrt(39).
    assert found.p == pytest.approx(0.298, abs=0.001)


def test_delta_counts_pairs_and_ties_widen_p() -> None:
    random = np.random.RandomState(5)
    a, b = random.randint(1, 6, 40).astype(float), random.randint(2, 7, 30).astype(float)
    pairs = [np.sign(y - x) for x, y in product(a, b)]
    found = difference(Sample(a), Sample(b))
    assert found is not None and found.delta == pytest.approx(np.mean(pairs))
    # The variance of U by the formula for groups of ties, written out.
    equal = [int(np.sum(np.concatenate([a, b]) == value)) for value in range(8)]
    ties = sum(count**3 - count for count in equal)
    variance = 40 * 30 / 12 * (71 - ties / (70 * 69))
    score = (abs(sum(pairs)) / 2 - 0.5) / variance**0.5
    draws = np.abs(random.normal(size=400_000))
    assert found.p == pytest.approx(float(np.mean(draws > score)), rel=0.1)
    same = difference(Sample([2.0] * 9), Sample([2.0] * 9))
    assert same is not None and (same.delta, same.p, same.is_seen) == (0, 1, False)


def test_intervals_cover_a_known_shift() -> None:
    random = np.random.RandomState(7)
    covered = 0
    for _ in range(40):
        a, b = random.lognormal(size=200), 1.25 * random.lognormal(size=300)
        found = difference(Sample(a), Sample(b))
        assert found is not None and found.interval is not None
        covered += found.interval[0] <= 1.25 <= found.interval[1]
    # 38 are expected.
    assert covered >= 34
    seen = difference(Sample(shuffled(200, 100)), Sample(shuffled(200, 150)))
    assert seen is not None and seen.is_seen and seen.ratio == pytest.approx(1.25, abs=0.01)


def test_neighbours_that_are_alike_widen_an_interval() -> None:
    values = np.repeat(np.random.RandomState(1).lognormal(size=100), 20)
    widths = []
    for sample in (Sample(values), Sample(np.random.RandomState(2).permutation(values))):
        interval = sample.median_interval()
        assert interval is not None
        widths.append(interval[1] - interval[0])
    assert widths[0] > 2 * widths[1]


def test_intervals_cover_the_ratio_of_sides_whose_turns_differ(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(stats, "RESAMPLES", 200)
    random = np.random.RandomState(6)
    covered = {(): 0, (40,) * 8: 0}
    for _ in range(40):
        levels = np.exp(0.1 * random.normal(size=(2, 8, 1)))
        sides = (levels * random.lognormal(0, 0.1, (2, 8, 40))).reshape(2, -1)
        for turns in covered:
            found = difference(*(Sample(side, turns) for side in sides))
            assert found is not None and found.interval is not None
            covered[turns] += found.interval[0] <= 1 <= found.interval[1]
    # 38 are expected; values of one series, whose turns are not known, cover fewer.
    assert covered[(40,) * 8] >= 34 > 30 >= covered[()]


def test_turns_of_both_sides_are_compared_in_their_order() -> None:
    a, b = [1.0, 1, 2, 2, 2, 4], [3.0, 3, 3, 1, 8, 8]
    found = difference(Sample(a, [2, 3, 1]), Sample(b, [3, 1, 2]))
    assert found is not None and found.turn_ratios == (3, 0.5, 2)
    for turns in ([], [6], [3, 3], [0, 4, 2]):
        found = difference(Sample(a, [2, 3, 1]), Sample(b, turns))
        assert found is not None and found.turn_ratios == ()
    # A turn without values is not drawn.
    assert Sample(a, [0, 6]).median_interval() == Sample(a, [6, 0]).median_interval()


def test_a_long_series_has_the_interval_of_all_its_values(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.RandomState(3).lognormal(size=4000)
    in_turns = np.concatenate([values[:2000], 1.2 * values[2000:]])
    every = Sample(values).drawn_medians(1).std()
    of_turns = Sample(in_turns, [2000, 2000]).drawn_medians(1).std()
    monkeypatch.setattr(stats, "MAX_DRAWN", 500)
    assert Sample(values).drawn_medians(1).std() == pytest.approx(every, rel=0.15)
    # Turns do not differ less when fewer values of them are drawn.
    fewer = Sample(in_turns, [2000, 2000]).drawn_medians(1).std()
    assert fewer == pytest.approx(of_turns, rel=0.15) and of_turns > 2 * every


def test_a_million_values_have_all_statistics() -> None:
    values = np.random.RandomState(4).lognormal(size=1_000_000)
    interval = Sample(values).median_interval()
    # The error of the median is 1 / (2 f sqrt(n)), with the density f = 0.399.
    assert interval is not None
    assert interval[1] - interval[0] == pytest.approx(4 * 0.00125, rel=0.15)


def test_few_values_have_a_ratio_only_and_those_below_0_none() -> None:
    few = difference(Sample([1, 1.1, 1.2]), Sample(shuffled(9, 2)))
    assert few is not None and few.ratio is not None
    assert (few.interval, few.delta, few.p, few.is_seen) == (None, None, None, False)
    below = difference(Sample(shuffled(9, -4)), Sample(shuffled(9, 2)))
    assert below is not None and (below.ratio, below.interval) == (None, None)
    assert below.delta is not None and below.delta > 0.5
    assert difference(Sample([]), Sample([1])) is None

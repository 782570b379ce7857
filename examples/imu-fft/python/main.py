"""Road roughness: the power of the vertical acceleration at the frequencies at which a road shakes
a car.

These are the rules of the lambda, which its Rust twin follows exactly, too. All arithmetic is in
64-bit floats.

1. *Stamps* are ``at_ns``, by which the host orders samples. Every sample of the input wakes the
   lambda.
2. *The period* is learnt once, from the first 33 stamps: of their 32 intervals, sorted, the one at
   index 16. If a stamp during learning is not later than the previous one, learning restarts with
   that sample as the first.
3. *A window* has ``n`` samples: the power of two nearest to ``window_s * 1e9 / period``, the larger
   one if two are equally near, at least 16 and at most 4096. It stays the same for the life of the
   lambda.
4. *A run* is a sequence of samples without a gap: no interval in it is below 1 ns or above 2.5
   periods. A sample after a gap is the first of a new run; no window includes a gap. The 33 samples
   of rule 2 count as well.
5. A window is *complete* with the sample that is number ``n``, ``n + n/4``, ``n + 2n/4`` and so on
   in its run. It has the newest ``n`` samples of the ring, and is skipped if there are fewer, for
   example because the host had to drop some. Windows that were complete before the period was known
   are skipped, too.
6. *The rate* of a window follows from its own stamps: ``(n - 1) * 1e9 / (last - first)`` Hz. Bin
   ``k`` is at ``k * (rate / n)`` Hz.
7. Gravity is removed, since it would fill the lowest bins: the first sample of the window is
   subtracted from all, then the mean of the differences. So a constant leaves exactly 0, in any
   order of summation. Then the one-sided power spectral density is computed, with the periodic Hann
   window ``w[j] = (1 - cos(2 pi j / n)) / 2``, as in ``docs/kernels.md``::

       density[k] = c[k] |sum over j of w[j] x[j] exp(-2 pi i j k / n)|^2
                    / (rate * sum over j of w[j]^2)

   for ``k`` of 0 to ``n/2``, where ``c`` is 1 for the first and the last bin and 2 for the others.
8. *The power* in a band is the sum of its bins, from its lower edge (inclusive) to its upper one
   (exclusive), times ``rate / n``, in (m/s^2)^2. *The score* is the sum of 0.2 times the power from
   0.5 to 2 Hz, 0.5 times that from 2 to 8 Hz, and all of that from 8 to 20 Hz.
9. ``peak_hz`` is the frequency of the largest bin from 1 to 6 Hz, both inclusive; the lowest of
   equal ones; 0 if there is none.
10. A score above ``rough`` is an event ``rough-road`` with that score, at the last sample of the
    window. NaN is not above.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gleaner import Column, Context, Sample

LEARN = 33
SMALLEST, LARGEST = 16, 4096
GAP_PERIODS = 2.5
# Lower and upper edge in Hz, and weight.
BANDS = ((0.5, 2.0, 0.2), (2.0, 8.0, 0.5), (8.0, 20.0, 1.0))
PEAK_HZ = (1.0, 6.0)

Floats = npt.NDArray[np.float64]


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.imu = ctx.input("imu")
        self.vertical = self.imu.field("linear_acceleration.z")
        self.rough: float = ctx.config["rough"]
        self.road = Road(ctx.config["window_s"])

    def on_event(self, ctx: Context, event: Sample) -> None:
        n = self.road.note(event.stamps.at_ns)
        if n == 0:
            return
        window = self.imu.column(self.vertical, n)
        if len(window.values) < n:
            return
        score, peak_hz = self.road.roughness(window)
        if score > self.rough:
            ctx.event("rough-road", score, peak_hz=peak_hz)


class Road:
    """State of the rules after the samples so far. Does not call the host."""

    def __init__(self, window_s: float) -> None:
        self.window_s = window_s
        self.learning: list[int] = []
        self.period_ns = 0
        self.last_ns = 0
        self.run = 0
        self.weights: Floats = np.empty(0)

    def note(self, now: int) -> int:
        """Adds a sample by its stamp. Returns the length of the window that it completes, in
        samples; 0 if it completes none."""
        if self.period_ns == 0:
            self.learn(now)
        else:
            self.run = self.run + 1 if follows(now - self.last_ns, self.period_ns) else 1
        self.last_ns = now
        n = len(self.weights)
        return n if n > 0 and self.run >= n and (self.run - n) % (n // 4) == 0 else 0

    def learn(self, now: int) -> None:
        """Applies rules 2 to 4 to the first samples."""
        if self.learning and now <= self.learning[-1]:
            self.learning.clear()
        self.learning.append(now)
        if len(self.learning) < LEARN:
            return
        intervals = [later - earlier for earlier, later in zip(self.learning, self.learning[1:])]
        self.period_ns = sorted(intervals)[len(intervals) // 2]
        self.run = 1
        for interval in intervals:
            self.run = self.run + 1 if follows(interval, self.period_ns) else 1
        n = samples(self.window_s * 1e9 / self.period_ns)
        self.weights = (1 - np.cos(2 * np.pi * np.arange(n) / n)) / 2
        self.learning.clear()

    def roughness(self, window: Column) -> tuple[float, float]:
        """Returns the score in (m/s^2)^2 and the peak in Hz of the window that was just completed,
        of vertical accelerations in m/s^2."""
        rate = (len(window.values) - 1) * 1e9 / float(window.at_ns[-1] - window.at_ns[0])
        return roughness(window.values, rate, self.weights)


def follows(interval_ns: int, period_ns: int) -> bool:
    """Returns whether a sample continues the run of the previous one."""
    return 0 < interval_ns <= GAP_PERIODS * period_ns


def samples(wanted: float) -> int:
    """Returns the power of two nearest to `wanted`; the larger one if two are equally near."""
    n = SMALLEST
    while n < LARGEST and wanted >= 1.5 * n:
        n *= 2
    return n


def roughness(signal: Floats, rate: float, weights: Floats) -> tuple[float, float]:
    """Returns the score in (m/s^2)^2 and the peak in Hz of one window. `signal` is in m/s^2, shape
    (n,), oldest first."""
    n = len(signal)
    bin_hz = rate / n
    risen = signal - signal[0]
    amplitudes = np.fft.rfft(weights * (risen - risen.mean()))
    density = 2 * np.abs(amplitudes) ** 2 / (rate * np.sum(weights**2))
    density[[0, -1]] /= 2
    at_hz = np.arange(len(density)) * bin_hz
    score = sum(
        weight * float(density[(low <= at_hz) & (at_hz < high)].sum()) * bin_hz
        for low, high, weight in BANDS
    )
    within = np.flatnonzero((PEAK_HZ[0] <= at_hz) & (at_hz <= PEAK_HZ[1]))
    peak_hz = float(at_hz[within[density[within].argmax()]]) if len(within) else 0.0
    return float(score), peak_hz

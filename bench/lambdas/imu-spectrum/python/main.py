"""Road roughness with one spectrum for each message: the power of the vertical acceleration in four
bands.

These are the rules of the lambda, which its Rust twin follows exactly, too. All arithmetic is in
64-bit floats.

1. Every sample of the input wakes the lambda. From the 256th sample on, each wake computes one
   spectrum, of the newest 256 samples.
2. *The rate* is taken as 100 Hz, so no stamp is read: bin ``k`` is at ``k * 100 / 256`` Hz.
3. Gravity is removed, since it would fill the lowest bins: the first sample of the window is
   subtracted from all, then the mean of the differences. So a constant leaves exactly 0.
4. *The power* of bin ``k`` in (m/s^2)^2, with the periodic Hann window
   ``w[j] = (1 - cos(2 pi j / n)) / 2`` and ``n = 256``, is::

       power[k] = 2 |sum over j of w[j] x[j] exp(-2 pi i j k / n)|^2 / (n * sum over j of w[j]^2)

5. *The score* is 0.2 times the power from 0.5 to 2 Hz, 0.5 times that from 2 to 8 Hz, all of that
   from 8 to 20 Hz, and 0.5 times that from 20 to 45 Hz. A band has the bins from its lower edge
   (inclusive) to its upper one (exclusive).
6. A score above ``rough`` is an event ``rough-road`` with that score. NaN is not above.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from gleaner import Context, Sample

Floats = npt.NDArray[np.float64]

SAMPLES = 256
RATE_HZ = 100.0
# Lower and upper edge in Hz, and weight.
BANDS = ((0.5, 2.0, 0.2), (2.0, 8.0, 0.5), (8.0, 20.0, 1.0), (20.0, 45.0, 0.5))


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.imu = ctx.input("imu")
        self.vertical = self.imu.field("linear_acceleration.z")
        self.rough: float = ctx.config["rough"]

    def on_event(self, ctx: Context, event: Sample) -> None:
        signal = self.imu.column(self.vertical, SAMPLES).values
        if len(signal) < SAMPLES:
            return
        found = score(signal)
        if found > self.rough:
            ctx.event("rough-road", found)


def factors(window: Floats) -> Floats:
    """Returns what the squared amplitude of each bin adds to the score."""
    at_hz = np.arange(SAMPLES // 2 + 1) * (RATE_HZ / SAMPLES)
    weights = np.zeros(len(at_hz))
    for low, high, weight in BANDS:
        weights[(low <= at_hz) & (at_hz < high)] = weight
    return weights * (2 / (SAMPLES * np.sum(window**2)))


WINDOW: Floats = (1 - np.cos(2 * np.pi * np.arange(SAMPLES) / SAMPLES)) / 2
FACTORS = factors(WINDOW)


def score(signal: Floats) -> float:
    """Returns the score in (m/s^2)^2 of 256 vertical accelerations in m/s^2, oldest first. Does not
    call the host."""
    risen = signal - signal[0]
    amplitudes = np.fft.rfft(WINDOW * (risen - risen.mean()))
    return float(FACTORS @ np.abs(amplitudes) ** 2)

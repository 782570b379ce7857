"""Speed mismatch: wheel speed and accelerometer disagree, because wheels slip or a sensor is wrong.

Two sensors that measure the same in different ways check each other. A constant difference, for
example of an IMU that is not mounted level, is learnt slowly and removed; a sudden difference is an
event.
"""

from __future__ import annotations

import numpy as np
from gleaner import Column, Context

SECOND_NS = 1_000_000_000
# Maximum distance of the first and last sample from the ends of a window: a sensor may send only
# ten times a second.
EDGE_NS = 200_000_000
REST_NS = 3_000_000_000
# The offset is the mean of the first 100 ticks; then it follows with a time constant of 100 ticks.
TICKS = 100


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.imu, self.speed = ctx.input("imu"), ctx.input("speed")
        self.forward = self.imu.field("linear_acceleration.x")
        self.wheels = self.speed.field("twist.linear.x")
        self.mismatch_mps: float = ctx.config["mismatch_mps"]
        self.offset_mps = 0.0
        self.ticks = 0
        self.rest_until_ns = 0

    def on_tick(self, ctx: Context) -> None:
        now = ctx.now_ns()
        imu = self.imu.column_since(self.forward, now - SECOND_NS)
        wheels = self.speed.column_since(self.wheels, now - SECOND_NS)
        if not (full(imu, now) and full(wheels, now)):
            return
        # Change of speed in one second: by the wheels, from the start and end of the window; by the
        # IMU, the mean acceleration.
        span = max(len(wheels.values) // 10, 1)
        gained = float(np.median(wheels.values[-span:]) - np.median(wheels.values[:span]))
        by_wheels = gained * SECOND_NS / float(wheels.at_ns[-1] - wheels.at_ns[0])
        by_imu = float(imu.values.mean())
        if not np.isfinite(by_wheels - by_imu):
            return
        self.ticks = min(self.ticks + 1, TICKS)
        if self.ticks == 1:
            self.offset_mps = by_wheels - by_imu
        sudden = by_wheels - by_imu - self.offset_mps
        # Clipped, so that a sudden difference moves the offset only a little, and a lasting one is
        # learnt.
        self.offset_mps += max(-self.mismatch_mps, min(self.mismatch_mps, sudden)) / self.ticks
        if abs(sudden) >= self.mismatch_mps and now >= self.rest_until_ns:
            self.rest_until_ns = now + REST_NS
            ctx.event(
                "speed-mismatch",
                abs(sudden),
                wheels_mps=by_wheels,
                imu_mps=by_imu,
                offset_mps=self.offset_mps,
            )


def full(window: Column, now: int) -> bool:
    """Returns whether samples cover the whole second: the sensor did not start or stop in it."""
    at_ns = window.at_ns
    return len(at_ns) > 1 and bool(
        at_ns[0] <= now - SECOND_NS + EDGE_NS and at_ns[-1] >= now - EDGE_NS
    )

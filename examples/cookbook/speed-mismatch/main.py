"""Speed mismatch: the speed on the bus changes otherwise than the accelerometer says. Wheels slip, or a sensor lies.

Two sensors that measure the same in different ways judge each other. What differs all the time, as an IMU that is
not mounted level, is learnt slowly and taken out; what differs suddenly is the event.
"""

from __future__ import annotations

import numpy as np
from gleaner import Column, Context

SECOND_NS = 1_000_000_000
FULL_NS = 950_000_000
REST_NS = 3_000_000_000
# The offset is the mean of the first 100 ticks, and then follows within as many.
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
        # Of the second: the wheels' speed at its end less that at its beginning, and the integral of the acceleration.
        span = max(len(wheels.values) // 10, 1)
        by_wheels = float(np.median(wheels.values[-span:]) - np.median(wheels.values[:span]))
        by_imu = float(imu.values.mean()) * float(imu.at_ns[-1] - imu.at_ns[0]) / 1e9
        self.ticks = min(self.ticks + 1, TICKS)
        if self.ticks == 1:
            self.offset_mps = by_wheels - by_imu
        sudden = by_wheels - by_imu - self.offset_mps
        # Clipped: what is sudden moves the offset a little, so that what stays for good becomes usual.
        self.offset_mps += max(-self.mismatch_mps, min(self.mismatch_mps, sudden)) / self.ticks
        if abs(sudden) >= self.mismatch_mps and now >= self.rest_until_ns:
            self.rest_until_ns = now + REST_NS
            ctx.event("speed-mismatch", abs(sudden), wheels_mps=by_wheels, imu_mps=by_imu, offset_mps=self.offset_mps)


def full(window: Column, now: int) -> bool:
    """Whether a window reaches over the second: no sensor began, or broke off, in it."""
    return len(window.at_ns) > 1 and bool(window.at_ns[-1] - window.at_ns[0] >= FULL_NS)

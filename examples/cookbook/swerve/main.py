"""Swerve: lateral acceleration to one side and then to the other within seconds, as in an evasive
manoeuvre.

One side alone is a bend. Both sides must exceed the limit, close together; after an event there is
a pause.
"""

from __future__ import annotations

from gleaner import Context, Sample

WINDOW_NS = 500_000_000
# A window is full if its oldest sample is within 0.2 s of its start: an IMU may send only ten times
# a second.
FULL_NS = 300_000_000
REST_NS = 2_000_000_000


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.imu = ctx.input("imu")
        self.lateral = self.imu.field("linear_acceleration.y")
        self.limit: float = ctx.config["swerve_mps2"]
        self.within_ns = int(ctx.config["within_s"] * 1e9)
        # By side: the last time above the limit, and the largest value since the last swerve.
        self.seen_ns: dict[str, int] = {}
        self.peak: dict[str, float] = {}
        self.rest_until_ns = 0

    def on_event(self, ctx: Context, event: Sample) -> None:
        now = ctx.now_ns()
        if now < self.rest_until_ns:
            return
        # A mean over half a second: bumps of the road are shorter, and a manoeuvre of the driver is
        # longer.
        window = self.imu.column_since(self.lateral, now - WINDOW_NS)
        if now - window.at_ns[0] < FULL_NS:
            return
        mean = float(window.values.mean())
        # Not `abs(mean) < ...`, so that NaN is ignored.
        if not abs(mean) >= self.limit:
            return
        side, other = ("left", "right") if mean > 0 else ("right", "left")
        if now - self.seen_ns.get(side, now) > self.within_ns:
            self.peak.pop(side, None)
        self.seen_ns[side] = now
        self.peak[side] = max(self.peak.get(side, 0.0), abs(mean))
        if now - self.seen_ns.get(other, now - self.within_ns - 1) <= self.within_ns:
            ctx.event("swerve", max(self.peak.values()), first=other, then=side)
            self.seen_ns, self.peak, self.rest_until_ns = {}, {}, now + REST_NS

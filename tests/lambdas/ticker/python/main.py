"""Reports at each tick the time, the missed ticks, and the newest acceleration.

Its twin must report the same."""

from __future__ import annotations

from gleaner import Context


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.imu = ctx.input("imu")
        self.forward = self.imu.field("linear_acceleration.x")

    def on_tick(self, ctx: Context) -> None:
        sample = self.imu.newest()
        newest = 0.0 if sample is None else sample.number(self.forward)
        ctx.event("tick", newest, at=ctx.now_ns(), missed=ctx.missed)

"""Measures calls of the host, and ways to the pixels of a frame.

It reports the CPU time of each in ns, as the score of an event."""

import time
import timeit
from typing import Callable

import gleaner

COLUMN = 256
# CPU time of one measurement in ns.
MEASURED_NS = 5_000_000


class Lambda:
    def __init__(self, ctx: gleaner.Context) -> None:
        self.imu = ctx.input("imu")
        self.field = self.imu.field("linear_acceleration.x")

    def on_event(self, ctx: gleaner.Context, sample: gleaner.Sample) -> None:
        frame = sample.as_frame()
        assert frame.array().shape == (1080, 1920, 3)
        assert len(self.imu.column(self.field, COLUMN).values) == COLUMN
        calls: dict[str, Callable[[], object]] = {
            "call": ctx.now_ns,
            "column": lambda: self.imu.column(self.field, COLUMN),
            "luma-by-host": frame.mean_luma,
            "array": frame.array,
            "copy": lambda: frame.array().copy(),
            "mean": lambda: frame.array().mean(),
        }
        for name, call in calls.items():
            ctx.event(name, cost_ns(call))


def cost_ns(call: Callable[[], object]) -> float:
    """CPU time of `call` in ns, over as many calls as take some milliseconds."""
    timer = timeit.Timer(call, timer=time.thread_time_ns)
    once_ns = max(timer.timeit(10) / 10, 1)
    rounds = max(int(MEASURED_NS / once_ns), 1)
    return timer.timeit(rounds) / rounds

"""Hard braking in the dark: the car brakes while the newest camera frame is dark."""

from __future__ import annotations

from gleaner import Column, Context, Sample

# Length of the window.
WINDOW_NS = 500_000_000
# Minimum age of the oldest sample in a full window.
FULL_NS = 450_000_000
# Pause after a trigger.
REFRACTORY_NS = 3_000_000_000


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.imu = ctx.input("imu")
        self.forward = self.imu.field("linear_acceleration.x")
        self.brake_mps2: float = ctx.config["brake_mps2"]
        self.dark_luma: float = ctx.config["dark_luma"]
        self.last_ns: int | None = None

    def on_event(self, ctx: Context, event: Sample) -> None:
        now = ctx.now_ns()
        mean = braking(self.imu.column_since(self.forward, now - WINDOW_NS), now, self.brake_mps2)
        if mean is None or not rested(self.last_ns, now):
            return
        # The image is decoded only here, so most frames are never decoded.
        luma = event.as_frame().mean_luma()
        if luma < self.dark_luma:
            self.last_ns = now
            ctx.event("brake-dark", -mean, luma=luma)


def braking(window: Column, now: int, brake_mps2: float) -> float | None:
    """Returns the mean of the window in m/s²; None unless the window is full and its mean is below
    `brake_mps2`."""
    if len(window.at_ns) == 0 or now - window.at_ns[0] < FULL_NS:
        return None
    mean = float(window.values.mean())
    return mean if mean < brake_mps2 else None


def rested(last_ns: int | None, now: int) -> bool:
    """Returns whether the pause after the trigger at `last_ns` is over; None is no trigger."""
    return last_ns is None or now - last_ns >= REFRACTORY_NS

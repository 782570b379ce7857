"""Stopped in traffic: records from the time when the car has stood for a while until it moves
again.

`start` and `stop` record a period of any length. There are two thresholds, one for standing and one
for moving. With only one, a creeping car would start a new recording every metre.
"""

from __future__ import annotations

from gleaner import Context, Sample

LABEL = "stopped"
# Entry in `scratch` during a recording, so that after a fault a fresh instance can end the
# recording.
NAME = "recording"


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.speed = ctx.input("speed").field("twist.linear.x")
        self.stopped_mps: float = ctx.config["stopped_mps"]
        self.going_mps: float = ctx.config["going_mps"]
        self.after_ns = int(ctx.config["after_s"] * 1e9)
        if self.going_mps <= self.stopped_mps:
            raise ValueError(
                f"going_mps is {self.going_mps}; it must be above stopped_mps, which is "
                f"{self.stopped_mps}"
            )
        self.slow_since_ns: int | None = None
        self.recording = any(entry.name == NAME for entry in ctx.scratch.entries())

    def on_event(self, ctx: Context, event: Sample) -> None:
        now, speed = ctx.now_ns(), abs(event.number(self.speed))
        if self.recording:
            if speed > self.going_mps:
                ctx.stop(LABEL)
                ctx.scratch.remove(NAME)
                self.recording, self.slow_since_ns = False, None
            return
        # Not `speed > ...`, so that NaN does not count as standing.
        if not speed <= self.stopped_mps:
            self.slow_since_ns = None
            return
        if self.slow_since_ns is None:
            self.slow_since_ns = now
        if now - self.slow_since_ns >= self.after_ns:
            self.recording = True
            ctx.start(LABEL, stood_s=(now - self.slow_since_ns) / 1e9, speed_mps=speed)
            ctx.scratch.put(NAME, b"")

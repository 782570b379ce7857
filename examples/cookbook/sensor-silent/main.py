"""Sensor silent: no sample of an input for too long. Reports each silence once, and logs when the
sensor is back.

Missing samples cannot wake a lambda, so a period does, and the lambda checks the newest sample of
each input.
"""

from __future__ import annotations

from gleaner import Context


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.silent_ns = int(ctx.config["silent_s"] * 1e9)
        self.first_ns = int(ctx.config["first_s"] * 1e9)
        self.inputs = [ctx.input(name) for name in ctx.inputs()]
        self.began_ns: int | None = None
        # Time in ns of the last sample of each silent input, by the name of the input.
        self.silent: dict[str, int] = {}

    def on_tick(self, ctx: Context) -> None:
        now = ctx.now_ns()
        if self.began_ns is None:
            self.began_ns = now
        for topic in self.inputs:
            newest = topic.newest()
            # An input without a sample counts from the start, with a longer limit: on a vehicle,
            # discovery of the sensor takes time.
            last_ns, limit_ns = self.began_ns, self.first_ns
            if newest is not None:
                last_ns, limit_ns = newest.stamps.at_ns, self.silent_ns
            quiet_ns = now - last_ns
            if quiet_ns < limit_ns:
                since_ns = self.silent.pop(topic.name, None)
                if since_ns is not None:
                    ctx.log(
                        "info", f"{topic.ros_topic} is back after {(now - since_ns) / 1e9:.1f} s"
                    )
            elif topic.name not in self.silent:
                self.silent[topic.name] = last_ns
                ctx.event(
                    "sensor-silent",
                    quiet_ns / 1e9,
                    topic=topic.ros_topic,
                    received=topic.counts().received,
                )

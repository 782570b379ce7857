"""Sensor silent: no sample of an input for too long. It says so once, and once more in the log when the sensor is back.

Samples cannot wake a lambda that waits for their absence: the clock does, and looks at the newest of each.
"""

from __future__ import annotations

from gleaner import Context


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.silent_ns = int(ctx.config["silent_s"] * 1e9)
        self.first_ns = int(ctx.config["first_s"] * 1e9)
        self.inputs = [ctx.input(name) for name in ctx.inputs()]
        self.began_ns: int | None = None
        # The inputs that are silent, and since when.
        self.silent: dict[str, int] = {}

    def on_tick(self, ctx: Context) -> None:
        now = ctx.now_ns()
        if self.began_ns is None:
            self.began_ns = now
        for topic in self.inputs:
            newest = topic.newest()
            # Who never spoke is silent since the beginning, but may take longer: on a vehicle a sensor has to be found first.
            heard_ns, limit_ns = self.began_ns, self.first_ns
            if newest is not None:
                heard_ns, limit_ns = newest.stamps.at_ns, self.silent_ns
            quiet_ns = now - heard_ns
            if quiet_ns < limit_ns:
                since_ns = self.silent.pop(topic.name, None)
                if since_ns is not None:
                    ctx.log(
                        "info", f"{topic.ros_topic} is back after {(now - since_ns) / 1e9:.1f} s"
                    )
            elif topic.name not in self.silent:
                self.silent[topic.name] = heard_ns
                ctx.event(
                    "sensor-silent",
                    quiet_ns / 1e9,
                    topic=topic.ros_topic,
                    received=topic.counts().received,
                )

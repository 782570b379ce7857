"""A lambda that does what its configuration says a lambda must not do. The host has to stay whole."""

from __future__ import annotations

import sys

from gleaner import Context, Sample

WAKES = 0


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.behaviour: str = ctx.config["behaviour"]
        self.held: list[object] = []
        self.wakes = 0
        if self.behaviour == "error_in_init":
            raise RuntimeError("no, not today")
        elif self.behaviour == "event_in_init":
            ctx.event("too early", 1.0)
        elif self.behaviour == "bad_input":
            ctx.input("imo")
        elif self.behaviour == "bad_field":
            ctx.input("imu").field("linear_acceleration.w")
        elif self.behaviour == "struct_field":
            ctx.input("imu").field("linear_acceleration")

    def on_event(self, ctx: Context, event: Sample) -> None:
        self.wakes += 1
        behaviour = getattr(self, self.behaviour, None)
        if behaviour is None:
            raise ValueError(f"unknown behaviour `{self.behaviour}`")
        behaviour(ctx, event)

    def ok(self, ctx: Context, event: Sample) -> None:
        pass

    def error(self, ctx: Context, event: Sample) -> None:
        raise RuntimeError("I do not want to")

    def recurse(self, ctx: Context, event: Sample) -> None:
        self.recurse(ctx, event)

    def error_mostly(self, ctx: Context, event: Sample) -> None:
        """Keeps what it can and fails, seven times of eight; else it says how much memory its process ever had."""
        global WAKES
        WAKES += 1
        self.held += [event, *ctx.input("imu").last(8), ctx.input("imu").field("orientation.x")]
        if WAKES % 8:
            raise RuntimeError("I do not want to")
        with open("/proc/self/status") as status:
            line = next(line for line in status if line.startswith("VmHWM:"))
        ctx.event("was", 1.0, kib=int(line.split()[1]))

    def hoard(self, ctx: Context, event: Sample) -> None:
        """Has more and more memory of its own, which goes with this object."""
        self.held.append(b"x" * (1 << 20))

    def exit(self, ctx: Context, event: Sample) -> None:
        sys.exit(3)

    def not_a_frame(self, ctx: Context, event: Sample) -> None:
        event.as_frame()

    def huge_label(self, ctx: Context, event: Sample) -> None:
        ctx.event("x" * 1000, 1.0)

    def too_many_triggers(self, ctx: Context, event: Sample) -> None:
        for _ in range(17):
            ctx.event("x", 1.0)

    def event_then_error(self, ctx: Context, event: Sample) -> None:
        ctx.event("seen", 1.0)
        raise RuntimeError("after the event")

    def nan_score(self, ctx: Context, event: Sample) -> None:
        ctx.event("x", float("nan"))

    def hold(self, ctx: Context, event: Sample) -> None:
        self.held.append(event)

    def log_flood(self, ctx: Context, event: Sample) -> None:
        for i in range(1000):
            ctx.log("info", f"line {i}")

    def print(self, ctx: Context, event: Sample) -> None:
        print(f"hello from {self.wakes}")

    def print_in_pieces(self, ctx: Context, event: Sample) -> None:
        print("wake", self.wakes, "of", self.behaviour, file=sys.stderr)

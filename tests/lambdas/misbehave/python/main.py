"""Breaks the rules for lambdas as configured. The host must not be harmed."""

from __future__ import annotations

import fcntl
import os
import signal
import stat
import sys
import time

from gleaner import Context, Sample

WAKES = 0


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.behaviour: str = ctx.config["behaviour"]
        self.held: list[object] = []
        self.target: str = ctx.config["target"]
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
        """Keeps samples and fails, seven times of eight; else it reports its peak memory."""
        global WAKES
        WAKES += 1
        self.held += [event, *ctx.input("imu").last(8), ctx.input("imu").field("orientation.x")]
        if WAKES % 8:
            raise RuntimeError("I do not want to")
        with open("/proc/self/status") as status:
            line = next(line for line in status if line.startswith("VmHWM:"))
        ctx.event("was", 1.0, kib=int(line.split()[1]))

    def hoard(self, ctx: Context, event: Sample) -> None:
        """Allocates more and more memory, which is freed with this object."""
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

    def write(self, ctx: Context, event: Sample) -> None:
        """Tries to write: to open files, and to places in the folder `target`."""
        for fd in map(int, os.listdir("/proc/self/fd")):
            try:
                is_file = stat.S_ISREG(os.fstat(fd).st_mode)
                writes = fcntl.fcntl(fd, fcntl.F_GETFL) & os.O_ACCMODE != os.O_RDONLY
                name = os.readlink(f"/proc/self/fd/{fd}")
            except OSError:
                continue
            # The page that the shim reads is memory, not a file.
            if is_file and writes and "memfd:" not in name:
                ctx.event("escaped", 1.0, found=name)
        names = ("new", "decisions.jsonl", "log.jsonl", ".lock", "clips.jsonl", "drive.journal")
        for name in names:
            try:
                with open(os.path.join(self.target, name), "ab"):
                    ctx.event("escaped", 1.0, found=name)
            except OSError:
                pass

    def forge_end(self, ctx: Context, event: Sample) -> None:
        """Ends its process as a program of the host would, with such a message."""
        ctx.event("before", 1.0)
        if self.wakes == 3:
            os.write(2, b"error: the drive is damaged\n")
            os._exit(7)

    def kill_itself(self, ctx: Context, event: Sample) -> None:
        if self.wakes == 3:
            os.kill(os.getpid(), signal.SIGKILL)

    def forge_messages(self, ctx: Context, event: Sample) -> None:
        """Writes a message of the host into each open pipe."""
        message = b"x" * (5 << 20) if self.target == "long" else self.target.encode() + b"\n"
        if self.wakes == 3:
            for fd in range(3, 64):
                try:
                    if stat.S_ISFIFO(os.fstat(fd).st_mode):
                        os.write(fd, message)
                except OSError:
                    pass

    def sleep(self, ctx: Context, event: Sample) -> None:
        time.sleep(3600)

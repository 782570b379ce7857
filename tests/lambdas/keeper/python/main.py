"""Counts its wakes in scratch, fills it up, and faults in every third wake.

Its twin must report the same."""

from __future__ import annotations

from typing import Dict, Union

from gleaner import Context, ScratchError

# Bytes that are added in each wake until scratch is full.
BULK = 100_000


class Lambda:
    def __init__(self, ctx: Context) -> None:
        pass

    def on_tick(self, ctx: Context) -> None:
        try:
            before = int.from_bytes(ctx.scratch.get("wakes"), "little")
        except ScratchError as error:
            if error.kind != "no-such-entry":
                raise
            before = 0
        wakes = before + 1
        ctx.scratch.put("wakes", wakes.to_bytes(8, "little"))
        try:
            # Not only `bytes` are accepted.
            ctx.scratch.append("bulk", bytearray([wakes % 256]) * BULK)
        except ScratchError as error:
            ctx.scratch.remove("bulk")
            ctx.event("full", 1.0, why=str(error))
        report: Dict[str, Union[int, str]] = {"free": ctx.scratch.free()}
        report.update((entry.name, entry.bytes) for entry in ctx.scratch.entries())
        try:
            report["last"] = str(list(ctx.scratch.get("bulk", (wakes - 1) % 10 * BULK, 2)))
        except ScratchError:
            pass
        ctx.event("kept", wakes, **report)
        if wakes % 3 == 0:
            raise ValueError("every third time")

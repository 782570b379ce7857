"""Lines for people: interface ``log`` of the WIT package."""

from __future__ import annotations

from typing import Literal, Protocol

Level = Literal["error", "warn", "info", "debug", "trace"]
"""How much a line matters."""


class Log(Protocol):
    """Part of :class:`gleaner.Context`.

    What a lambda prints becomes lines, too, from its import on: ``info`` from ``sys.stdout``, ``warn`` from ``sys.stderr``.
    A line is written at its newline, or at the end of the call that began it. What other processes print, and code that is
    not Python, goes to standard error and is not kept."""

    def log(self, level: Level, message: str) -> None:
        """Writes one line. ``message`` is cut at 4,096 bytes, at a character boundary.

        At most 100 lines in one second of the lambda's time; what is over that is dropped and counted."""

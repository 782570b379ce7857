"""Log lines for people: interface ``log`` of the WIT package."""

from __future__ import annotations

from typing import Literal, Protocol

Level = Literal["error", "warn", "info", "debug", "trace"]
"""Severity of a log line. ``error``: the operator must act. ``warn``: data or time was lost.
``info``: a state changed. ``debug``: for the lambda's author. ``trace``: for the lambda's author,
in detail."""


class Log(Protocol):
    """The function of the interface ``log``; part of :class:`gleaner.Context`.

    Text that a lambda prints, from its import on, becomes log lines, too: ``info`` from
    ``sys.stdout``, ``warn`` from ``sys.stderr``. A line is written at its newline, or at the end of
    the call that began it. Output of other processes and of code that is not Python goes to
    standard error and is not kept."""

    def log(self, level: Level, message: str) -> None:
        """Writes one line. ``message`` is truncated to 4,096 bytes, at a character boundary.

        In one second of the lambda's time the host accepts ``log_lines`` lines and ``log_bytes``
        bytes, as set in ``[limits]``: by default 100 lines and 400 KiB. It drops and counts further
        lines."""

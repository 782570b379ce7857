"""Log lines for people: interface ``log`` of the WIT package."""

from __future__ import annotations

from typing import Literal, Protocol

Level = Literal["error", "warn", "info", "debug", "trace"]
"""Severity of a log line. ``error``: someone must act. ``warn``: data or time was lost. ``info``: a
state changed. ``debug``, ``trace``: for the lambda's author."""


class Log(Protocol):
    """Part of :class:`gleaner.Context`.

    Text that a lambda prints becomes log lines, too, from its import on: ``info`` from
    ``sys.stdout``, ``warn`` from ``sys.stderr``. A line is written at its newline, or at the end of
    the call that began it. Output of other processes and of code that is not Python goes to
    standard error and is not kept."""

    def log(self, level: Level, message: str) -> None:
        """Writes one line. ``message`` is truncated to 4,096 bytes, at a character boundary.

        In one second of the lambda's time the host accepts ``log_lines`` lines and ``log_bytes``
        bytes, as set in ``[limits]``: by default 100 lines and 400 KiB. It drops and counts further
        lines."""

"""Schedules wakes as in a replay by the host: for each new sample of one input, or periodically."""

from __future__ import annotations

from typing import Iterator, NamedTuple, Tuple, Union

from ._data import InputState
from ._ring import Cell

# Maximum number of ticks that run in one gap between two samples. Those of a longer gap (a clock
# that jumped, two drives far apart) are counted as missed.
CATCH_UP_TICKS = 100_000


class Tick(NamedTuple):
    """A periodic wake."""

    at_ns: int
    missed: int


class Event:
    """Wakes on new samples of one input. The replay waits until the lambda is free, so the backlogs
    `latest` and `each` are the same here."""

    def __init__(self, source: InputState) -> None:
        self._source = source
        self._next = 0
        self.missed_total = 0

    def begin(self, at_ns: int) -> None:
        """Sets the start time; it has no effect on events."""

    def events(self) -> Iterator[Tuple[InputState, Cell]]:
        """Returns the wakes caused by samples that have arrived."""
        ring = self._source.ring
        while self._next < ring.head:
            cell = ring.get(self._next)
            self._next += 1
            if cell is None:
                self._source.skipped += 1
            else:
                yield self._source, cell

    def ticks(self, now_ns: int) -> Iterator[Tick]:
        return iter(())


class Periodic:
    """Wakes on a period, counted from the start of the drive."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._due_ns = 0
        self._missed = 0
        self.missed_total = 0

    def begin(self, at_ns: int) -> None:
        """Sets the start time: the first tick is due a period later."""
        self._due_ns = at_ns + self._period_ns

    def events(self) -> Iterator[Tuple[InputState, Cell]]:
        return iter(())

    def ticks(self, now_ns: int) -> Iterator[Tick]:
        """Returns the ticks that are due before ``now_ns``: a tick follows all samples of the same
        instant."""
        while self._due_ns < now_ns:
            behind = (now_ns - self._due_ns - 1) // self._period_ns + 1
            if behind > CATCH_UP_TICKS:
                self._missed += behind
                self.missed_total += behind
                # Keeps the phase of the earlier ticks; the next one is due at `now_ns` or later.
                self._due_ns += behind * self._period_ns
                return
            tick = Tick(self._due_ns, self._missed)
            self._missed = 0
            self._due_ns += self._period_ns
            yield tick


Schedule = Union[Event, Periodic]

"""When a lambda runs: for each new sample of one input, or every so often. As in a replay of the host."""

from __future__ import annotations

from typing import Iterator, NamedTuple, Tuple, Union

from ._data import Source
from ._ring import Cell

# A longer gap between two samples (a clock that jumped, two drives far apart) is counted as missed.
CATCH_UP_TICKS = 100_000


class Tick(NamedTuple):
    """A periodic wake."""

    at_ns: int
    missed: int


class Event:
    """Wakes on new samples of one input. A drive waits for its lambda, so that `latest` and `each` are the same here."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._next = 0
        self.missed_total = 0

    def begin(self, at_ns: int) -> None:
        """Time begins."""

    def events(self) -> Iterator[Tuple[Source, Cell]]:
        """The wakes caused by samples that have arrived."""
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
        """Time begins: the first tick comes a period later."""
        self._due_ns = at_ns + self._period_ns

    def events(self) -> Iterator[Tuple[Source, Cell]]:
        return iter(())

    def ticks(self, now_ns: int) -> Iterator[Tick]:
        """The wakes that are due before ``now_ns``: a tick sees all samples of its own instant."""
        while self._due_ns < now_ns:
            behind = (now_ns - self._due_ns - 1) // self._period_ns + 1
            if behind > CATCH_UP_TICKS:
                self._missed += behind
                self.missed_total += behind
                # In step with the ticks before; the next one is due at `now_ns` or later.
                self._due_ns += behind * self._period_ns
                return
            tick = Tick(self._due_ns, self._missed)
            self._missed = 0
            self._due_ns += self._period_ns
            yield tick


Schedule = Union[Event, Periodic]

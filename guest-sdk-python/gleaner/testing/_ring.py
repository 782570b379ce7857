"""The ring: the newest samples of one input, in a fixed number of cells. Samples that the lambda
holds stay, and can displace others."""

from __future__ import annotations

import weakref
from typing import Any, Callable, Dict, List, NamedTuple, Optional

from ..data import Guid


class Arrival(NamedTuple):
    """One message of a drive, as it enters a ring."""

    at_ns: int
    publish_ns: int
    writer: Guid
    seq: int
    cdr: bytes
    """CDR with its encapsulation header of four bytes."""


class Lease:
    """Keeps a cell in use. Every object of a sample that a lambda gets refers to its lease."""

    __slots__ = ("cell", "__weakref__")

    def __init__(self, cell: Cell) -> None:
        self.cell = cell


class Cell:
    """One sample, with its decoded message once it has been read."""

    __slots__ = ("arrival", "position", "message", "_lease")

    def __init__(self, arrival: Arrival, position: int) -> None:
        self.arrival = arrival
        self.position = position
        self.message: Any = None
        self._lease: Optional[weakref.ref[Lease]] = None

    def lease(self) -> Lease:
        """Returns the existing lease, or a new one."""
        lease = self._lease() if self._lease is not None else None
        if lease is None:
            lease = Lease(self)
            self._lease = weakref.ref(lease)
        return lease

    @property
    def is_held(self) -> bool:
        return self._lease is not None and self._lease() is not None


class Ring:
    """A ring that shows ``depth`` samples, with ``depth + hold + 1`` cells of ``max_size``
    bytes."""

    def __init__(self, depth: int, hold: int, max_size: int) -> None:
        self.depth, self.cells, self.max_size = depth, depth + hold + 1, max_size
        self.head = 0
        self.overwritten = self.no_slot = self.too_big = 0
        self._shown: Dict[int, Cell] = {}
        self._left: List[Cell] = []

    def push(self, arrival: Arrival) -> None:
        """Adds a sample, or counts the reason for refusing it."""
        if len(arrival.cdr) - 4 > self.max_size:
            self.too_big += 1
            return
        self._left = [cell for cell in self._left if cell.is_held]
        if len(self._shown) + len(self._left) >= self.cells and not self._evict():
            self.no_slot += 1
            return
        self._shown[self.head] = Cell(arrival, self.head)
        leaving = self._shown.pop(self.head - self.depth, None)
        self.head += 1
        if leaving is not None:
            self.overwritten += 1
            if leaving.is_held:
                self._left.append(leaving)

    def _evict(self) -> bool:
        """Removes the oldest sample that the lambda does not hold. Returns whether there is one."""
        for position, cell in self._shown.items():
            if not cell.is_held:
                del self._shown[position]
                self.overwritten += 1
                return True
        return False

    def get(self, position: int) -> Optional[Cell]:
        return self._shown.get(position)

    def newest(self) -> Optional[Cell]:
        cells = self.newest_while(1, lambda _: True)
        return cells[0] if cells else None

    def newest_while(self, most: int, keep: Callable[[Arrival], bool]) -> List[Cell]:
        """Returns the newest samples back to the first one that ``keep`` rejects, at most ``most``;
        oldest first."""
        found: List[Cell] = []
        # The dict is in the order of positions, since they only increase.
        for cell in reversed(self._shown.values()):
            if len(found) >= most or not keep(cell.arrival):
                break
            found.append(cell)
        found.reverse()
        return found

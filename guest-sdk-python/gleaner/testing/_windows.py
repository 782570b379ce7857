"""Computes the windows that `[record]` keeps for the triggers of a lambda, by the rules of
`docs/clips.md`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Dict, Iterable, List, NamedTuple, Optional, Set, Tuple

from ..trigger import AttributeValue
from ._manifest import Record

STARTED_MAX = 64


@dataclass(frozen=True)
class Trigger:
    """A trigger, with the time of its wake."""

    at_s: float
    """Time of the wake in seconds since the start of the drive; for arrays, the time in the
    array."""
    at_ns: int
    """Time of the wake, in ns."""
    kind: str
    """``event``, ``start`` or ``stop``."""
    label: str
    score: Optional[float]
    """Strength of an event; None for ``start`` and ``stop``."""
    attributes: Dict[str, AttributeValue] = field(default_factory=dict)


class Window(NamedTuple):
    """A time range that clips would cover, both ends inclusive."""

    from_s: float
    """Start in seconds, as in :class:`Trigger`."""
    to_s: float
    """End in seconds."""
    from_ns: int
    """Start in ns."""
    to_ns: int
    """End in ns."""


def windows(
    record: Optional[Record], triggers: Iterable[Trigger], start_ns: int, end_ns: int
) -> List[Window]:
    """Returns the windows by time; overlapping ones are merged. A recording without a ``stop`` ends
    with the drive. A window is one clip here, also where the recorder would split it by length."""
    if record is None:
        return []
    stretches, started, started_from, opened_at = list[Tuple[int, int]](), set[str](), 0, None
    for trigger in triggers:
        at_ns = trigger.at_ns
        if trigger.kind == "stop":
            if trigger.label in started:
                started.discard(trigger.label)
                # Concurrent recordings are one window, which lasts until the last stop.
                if not started:
                    stretches.append((started_from, at_ns + record.postroll))
            continue
        if trigger.kind == "start" and not _may_start(started, trigger.label):
            continue
        if opened_at is not None and abs(at_ns - opened_at) < record.cooldown:
            continue
        opened_at = at_ns
        if trigger.kind == "event":
            stretches.append((at_ns - record.preroll, at_ns + record.postroll))
            continue
        if not started:
            started_from = at_ns - record.preroll
        started.add(trigger.label)
    if started:
        stretches.append((started_from, max(end_ns, started_from)))
    return [Window((a - start_ns) / 1e9, (b - start_ns) / 1e9, a, b) for a, b in _joined(stretches)]


def _may_start(started: Set[str], label: str) -> bool:
    return label not in started and len(started) < STARTED_MAX


def _joined(stretches: List[Tuple[int, int]]) -> List[Tuple[int, int]]:
    joined: List[Tuple[int, int]] = []
    for begin, end in sorted(stretches):
        if joined and begin <= joined[-1][1]:
            joined[-1] = joined[-1][0], max(joined[-1][1], end)
        else:
            joined.append((begin, end))
    return joined

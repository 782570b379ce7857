"""What a replay found: plain values, which hold nothing of the drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Dict, List, Optional, Tuple

import numpy as np
import numpy.typing as npt

from ..data import Counts
from ._session import Line
from ._windows import Moment, Window


@dataclass(frozen=True)
class Fault:
    """Why a wake ended early. ``message`` ends with what was raised."""

    kind: str
    """``exception`` or ``memory``; the host knows more kinds."""
    message: str
    used: Optional[int] = None
    allowed: Optional[int] = None


@dataclass(frozen=True)
class Decision:
    """The outcome of one wake: a line of ``decisions.jsonl``."""

    at_ns: int
    cause: str
    """``event`` or ``tick``."""
    input: Optional[str]
    topic: Optional[str]
    writer: Optional[str]
    seq: Optional[int]
    """Counted from 1 here. In the host it is the recorder's, where it counted."""
    triggers: List[Moment]
    fault: Optional[Fault]
    run_ns: int
    """Time in the lambda, at this desk."""

    def as_json(self) -> Dict[str, Any]:
        """The object that ``decisions.jsonl`` has."""
        triggers = [
            {"kind": t.kind, "label": t.label, "score": t.score, "attributes": t.attributes}
            for t in self.triggers
        ]
        fault = None if self.fault is None else dict(vars(self.fault))
        return {**vars(self), "triggers": triggers, "fault": fault, "fuel": None}


@dataclass(frozen=True)
class Run:
    """What a lambda decided, wake by wake."""

    decisions: List[Decision]
    """One for each wake."""
    log: List[Line]
    """What the lambda logged and printed, and what the host noted."""
    counts: Dict[str, Counts]
    """By input: what became of the samples."""
    start_ns: int
    """Stamp of the drive's first message; 0 of arrays."""
    end_ns: int
    """Stamp of its last message."""
    log_dropped: int
    """Lines beyond the limits of the log."""
    triggers_refused: int
    """Triggers beyond ``events_per_minute``."""
    backed_off: int
    """Wakes that did not happen, because the lambda had faulted again and again."""
    missed_ticks: int
    windows: List[Window]
    """What ``[record]`` keeps, by time: windows that overlap as one. Empty without it."""

    @property
    def triggers(self) -> List[Moment]:
        """All triggers, in their order."""
        return [trigger for decision in self.decisions for trigger in decision.triggers]

    @property
    def faults(self) -> List[Decision]:
        """The wakes that faulted."""
        return [decision for decision in self.decisions if decision.fault is not None]

    def series(self, label: str) -> Tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Times in s and scores of the events with this label: to be plotted or compared."""
        events = [
            trigger
            for trigger in self.triggers
            if trigger.kind == "event" and trigger.label == label
        ]
        scores = [np.nan if event.score is None else event.score for event in events]
        return np.array([event.at_s for event in events], dtype=np.float64), np.array(
            scores, dtype=np.float64
        )

    def __repr__(self) -> str:
        seconds = (self.end_ns - self.start_ns) / 1e9
        counted = (
            f"{len(self.decisions)} wakes, {len(self.triggers)} triggers, {len(self.faults)} faults"
        )
        return f"<Run of {seconds:.1f} s: {counted}>"

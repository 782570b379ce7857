"""The result of a replay: plain values, which keep no reference to the drive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Dict, List, Optional, Tuple

import numpy as np
import numpy.typing as npt

from ..data import Counts
from ._session import LogLine
from ._windows import Trigger, Window


@dataclass(frozen=True)
class Fault:
    """An error that ended a wake early. ``message`` ends with the exception."""

    kind: str
    """``exception`` or ``memory``; the host has more kinds."""
    message: str
    used: Optional[int] = None
    """Amount that the lambda used, in the unit of the exceeded limit; always None here."""
    allowed: Optional[int] = None
    """The exceeded limit: bytes for ``memory``, else None."""


@dataclass(frozen=True)
class Decision:
    """The outcome of one wake: a line of ``decisions.jsonl``."""

    at_ns: int
    """Time of the sample or tick that woke the lambda, in ns."""
    cause: str
    """``event`` or ``tick``."""
    input: Optional[str]
    """Name of the input whose sample woke the lambda; None for a tick."""
    topic: Optional[str]
    """Topic of the waking sample; None for a tick."""
    writer: Optional[str]
    """Writer of the waking sample, 32 hexadecimal digits; None for a tick."""
    seq: Optional[int]
    """Sequence number of the waking sample, counted from 1; None for a tick. In the host it is that
    of the recording, if it has one."""
    triggers: List[Trigger]
    """Triggers of the wake, in the order of the calls."""
    fault: Optional[Fault]
    """The fault that ended the wake early; None if it completed."""
    run_ns: int
    """Run time of the wake on this machine, in ns."""

    def as_json(self) -> Dict[str, Any]:
        """Returns the JSON object of this decision in ``decisions.jsonl``."""
        triggers = [
            {"kind": t.kind, "label": t.label, "score": t.score, "attributes": t.attributes}
            for t in self.triggers
        ]
        fault = None if self.fault is None else dict(vars(self.fault))
        return {**vars(self), "triggers": triggers, "fault": fault, "fuel": None}


@dataclass(frozen=True)
class Run:
    """The decisions of a lambda, with its log and counts."""

    decisions: List[Decision]
    """Decisions of all wakes, in the order of time."""
    log: List[LogLine]
    """Log lines and printed text of the lambda, and log lines of the host."""
    counts: Dict[str, Counts]
    """Numbers of received and lost samples, by input."""
    start_ns: int
    """Stamp of the drive's first message, in ns; 0 for arrays."""
    end_ns: int
    """Stamp of the drive's last message, in ns."""
    log_dropped: int
    """Number of log lines dropped by the limits per second."""
    triggers_refused: int
    """Number of triggers refused by ``events_per_minute``."""
    backed_off: int
    """Number of wakes skipped during back-off, after repeated faults."""
    missed_ticks: int
    """Number of ticks that were due and did not run."""
    windows: List[Window]
    """The windows that ``[record]`` keeps, by time; overlapping ones are merged. Empty without
    ``[record]``."""

    @property
    def triggers(self) -> List[Trigger]:
        """All triggers, in the order of the calls."""
        return [trigger for decision in self.decisions for trigger in decision.triggers]

    @property
    def faults(self) -> List[Decision]:
        """The wakes that faulted."""
        return [decision for decision in self.decisions if decision.fault is not None]

    def series(self, label: str) -> Tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Returns the times in s and the scores of the events with this label, as arrays."""
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

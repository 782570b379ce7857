"""Interrupts wakes that take too long: a signal raises an exception wherever the lambda is at that
moment, for example in a loop, in ``time.sleep``, or in numpy when its operation ends. A wake that
waited, for a core or a model, has time left; then the signal comes again.
`gleaner-shim` kills a process that continues in spite of it."""

from __future__ import annotations

# The module that `signal` wraps. The wrapper converts numbers to enumerations and back, which takes
# 55 us in a wake whose code is no longer in the caches.
import _signal  # type: ignore[import-not-found]
import sys
from types import FrameType
from typing import Optional

from .error import DeadlineExceeded

# Interval in seconds at which the exception is raised again if the lambda catches it and continues.
REPEAT_S = 0.01

_is_armed = False
_was_late = False


def arm(seconds: float) -> None:
    """Starts the deadline of a call into the lambda; 0 seconds is no deadline."""
    global _is_armed, _was_late
    _was_late = False
    if seconds:
        # At each call, since the lambda may have replaced the handler in an earlier wake. This is
        # the main thread, as Python requires.
        if _signal.getsignal(_signal.SIGALRM) is not _on_alarm:
            _signal.signal(_signal.SIGALRM, _on_alarm)
        _is_armed = True
        _signal.setitimer(_signal.ITIMER_REAL, seconds, REPEAT_S)


def disarm() -> bool:
    """Ends the deadline. Returns whether it was exceeded, also if the lambda caught the
    exception."""
    global _is_armed
    if _is_armed:
        # Before the timer stops: a pending signal must not raise any more.
        _is_armed = False
        _signal.setitimer(_signal.ITIMER_REAL, 0)
    return _was_late


def _on_alarm(_number: int, _frame: Optional[FrameType]) -> None:
    global _was_late
    if _is_armed:
        left = sys.modules["_gleaner"].time_left()
        if left:
            # Not less than a millisecond: a thread that waits for a core gets little of it.
            _signal.setitimer(_signal.ITIMER_REAL, max(left, 0.001), REPEAT_S)
            return
        _was_late = True
        raise DeadlineExceeded("the deadline in [limits] of lambda.toml has passed")

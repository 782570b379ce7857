"""Wakes that take too long are told so, by a signal that becomes an exception wherever the lambda is at that moment: in a loop,
in ``time.sleep``, in a long operation of numpy as soon as it is over. Who does not listen is killed by `gleaner-shim`."""

from __future__ import annotations

# What `signal` is made of. That turns numbers into enumerations and back, which costs 55 us in a wake whose code has left the caches.
import _signal  # type: ignore[import-not-found]
from types import FrameType
from typing import Optional

from .error import DeadlineExceeded

# Who caught the exception and went on hears it again after so many seconds.
AGAIN = 0.01

_is_armed = False
_was_late = False


def arm(seconds: float) -> None:
    """A call into the lambda begins, and should be over in so many seconds; 0 is for ever."""
    global _is_armed, _was_late
    _was_late = False
    if seconds:
        # Each time: a lambda may have taken it in a wake before. By the main thread, as Python wants it.
        if _signal.getsignal(_signal.SIGALRM) is not _late:
            _signal.signal(_signal.SIGALRM, _late)
        _is_armed = True
        _signal.setitimer(_signal.ITIMER_REAL, seconds, AGAIN)


def disarm() -> bool:
    """It is over. Whether it was too late, which the lambda may have kept to itself."""
    global _is_armed
    if _is_armed:
        # First this: a signal that is on its way must not become an exception any more.
        _is_armed = False
        _signal.setitimer(_signal.ITIMER_REAL, 0)
    return _was_late


def _late(_signal: int, _frame: Optional[FrameType]) -> None:
    global _was_late
    if _is_armed:
        _was_late = True
        raise DeadlineExceeded("the deadline in [limits] of lambda.toml is over")

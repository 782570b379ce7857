"""What a lambda causes: interface ``trigger`` of the WIT package.

A trigger counts from the moment of the call, even if the same wake faults later. It belongs to a wake: in ``init``, which is
``__init__`` of a class, and in threads between two wakes, a call is refused.
"""

from __future__ import annotations

from typing import Literal, Protocol, Union

from .error import Error

AttributeValue = Union[bool, int, float, str]
"""A named fact: an int of 64 bits, a finite float, a str of at most 1,024 bytes. numpy's numbers count as plain ones."""

TriggerErrorKind = Literal["invalid", "too-many"]


class TriggerError(Error):
    """The call is refused and had no effect; the message names the limit.

    ``invalid``: no wake; label empty or over 128 bytes; score or value not finite; key empty or over 64 bytes; text over
    1,024 bytes; more than 16 attributes. ``too-many``: more than 16 triggers in one wake.
    """

    kind: TriggerErrorKind


class Trigger(Protocol):
    """Part of :class:`gleaner.Context`. Keyword arguments become attributes, which travel into the clip."""

    def event(self, label: str, score: float, /, **attributes: AttributeValue) -> None:
        """Something worth keeping happened: opens the ``[record]`` window around the sample (or tick) of this wake.

        ``score`` says how strongly, in whatever unit the lambda documents.

        Raises TriggerError; TypeError for an attribute of another type."""

    def start(self, label: str, /, **attributes: AttributeValue) -> None:
        """Starts a recording that lasts until :meth:`stop` with the same label.

        Raises as :meth:`event`."""

    def stop(self, label: str, /) -> None:
        """Ends the recording that :meth:`start` began.

        Raises TriggerError."""

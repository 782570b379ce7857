"""Triggers: events, and the start and stop of recordings, that a lambda reports in a wake:
interface ``trigger`` of the WIT package.

A trigger is effective from the moment of the call, even if the same wake faults later. Outside of a
wake all triggers are refused: in ``init``, which is ``__init__`` of a class, and in threads between
two wakes.
"""

from __future__ import annotations

from typing import Literal, Protocol, Union

from .error import Error

AttributeValue = Union[bool, int, float, str]
"""Value of an attribute: a bool, an int of 64 bits, a finite float, or a str of at most 1,024
bytes. Numbers of numpy are accepted, too."""

TriggerErrorKind = Literal["invalid", "too-many"]


class TriggerError(Error):
    """A refused call, which had no effect. The message names the limit.

    ``invalid``: called outside of a wake; label empty or over 128 bytes; score or value not finite;
    key empty or over 64 bytes; text over 1,024 bytes; more than 16 attributes. ``too-many``: more
    than 16 triggers in one wake, or more in a minute than ``events_per_minute`` in ``[limits]``,
    which does not apply to ``stop``.
    """

    kind: TriggerErrorKind


class Trigger(Protocol):
    """The functions of the interface ``trigger``; part of :class:`gleaner.Context`. Keyword
    arguments become attributes: named values that are stored with the trigger in the clip."""

    def event(self, label: str, score: float, /, **attributes: AttributeValue) -> None:
        """Reports an event: opens the ``[record]`` window around the sample or tick of this wake.
        ``score`` is the strength of the event, in a unit that the lambda documents.

        Raises TriggerError; TypeError for an attribute of another type."""

    def start(self, label: str, /, **attributes: AttributeValue) -> None:
        """Starts a recording that lasts until :meth:`stop` is called with the same label. At most
        64 labels of a lambda can be recorded at once.

        Raises as :meth:`event`."""

    def stop(self, label: str, /) -> None:
        """Ends the recording that :meth:`start` began with the same label.

        Raises TriggerError."""

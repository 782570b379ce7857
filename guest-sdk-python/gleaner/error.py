"""Exceptions of the calls that the host refuses, and of a wake that exceeds its deadline."""

from __future__ import annotations


class DeadlineExceeded(BaseException):
    """Raised in a wake or an ``init`` that takes longer than ``[limits]`` allows, to end it.

    ``except Exception`` does not catch it. Code that catches it should clean up and raise it again:
    the wake is a fault in any case, and a process that stays in the wake is killed."""


class Error(ValueError):
    """A refused call. The text names the object, the cause and the way out.

    ``kind`` is the case of the WIT variant, such as ``"no-such-field"``. Programs check it instead
    of the text.
    """

    kind: str

    def __init__(self, message: str, kind: str) -> None:
        super().__init__(message, kind)
        self.kind = kind

    def __str__(self) -> str:
        return str(self.args[0])

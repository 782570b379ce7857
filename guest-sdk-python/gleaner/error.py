"""What the host answers to a call that it refuses."""

from __future__ import annotations


class DeadlineExceeded(BaseException):
    """The wake, or ``init``, has taken longer than ``[limits]`` allows, and is ended. No ``except Exception`` catches it; what
    does should clean up and let it go on: the wake is a fault anyway, and a process that stays in it is killed."""


class Error(ValueError):
    """A refused call. The text names the thing, the cause and the way out.

    ``kind`` is the case of the WIT variant, such as ``"no-such-field"``: for programs, where the text is for people.
    """

    kind: str

    def __init__(self, message: str, kind: str) -> None:
        super().__init__(message, kind)
        self.kind = kind

    def __str__(self) -> str:
        return str(self.args[0])

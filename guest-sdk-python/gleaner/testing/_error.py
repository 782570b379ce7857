"""The errors of :func:`gleaner.testing.replay`."""

from __future__ import annotations

import difflib
from typing import Iterable, Optional


class ReplayError(ValueError):
    """A lambda, manifest, config value or drive cannot be used. The text names the object, the
    cause and the way out."""

    def __init__(self, what: str, cause: str = "", help: str = "") -> None:
        lines = [what, f"  cause: {cause}" if cause else "", f"  help:  {help}" if help else ""]
        super().__init__("\n".join(line for line in lines if line))


class StartError(ReplayError):
    """The lambda's file or its ``init`` raised an exception, which is the ``__cause__``. Nothing
    was replayed."""

    def __init__(self, what: str, cause: str, kind: str) -> None:
        super().__init__(what, cause)
        self.kind = kind
        """Kind, as of a fault: ``exception`` or ``memory``."""


class TestFailed(BaseException):
    """Ends the replay, through the code of the lambda, with its ``__cause__``: an error of the
    test."""


def nearest(name: str, known: Iterable[str]) -> Optional[str]:
    """Returns the known name that is most similar to ``name``, if one is similar enough."""
    found = difflib.get_close_matches(name, list(known), n=1)
    return found[0] if found else None


def quoted(names: Iterable[str]) -> str:
    """Formats names as a list for a message."""
    listed = [f"`{name}`" for name in names]
    return ", ".join(listed) if listed else "none"

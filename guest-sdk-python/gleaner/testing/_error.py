"""What cannot be replayed, in words for whoever called :func:`gleaner.testing.replay`."""

from __future__ import annotations

import difflib
from typing import Iterable, Optional


class ReplayError(ValueError):
    """A lambda, manifest, config value or drive that cannot be used. The text names it, the cause and the way out."""

    def __init__(self, what: str, cause: str = "", help: str = "") -> None:
        lines = [what, f"  cause: {cause}" if cause else "", f"  help:  {help}" if help else ""]
        super().__init__("\n".join(line for line in lines if line))


class StartError(ReplayError):
    """The lambda's file, or its ``init``, raised: nothing was replayed. What it raised is the ``__cause__``."""

    def __init__(self, what: str, cause: str, kind: str) -> None:
        super().__init__(what, cause)
        self.kind = kind
        """As of a fault: ``exception`` or ``memory``."""


def nearest(name: str, known: Iterable[str]) -> Optional[str]:
    """The known name that ``name`` was probably meant to be."""
    found = difflib.get_close_matches(name, list(known), n=1)
    return found[0] if found else None


def quoted(names: Iterable[str]) -> str:
    """A list for a message."""
    listed = [f"`{name}`" for name in names]
    return ", ".join(listed) if listed else "none"

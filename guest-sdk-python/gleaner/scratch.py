"""What the host keeps for a lambda, by name: interface ``scratch`` of the WIT package."""

from __future__ import annotations

from typing import Literal, NamedTuple, Optional, Protocol, Union

from .error import Error

ScratchErrorKind = Literal["no-room", "no-such-entry", "wrong-name"]


class ScratchError(Error):
    """The call is refused and had no effect.

    ``no-room``: it would take more than ``scratch`` of ``[limits]``, or there are 1,024 entries already. ``no-such-entry``:
    nothing has that name. ``wrong-name``: a name has 1 to 128 bytes and no control characters.
    """

    kind: ScratchErrorKind


class Entry(NamedTuple):
    """Something that is kept."""

    name: str
    bytes: int
    """Its length."""


class Scratch(Protocol):
    """``ctx.scratch``: bytes that the host keeps by name, beyond a fault of the lambda.

    There is room only where ``scratch`` of ``[limits]`` grants some. It is empty when the lambda's process starts; a fault
    leaves it as it is, and ``init`` may look into it.
    """

    def put(self, name: str, bytes: Union[bytes, bytearray, memoryview]) -> None:
        """Keeps ``bytes`` under a name, in place of what was there. Any object with a buffer of bytes will do.

        Raises ScratchError: ``no-room``; ``wrong-name``."""

    def append(self, name: str, bytes: Union[bytes, bytearray, memoryview]) -> None:
        """Keeps ``bytes`` behind what is there already under that name, if anything is.

        Raises ScratchError: ``no-room``; ``wrong-name``."""

    def get(self, name: str, offset: int = 0, len: Optional[int] = None) -> bytes:
        """Bytes from ``offset``, ``len`` at most; clamped to what is there, and to ``call_bytes`` of ``[limits]``.

        Raises ScratchError: ``no-such-entry``."""

    def remove(self, name: str) -> None:
        """Forgets what is kept under a name.

        Raises ScratchError: ``no-such-entry``."""

    def entries(self) -> list[Entry]:
        """Everything that is kept, in the order of the names' bytes."""

    def free(self) -> int:
        """Bytes for which there is room. An entry takes its length, the length of its name and 64 bytes."""

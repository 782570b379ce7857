"""Named byte strings that the host keeps for a lambda: interface ``scratch`` of the WIT package."""

from __future__ import annotations

from typing import Literal, NamedTuple, Optional, Protocol, Union

from .error import Error

ScratchErrorKind = Literal["no-room", "no-such-entry", "wrong-name"]


class ScratchError(Error):
    """A refused call, which had no effect. The message names the entry, the cause and the way out.

    ``no-room``: the entries would exceed ``scratch`` in ``[limits]``, or there are 1,024 entries
    already. ``no-such-entry``: there is no entry of that name. ``wrong-name``: the name is not 1 to
    128 bytes long, or has control characters.
    """

    kind: ScratchErrorKind


class Entry(NamedTuple):
    """Name and length of one entry."""

    name: str
    bytes: int
    """Length of the value."""


class Scratch(Protocol):
    """``ctx.scratch``: data that is too large for the lambda's own memory, or that must survive a
    fault.

    Its size is ``scratch`` in ``[limits]``, 0 by default. It is empty when the lambda's process
    starts. A fault of the lambda does not change it, and ``init`` may read it.
    """

    def put(self, name: str, bytes: Union[bytes, bytearray, memoryview]) -> None:
        """Stores ``bytes`` under a name; replaces an existing entry. ``bytes`` may be any object
        with a buffer of bytes.

        Raises ScratchError: ``no-room``; ``wrong-name``."""

    def append(self, name: str, bytes: Union[bytes, bytearray, memoryview]) -> None:
        """Appends ``bytes`` to the entry of that name; creates a missing one.

        Raises ScratchError: ``no-room``; ``wrong-name``."""

    def get(self, name: str, offset: int = 0, len: Optional[int] = None) -> bytes:
        """Bytes of an entry: at most ``len``, from ``offset``. Clamped to the entry and to
        ``call_bytes`` in ``[limits]``, 1 MiB by default.

        Raises ScratchError: ``no-such-entry``."""

    def remove(self, name: str) -> None:
        """Deletes an entry.

        Raises ScratchError: ``no-such-entry``."""

    def entries(self) -> list[Entry]:
        """All entries, sorted by the bytes of their names."""

    def free(self) -> int:
        """Free space in bytes. An entry takes the length of its value and of its name, and 64
        bytes."""

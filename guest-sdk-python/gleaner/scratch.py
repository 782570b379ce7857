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
    """Length of the value in bytes."""


class Scratch(Protocol):
    """``ctx.scratch``: named byte strings that the host keeps for the lambda. Use them for data
    that is too large for the lambda's own memory, or that must survive a fault.

    The size of this scratch memory is ``scratch`` in ``[limits]``, 0 bytes by default. It is empty
    when the lambda's process starts. A fault of the lambda does not change it, and ``init`` may
    read and write it.
    """

    def put(self, name: str, bytes: Union[bytes, bytearray, memoryview]) -> None:
        """Stores ``bytes`` under a name; replaces an existing entry. ``bytes`` may be any object
        with a buffer of bytes.

        Raises ScratchError: ``no-room``; ``wrong-name``."""

    def append(self, name: str, bytes: Union[bytes, bytearray, memoryview]) -> None:
        """Appends ``bytes`` to the entry of that name; creates a missing one.

        Raises ScratchError: ``no-room``; ``wrong-name``."""

    def get(self, name: str, offset: int = 0, len: Optional[int] = None) -> bytes:
        """Returns bytes of an entry: at most ``len``, from ``offset``, clamped to the entry and to
        ``call_bytes`` in ``[limits]``, 1 MiB by default.

        Raises ScratchError: ``no-such-entry``."""

    def remove(self, name: str) -> None:
        """Deletes an entry.

        Raises ScratchError: ``no-such-entry``."""

    def entries(self) -> list[Entry]:
        """Returns all entries, sorted by the bytes of their names."""

    def free(self) -> int:
        """Returns the free space in bytes. An entry takes the lengths of its value and its name,
        plus 64 bytes."""

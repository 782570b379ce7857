"""The session of a replay: triggers, log lines and scratch memory of a lambda, with their limits
and counters."""

from __future__ import annotations

import math
import operator
from dataclasses import dataclass
from typing import Any, Dict, List, Mapping, Optional, Tuple

from ..log import Level
from ..scratch import Entry, ScratchError
from ..trigger import AttributeValue, TriggerError

PER_WAKE, ATTRIBUTES = 16, 16
LABEL_BYTES, KEY_BYTES, TEXT_BYTES, LINE_BYTES, NAME_BYTES = 128, 64, 1024, 4096, 128
ENTRIES, ENTRY_BYTES = 1024, 64
MINUTE_NS, SECOND_NS = 60_000_000_000, 1_000_000_000
LEVELS = ("error", "warn", "info", "debug", "trace")


@dataclass(frozen=True)
class LogLine:
    """One log line: a line of ``log.jsonl``."""

    at_ns: int
    """Time of the wake that wrote it, in ns; 0 before the first wake."""
    level: Level
    message: str


@dataclass(frozen=True)
class PendingTrigger:
    """A trigger, without the time of its wake."""

    kind: str
    label: str
    score: Optional[float]
    attributes: Dict[str, AttributeValue]


class Session:
    """State of the whole replay. It survives faults: a fresh instance of the lambda finds it
    unchanged."""

    def __init__(self, limits: Mapping[str, int]) -> None:
        self.limits = limits
        self.now_ns = 0
        self.lines: List[LogLine] = []
        self.log_dropped = self.triggers_refused = self.backed_off = 0
        self._triggers: Optional[List[PendingTrigger]] = None
        self._minute, self._caused = 0, 0
        self._second, self._second_lines, self._second_bytes = 0, 0, 0
        self._notes: Tuple[int, List[str]] = (0, [])

    def begin(self, now_ns: int) -> None:
        """Begins a wake."""
        self.now_ns, self._triggers = now_ns, []

    def end(self) -> List[PendingTrigger]:
        """Ends a wake and returns its triggers."""
        caused, self._triggers = self._triggers or [], None
        return caused

    def suspend(self) -> Optional[List[PendingTrigger]]:
        """Refuses triggers while ``init`` runs, which may be in the middle of a wake but is not a
        part of it. Returns the argument of `resume`."""
        caused, self._triggers = self._triggers, None
        return caused

    def resume(self, caused: Optional[List[PendingTrigger]]) -> None:
        self._triggers = caused

    def cause(
        self, kind: str, label: Any, score: Optional[float], attributes: Mapping[str, Any]
    ) -> None:
        _must_be_text(label)
        plain = {key: _attribute(label, key, value) for key, value in attributes.items()}
        if self._triggers is None:
            raise _invalid(
                "triggers belong to a wake: they are refused in init and between two wakes"
            )
        # A lambda over the limit per minute may still end a recording.
        if kind != "stop":
            self._check_rate()
        if len(self._triggers) >= PER_WAKE:
            raise TriggerError(
                f"this wake has caused {PER_WAKE} triggers already; further ones are refused",
                "too-many",
            )
        _check(label, score, plain)
        self._triggers.append(PendingTrigger(kind, label, score, plain))
        self._caused += 1

    def _check_rate(self) -> None:
        minute, allowed = self.now_ns // MINUTE_NS, self.limits["events_per_minute"]
        if self._minute != minute:
            self._minute, self._caused = minute, 0
        if self._caused >= allowed:
            self.triggers_refused += 1
            why = (
                f"the lambda has caused {allowed} triggers in this minute already, "
                "`events_per_minute` in [limits]"
            )
            raise TriggerError(f"{why}; further ones are refused", "too-many")

    def log(self, level: Any, message: Any) -> None:
        """Writes a line within the limits of a second of the lambda's time; drops and counts
        further lines."""
        _must_be_text(level)
        _must_be_text(message)
        if level not in LEVELS:
            raise ValueError(
                "the level of a log line must be `error`, `warn`, `info`, `debug` or `trace`"
            )
        message = cut(message, LINE_BYTES)
        size, second = len(message.encode()), self.now_ns // SECOND_NS
        if self._second != second:
            self._second, self._second_lines, self._second_bytes = second, 0, 0
        if (
            self._second_lines >= self.limits["log_lines"]
            or self._second_bytes + size > self.limits["log_bytes"]
        ):
            self.log_dropped += 1
            return
        self._second_lines, self._second_bytes = self._second_lines + 1, self._second_bytes + size
        self.lines.append(LogLine(self.now_ns, level, message))

    def note(self, text: str) -> None:
        """Writes a log line of the host, each text at most once a second."""
        second = self.now_ns // SECOND_NS
        if self._notes[0] != second:
            self._notes = (second, [])
        if text not in self._notes[1]:
            self._notes[1].append(text)
            self.lines.append(LogLine(self.now_ns, "warn", text))


class Scratch:
    """``ctx.scratch``, within ``scratch`` in ``[limits]``."""

    def __init__(self, limits: Mapping[str, int]) -> None:
        self._granted, self._most_given = limits["scratch"], limits["call_bytes"]
        self._used = 0
        self._entries: Dict[str, bytes] = {}

    def put(self, name: str, bytes: Any) -> None:
        self._keep(name, memoryview(bytes).tobytes(), in_place=True)

    def append(self, name: str, bytes: Any) -> None:
        self._keep(name, memoryview(bytes).tobytes(), in_place=False)

    def _keep(self, name: str, given: bytes, in_place: bool) -> None:
        _must_be_text(name)
        if not 1 <= len(name.encode()) <= NAME_BYTES or any(map(_is_control, name)):
            raise ScratchError(
                f"`{_visible(name[:NAME_BYTES])}` is not a name for scratch; give 1 to 128 bytes "
                "without control characters",
                "wrong-name",
            )
        there = self._entries.get(name)
        if there is None and len(self._entries) >= ENTRIES:
            raise ScratchError(
                f"cannot add `{name}`: scratch has {ENTRIES} entries, the maximum; remove some, or "
                "append to one of them",
                "no-room",
            )
        given_back = len(there) if there is not None and in_place else 0
        needed = len(given) + (ENTRY_BYTES + len(name.encode()) if there is None else 0)
        if needed > self.free() + given_back:
            why = (
                f"`{name}` needs {needed - given_back} bytes of scratch and {self.free()} are free"
            )
            raise ScratchError(f"{why}; remove entries, or raise `scratch` in [limits]", "no-room")
        self._entries[name] = given if in_place or there is None else there + given
        self._used += needed - given_back

    def get(self, name: str, offset: int = 0, len: Optional[int] = None) -> bytes:
        return piece(self._there(name), offset, None if len is None else u64(len), self._most_given)

    def remove(self, name: str) -> None:
        kept = self._there(name)
        del self._entries[name]
        self._used -= ENTRY_BYTES + len(name.encode()) + len(kept)

    def _there(self, name: str) -> bytes:
        _must_be_text(name)
        if name not in self._entries:
            raise ScratchError(
                f"scratch has no `{_visible(name[:NAME_BYTES])}`; it is empty when the lambda's "
                "process starts",
                "no-such-entry",
            )
        return self._entries[name]

    def entries(self) -> List[Entry]:
        kept = sorted(self._entries.items(), key=lambda item: item[0].encode())
        return [Entry(name, len(bytes)) for name, bytes in kept]

    def free(self) -> int:
        return self._granted - self._used


def piece(data: bytes, offset: int, length: Optional[int], most: int) -> bytes:
    """Returns ``length`` bytes from ``offset``, clamped to ``data`` and to ``most``."""
    start = min(u64(offset), len(data))
    wanted = most if length is None else min(length, most)
    return data[start : start + wanted]


def u64(number: Any) -> int:
    """Converts to an unsigned integer of 64 bits, with the errors of the host."""
    whole = operator.index(number)
    if whole < 0:
        raise OverflowError("can't convert negative int to unsigned")
    if whole >= 2**64:
        raise OverflowError("int too big to convert")
    return whole


def u32(number: Any) -> int:
    whole = i64(number)
    if not 0 <= whole < 2**32:
        raise OverflowError("out of range integral type conversion attempted")
    return whole


def i64(number: Any) -> int:
    whole = operator.index(number)
    if not -(2**63) <= whole < 2**63:
        raise OverflowError("Python int too large to convert to C long")
    return whole


def cut(text: str, most: int) -> str:
    """Returns the longest prefix of ``text`` with at most ``most`` bytes."""
    return text.encode()[:most].decode(errors="ignore")


def _must_be_text(value: Any) -> None:
    if not isinstance(value, str):
        raise TypeError(f"'{type(value).__name__}' object cannot be converted to 'str'")


def _is_control(char: str) -> bool:
    return ord(char) < 0x20 or 0x7F <= ord(char) < 0xA0


def _visible(name: str) -> str:
    """Escapes control characters, as the host does."""
    short = {"\n": "\\n", "\r": "\\r", "\t": "\\t"}
    return "".join(
        short.get(char, f"\\u{{{ord(char):x}}}") if _is_control(char) else char for char in name
    )


def _invalid(message: str) -> TriggerError:
    return TriggerError(message, "invalid")


def _check(label: str, score: Optional[float], attributes: Mapping[str, AttributeValue]) -> None:
    size = len(label.encode())
    if size == 0:
        raise _invalid("the label is empty")
    if size > LABEL_BYTES:
        raise _invalid(f"the label has {size} bytes; at most {LABEL_BYTES} are allowed")
    if score is not None and not math.isfinite(score):
        raise _invalid(
            f"the score of `{label}` is {'NaN' if math.isnan(score) else score}; it must be finite"
        )
    if len(attributes) > ATTRIBUTES:
        raise _invalid(
            f"`{label}` has {len(attributes)} attributes; at most {ATTRIBUTES} are allowed"
        )
    for key, value in attributes.items():
        why = ""
        if not 1 <= len(key.encode()) <= KEY_BYTES:
            why = "the key must have 1 to 64 bytes"
        elif isinstance(value, float) and not math.isfinite(value):
            why = "the value must be finite"
        elif isinstance(value, str) and len(value.encode()) > TEXT_BYTES:
            why = "the text must have at most 1,024 bytes"
        if why:
            raise _invalid(f"attribute `{cut(key, KEY_BYTES)}` of `{label}`: {why}")


def _item(value: Any) -> Any:
    """Converts a number of numpy to a plain one; None for an array of several elements."""
    try:
        return value.item()
    except Exception:
        return None


def _attribute(label: str, key: str, value: Any) -> AttributeValue:
    for plain in (value, _item(value)):
        if isinstance(plain, (bool, str)):
            return plain
        if isinstance(plain, float):
            return float(plain)
        if isinstance(plain, int):
            if not -(2**63) <= plain < 2**63:
                raise OverflowError("int too big to convert")
            return plain
    given = type(value).__name__
    raise TypeError(
        f"attribute `{key}` of `{label}` is of type `{given}`; give bool, int, float or str"
    )

"""Parses one table of a `lambda.toml`: refuses unknown keys, and reads each key with its type and
bounds."""

from __future__ import annotations

import re
from typing import Any, Callable, List, Mapping, Sequence, Tuple, TypeVar

from . import _units
from ._error import ReplayError, nearest, quoted

T = TypeVar("T")

ITEMS_MAX = 256


class Table:
    """A table; ``title`` is its name, such as ``[schedule]``, in ``file``."""

    def __init__(self, file: str, title: str, entries: Any, known: Sequence[str]) -> None:
        self.file, self.title = file, title
        if not isinstance(entries, Mapping):
            raise self.refusal("is not a table", "see docs/manifest.md for its keys")
        self.entries = entries
        for key in entries:
            if key not in known:
                near = nearest(str(key), known)
                help = f"did you mean `{near}`?" if near else f"it may have {quoted(known)}"
                raise self.refusal(f"has no key `{key}`", help)

    def refusal(self, cause: str, help: str) -> ReplayError:
        return ReplayError(f"cannot use manifest `{self.file}`", f"{self.title} {cause}", help)

    def __contains__(self, key: str) -> bool:
        return key in self.entries

    def need(self, key: str, example: str) -> Any:
        if key not in self.entries:
            raise self.refusal(f"has no `{key}`", f"add {example}")
        return self.entries[key]

    def text(self, key: str, example: str) -> str:
        value = self.need(key, example)
        if not isinstance(value, str):
            raise self.refusal(f"has a `{key}` that is not a text", f"give {example}")
        return value

    def form(self, key: str, example: str, rule: "re.Pattern[str]", longest: int) -> str:
        """Reads a text that matches ``rule``."""
        value = self.text(key, example)
        if rule.fullmatch(value) is None or len(value) > longest:
            raise self.refusal(f"has the {key} `{value[:64]}`", f"write it as in {example}")
        return value

    def choice(self, key: str, choices: Sequence[str], default: str) -> str:
        value = self.entries.get(key, default)
        if value not in choices:
            raise self.refusal(f"has the {key} `{value}`", f"choose {quoted(choices)}")
        return str(value)

    def integer(self, key: str, bounds: Tuple[int, int, int]) -> int:
        """Reads a whole number; ``bounds`` are its minimum, default and maximum."""
        value = self.entries.get(key, bounds[1])
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.refusal(
                f"has a `{key}` that is not a whole number", f"for example {key} = {bounds[1]}"
            )
        return self._within(key, value, bounds)

    def size(self, key: str, bounds: Tuple[int, int, int]) -> int:
        """Reads a size in bytes."""
        value = self.entries.get(key, bounds[1])
        if isinstance(value, int) and not isinstance(value, bool):
            return self._within(key, value, bounds)
        return self._within(key, self._unit(key, value, _units.size), bounds)

    def duration(self, key: str, bounds: Tuple[int, int, int]) -> int:
        """Reads a duration in nanoseconds."""
        if key not in self.entries:
            return bounds[1]
        return self._within(key, self._unit(key, self.entries[key], _units.duration), bounds)

    def _unit(self, key: str, value: Any, read: Callable[[str], int]) -> int:
        try:
            return read(str(value))
        except ValueError as error:
            raise self.refusal(f"has the {key} `{value}`", str(error)) from None

    def _within(self, key: str, value: int, bounds: Tuple[int, int, int]) -> int:
        if not bounds[0] <= value <= bounds[2]:
            raise self.refusal(
                f"has a `{key}` of {value}", f"its range is {bounds[0]} to {bounds[2]}"
            )
        return value

    def list(self, key: str) -> List[Any]:
        value = self.entries.get(key, [])
        if not isinstance(value, list) or len(value) > ITEMS_MAX:
            raise self.refusal(
                f"has a `{key}` that is not a list of at most {ITEMS_MAX} items",
                "see docs/manifest.md for its keys",
            )
        return value

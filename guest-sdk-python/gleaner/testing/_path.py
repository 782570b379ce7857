"""Compiles field paths, such as ``a.b[3].c``, against a message type. Errors name the valid
alternatives."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, List, Tuple, Union

import numpy as np

from ..data import DataError
from ._error import nearest
from ._types import INTEGERS, Member, Types

Step = Union[str, int]

SEGMENT = re.compile(r"([A-Za-z0-9_]+)((?:\[[0-9]+\])*)", re.ASCII)
BYTES = ("uint8", "byte", "char")


class NotANumber(Exception):
    """A field that is read as a number is not one."""


class MissingElement(Exception):
    """A message does not have the element that a path names."""


@dataclass(frozen=True)
class FieldPath:
    """One field of a message type, by the ``steps`` to it; ``leaf`` is the member at the end."""

    text: str
    steps: Tuple[Step, ...]
    leaf: Member
    is_array: bool

    @property
    def is_number(self) -> bool:
        return not self.is_array and self.leaf.element != "string"

    def find(self, message: Any) -> Any:
        """Returns the element in ``message``, as `rosbags` decodes it. Raises MissingElement."""
        found = message
        for step in self.steps:
            if isinstance(step, str):
                found = getattr(found, step)
            elif step < len(found):
                found = found[step]
            else:
                raise MissingElement(
                    f"it has {len(found)} elements where `{self.text}` wants element {step}"
                )
        return found

    def value(self, message: Any) -> Any:
        """Returns the value that a lambda gets. Raises MissingElement."""
        found, element = self.find(message), self.leaf.element
        if not self.is_array:
            return _scalar(element, found)
        if element == "string":
            return list(found)
        if element in BYTES:
            return np.asarray(found).view(np.uint8).tobytes()
        return np.asarray(found).astype(np.float64)

    def number(self, message: Any) -> float:
        """Returns the value as a float. Raises NotANumber and MissingElement."""
        if not self.is_number:
            raise NotANumber
        return float(_scalar(self.leaf.element, self.find(message)))


def _scalar(element: str, found: Any) -> Any:
    if element == "bool":
        return bool(found)
    if element in BYTES:
        return int(found) & 0xFF
    if element in INTEGERS:
        return int(found)
    return str(found) if element == "string" else float(found)


def compile_path(types: Types, type_name: str, text: str) -> FieldPath:
    """Compiles a path. Raises DataError (``no-such-field``)."""
    at, steps, rest = type_name, list[Step](), _segments(text)
    while True:
        name = rest.pop(0)
        member = _member(types, at, str(name))
        steps.append(str(name))
        if member.length is not None:
            if not rest and member.is_primitive and not member.is_wide:
                return FieldPath(text, tuple(steps), member, is_array=True)
            if not rest or isinstance(rest[0], str):
                raise _refused(
                    f"field `{name}` of `{text}` is an array; write `{name}[0]` and so on"
                )
            index = int(rest.pop(0))
            if index >= member.length >= 0:
                raise _refused(
                    f"field `{name}` of `{text}` has {member.length} elements, counted from 0"
                )
            steps.append(index)
        if member.is_wide:
            raise _refused(
                f"`{text}` is or lies behind the wstring `{name}`, whose size on the wire is not "
                "defined"
            )
        if member.is_primitive:
            if rest:
                raise _refused(f"field `{name}` of `{text}` is a single value with nothing inside")
            return FieldPath(text, tuple(steps), member, is_array=False)
        at = member.element
        if not rest or isinstance(rest[0], int):
            fields = ", ".join(inner.name for inner in types.members(at))
            raise _refused(f"`{text}` is a whole `{at}`; name one of its fields: {fields}")


def _segments(text: str) -> List[Step]:
    segments: List[Step] = []
    rest = text
    while True:
        found = SEGMENT.match(rest)
        if found is None:
            raise _refused(f"path `{text}` is malformed at `{rest}`; write it like `a.b[3].c`")
        segments.append(found.group(1))
        segments += [int(index) for index in re.findall("[0-9]+", found.group(2))]
        rest = rest[found.end() :]
        if not rest:
            return segments
        if rest[0] != ".":
            raise _refused(f"path `{text}` is malformed at `{rest}`; write it like `a.b[3].c`")
        rest = rest[1:]


def _member(types: Types, type_name: str, name: str) -> Member:
    members = types.members(type_name)
    for member in members:
        if member.name == name:
            return member
    near = nearest(name, [member.name for member in members])
    hint = f"; did you mean `{near}`?" if near else ""
    fields = ", ".join(member.name for member in members)
    raise _refused(f"type `{type_name}` has no field `{name}`{hint}; it has: {fields}")


def _refused(message: str) -> DataError:
    return DataError(message, "no-such-field")

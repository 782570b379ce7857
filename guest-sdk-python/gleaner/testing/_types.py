"""Message types: their fields, and decoding and encoding of CDR. `rosbags` parses the
definitions."""

from __future__ import annotations

import functools
import textwrap
from pathlib import Path
from typing import Any, Dict, Iterator, List, Mapping, NamedTuple, Optional, Tuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ._error import ReplayError

HEADER, TIME = "std_msgs/msg/Header", "builtin_interfaces/msg/Time"
PASS_TYPES = (
    'pass types={"%s": "the text of its .msg"}, or put its .msg file into msg/ beside the lambda'
)
INTEGERS = ("int8", "int16", "int32", "int64", "uint16", "uint32", "uint64")


class Member(NamedTuple):
    """One field of a message type."""

    name: str
    element: str
    """A primitive, or the name of another type."""
    length: Optional[int]
    """None for one value, -1 for a sequence of any length, else the length of an array."""

    @property
    def is_primitive(self) -> bool:
        return "/" not in self.element

    @property
    def is_wide(self) -> bool:
        """Returns whether this is a `wstring`, whose encoding in CDR is not defined."""
        return self.element == "wstring" or self.element.endswith("/wstring")


class Types:
    """The message type of one topic, with all that it refers to."""

    def __init__(self, store: Typestore) -> None:
        self._store = store
        self._members: Dict[str, List[Member]] = {}

    def members(self, type_name: str) -> List[Member]:
        """Returns the fields of a type, in the order of the message."""
        known = self._members.get(type_name)
        if known is None:
            known = [
                _member(name, description)
                for name, description in self._store.fielddefs[type_name][1]
            ]
            self._members[type_name] = known
        return known

    def is_stamped(self, type_name: str) -> bool:
        """Returns whether messages begin with a stamp: a header, or a time named `stamp`."""
        first = self.members(type_name)[0]
        return first.length is None and (
            first.element == HEADER or (first.name, first.element) == ("stamp", TIME)
        )

    def layout(self, type_name: str, path: str = "") -> Iterator[str]:
        """Yields the primitive fields in the order of the message, such as ``float64 linear.x``."""
        for member in self.members(type_name):
            count = {None: "", -1: "[]"}.get(member.length, f"[{member.length}]")
            if member.is_primitive or member.is_wide:
                yield f"{member.element}{count} {path}{member.name}"
            else:
                yield from self.layout(member.element, f"{path}{member.name}{count}.")

    def digest(self, type_name: str) -> Optional[str]:
        """Returns the hash of a type by REP 2011; None if it has a type that `rosbags` cannot
        hash."""
        try:
            return self._store.hash_rihs01(type_name)
        except KeyError:
            return None

    def decode(self, cdr: bytes, type_name: str) -> Any:
        """Decodes ``cdr``, which begins with the encapsulation header. Raises the exceptions of
        `rosbags` for an invalid message."""
        return self._store.deserialize_cdr(cdr, type_name)

    def encode(self, message: Any, type_name: str) -> bytes:
        """Encodes a message as CDR with its encapsulation header."""
        return bytes(self._store.serialize_cdr(message, type_name))

    def blank(self, type_name: str) -> Any:
        """Returns a message with all numbers 0, and all texts and sequences empty."""
        members = self.members(type_name)
        return self._store.types[type_name](
            **{member.name: self._blank(member) for member in members}
        )

    def _blank(self, member: Member) -> Any:
        if member.length is None:
            return self._one(member.element)
        if member.is_primitive and member.element not in ("string", "wstring"):
            return np.zeros(max(member.length, 0), dtype(member.element))
        return [self._one(member.element) for _ in range(member.length)]

    def _one(self, element: str) -> Any:
        if "/" in element:
            return self.blank(element)
        return {"string": "", "wstring": "", "bool": False, "float32": 0.0, "float64": 0.0}.get(
            element, 0
        )


def dtype(element: str) -> Any:
    """Returns the numpy type of the elements of an array; `byte` and `char` as in `rosbags`."""
    return np.dtype({"bool": np.bool_, "byte": np.int8, "char": np.uint8}.get(element, element))


class Definitions:
    """Message definitions of a lambda: texts by type name, and the `.msg` files of its folder
    `msg`.

    Raises ReplayError for an invalid text. A file is read when its type is needed."""

    def __init__(self, texts: Mapping[str, str], folder: Optional[Path]) -> None:
        self._folder = folder
        self._given: Dict[str, Any] = {}
        for type_name, text in texts.items():
            self._given.update(parsed(type_name, text, "pass the text of its .msg"))

    def find(self, type_name: str) -> Any:
        """Returns the definition of a type, or None. Texts take precedence over files in folders of
        packages, these over the types of ROS 2, and those over files without a folder.

        Raises ReplayError."""
        package, _, leaf = type_name.partition("/msg/")
        if type_name in self._given:
            return self._given[type_name]
        for path in (f"{package}/msg/{leaf}.msg", f"{package}/{leaf}.msg"):
            found = self._read(type_name, path)
            if found is not None:
                return found
        # Last, since the path has no package: a `Header.msg` of the lambda must not replace that of
        # every package.
        return _humble().fielddefs.get(type_name) or self._read(type_name, f"{leaf}.msg")

    def _read(self, type_name: str, inside: str) -> Any:
        if self._folder is None or not (self._folder / inside).is_file():
            return None
        path = self._folder / inside
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ReplayError(f"cannot read `{path}`", str(error)) from None
        return parsed(type_name, text, f"correct `{path}`").get(type_name)


def parsed(type_name: str, text: str, help: str, what: str = "") -> Dict[str, Any]:
    """Parses the text of a `.msg`, with those of other types that follow it. An invalid one raises
    ReplayError, with ``help`` and ``what``."""
    try:
        return dict(get_types_from_msg(text, type_name))
    except Exception as error:
        why = textwrap.shorten(str(error), 200, placeholder=" ...")
        what = what or f"cannot use the definition of `{type_name}`"
        raise ReplayError(what, f"the definition is not that of a message: {why}", help) from None


def gathered(own: Mapping[str, Any], type_name: str, more: Definitions, what: str) -> Types:
    """Collects a type with all that it refers to: from the topic's ``own``, or else from ``more``.

    Raises ReplayError, which begins with ``what``, for a type in neither."""
    known: Dict[str, Any] = {}
    root, rest = type_name, [type_name]
    while rest:
        type_name = rest.pop()
        if type_name in known:
            continue
        found = own.get(type_name) or more.find(type_name)
        if found is None:
            refers = f", to which `{root}` refers" if root != type_name else ""
            cause = f"there is no definition of `{type_name}`{refers}"
            raise ReplayError(what, cause, PASS_TYPES % type_name)
        known[type_name] = found
        elements = [_member(name, description).element for name, description in found[1]]
        rest += [it for it in elements if "/" in it and not it.endswith("/wstring")]
    store = _humble()
    if any(store.fielddefs.get(type_name) is not found for type_name, found in known.items()):
        store = get_typestore(Stores.EMPTY)
        store.register(known)
    return Types(store)


@functools.lru_cache(maxsize=None)
def _humble() -> Typestore:
    """Returns the types of ROS 2 Humble; cached, since the store compiles its codecs."""
    return get_typestore(Stores.ROS2_HUMBLE)


def _member(name: str, description: Any) -> Member:
    kind, inner = description
    if kind == Nodetype.BASE:
        return Member(name, inner[0], None)
    if kind == Nodetype.NAME:
        return Member(name, inner, None)
    element = _member(name, inner[0]).element
    return Member(name, element, inner[1] if kind == Nodetype.ARRAY else -1)


def stamp_of(message: Any, type_name: str, types: Types) -> Tuple[int, int]:
    """Seconds and nanoseconds of the stamp at the start of a message."""
    first = getattr(message, types.members(type_name)[0].name)
    stamp = getattr(first, "stamp", first)
    return int(stamp.sec), int(stamp.nanosec)

"""Drives built from arrays: for each topic an array of times, and one for each field that matters.
All other fields are 0 or empty."""

from __future__ import annotations

import heapq
from typing import Any, Dict, Iterable, Iterator, List, Mapping, Tuple

import numpy as np

from ..data import DataError, Guid
from ._drive import Delivery
from ._error import ReplayError, quoted
from ._path import FieldPath, compile_path
from ._ring import Arrival
from ._types import HEADER, Definitions, Types, dtype, gathered

IMAGE = "sensor_msgs/msg/Image"

Table = Mapping[str, Any]


class Arrays:
    """A drive from ``tables``, by topic. A table has the times, as ``t`` in seconds or ``t_ns`` in
    ns, and an array for each field, by its path."""

    def __init__(
        self, tables: Mapping[str, Table], more: Definitions, type_names: Mapping[str, str]
    ) -> None:
        """Creates a drive. ``type_names`` is the type of each topic, from the lambda's inputs.
        Raises ReplayError."""
        self._types = {
            topic: gathered({}, type_name, more, _unusable(topic))
            for topic, type_name in type_names.items()
        }
        self.topics = dict(type_names)
        for topic in tables:
            if topic not in type_names:
                raise _error(
                    topic,
                    "no input of the lambda has this topic",
                    f"its topics are {quoted(type_names)}",
                )
        self._tables = {
            topic: _Messages(topic, type_names[topic], table, self._types[topic])
            for topic, table in tables.items()
        }
        stamps = [
            at_ns
            for messages in self._tables.values()
            for at_ns in messages.at_ns[:1] + messages.at_ns[-1:]
        ]
        # Times of arrays are absolute: the drive starts at 0.
        self.start_ns, self.end_ns = 0, max(stamps, default=0)
        self.begins_ns = min(stamps, default=0)

    @property
    def is_partial(self) -> bool:
        return True

    def types(self, topic: str, more: Definitions) -> Types:
        """Returns the types of a topic, which were collected at the creation."""
        return self._types[topic]

    def type_of(self, topic: str) -> str:
        return self.topics[topic]

    def deliveries(self, topics: Iterable[str]) -> Iterator[Delivery]:
        """Returns the messages by stamp; those with equal stamps in the order of the topics in
        ``tables``."""
        chosen = set(topics)
        numbered = [
            (n, table) for n, (topic, table) in enumerate(self._tables.items()) if topic in chosen
        ]
        merged = heapq.merge(
            *(table.deliveries(n) for n, table in numbered),
            key=lambda it: (it[1].arrival.at_ns, it[0]),
        )
        return (delivery for _, delivery in merged)


class _Messages:
    """The messages of one topic."""

    def __init__(self, topic: str, type_name: str, table: Table, types: Types) -> None:
        self._topic, self._type_name, self._types = topic, type_name, types
        self.at_ns = _times(topic, table)
        # Reused for all messages: each one overwrites the same fields.
        self._message = types.blank(type_name)
        self._columns: List[Tuple[FieldPath, Any]] = []
        fields = {path: values for path, values in table.items() if path not in ("t", "t_ns")}
        for path, values in self._image_fields(fields).items():
            try:
                self._columns.append((compile_path(types, type_name, path), values))
            except DataError as error:
                raise _error(topic, str(error), "") from None
            if len(values) != len(self.at_ns):
                raise _error(
                    topic,
                    f"`{path}` has {len(values)} values for {len(self.at_ns)} times",
                    "",
                )

    def _image_fields(self, fields: Dict[str, Any]) -> Dict[str, Any]:
        """Replaces ``image`` by the fields of raw images."""
        if self._type_name != IMAGE or "image" not in fields:
            return fields
        pictures = [np.asarray(picture) for picture in fields.pop("image")]
        for picture in pictures:
            if picture.dtype != np.uint8 or (picture.ndim, picture.shape[2:]) not in (
                (2, ()),
                (3, (3,)),
            ):
                what = f"an `image` of {picture.dtype} and shape {picture.shape}"
                raise _error(
                    self._topic,
                    what,
                    "use uint8 of shape (height, width), or (height, width, 3) in RGB",
                )
        return {
            "height": [picture.shape[0] for picture in pictures],
            "width": [picture.shape[1] for picture in pictures],
            "encoding": ["mono8" if picture.ndim == 2 else "rgb8" for picture in pictures],
            "step": [picture[0].size for picture in pictures],
            "data": [picture.reshape(-1) for picture in pictures],
            **fields,
        }

    def deliveries(self, number: int) -> Iterator[Tuple[int, Delivery]]:
        writer = Guid(int.from_bytes(b"test", "big") << 32, number << 32)
        for n, at_ns in enumerate(self.at_ns):
            arrival = Arrival(at_ns, at_ns, writer, n + 1, self._cdr(n, at_ns))
            yield number, Delivery(self._topic, arrival)

    def _cdr(self, n: int, at_ns: int) -> bytes:
        message = self._message
        first = self._types.members(self._type_name)[0]
        if first.element == HEADER and first.length is None:
            stamp = getattr(message, first.name).stamp
            stamp.sec, stamp.nanosec = divmod(at_ns, 1_000_000_000)
        try:
            for path, values in self._columns:
                _set(message, path, values[n])
            return self._types.encode(message, self._type_name)
        except Exception as error:
            raise _error(
                self._topic,
                f"message {n} cannot be encoded: {error}",
                "use values that fit their fields",
            ) from None


def _set(message: Any, path: FieldPath, value: Any) -> None:
    owner, last = message, path.steps[-1]
    for step in path.steps[:-1]:
        owner = getattr(owner, step) if isinstance(step, str) else owner[step]
    element = path.leaf.element
    if path.is_array:
        plain: Any = list(value) if element == "string" else _array(value, path)
    elif element == "string":
        plain = str(value)
    else:
        plain = np.asarray(value).item()
        if element == "bool":
            plain = bool(plain)
        elif not element.startswith("float"):
            if plain != int(plain):
                raise ValueError(f"`{path.text}` is a whole number, and {plain} is not")
            plain = int(plain)
    if isinstance(last, str):
        setattr(owner, last, plain)
    else:
        owner[last] = plain


def _array(value: Any, path: FieldPath) -> Any:
    wanted = dtype(path.leaf.element)
    if isinstance(value, (bytes, bytearray, memoryview)):
        return np.frombuffer(value, dtype=np.uint8).astype(wanted)
    array = np.asarray(value).astype(wanted)
    if path.leaf.length is not None and 0 <= path.leaf.length != len(array):
        raise ValueError(
            f"`{path.text}` has {path.leaf.length} elements, and the array has {len(array)}"
        )
    return array


def _times(topic: str, table: Table) -> List[int]:
    if ("t" in table) == ("t_ns" in table):
        raise _error(
            topic,
            "it needs one of `t` and `t_ns`",
            "set the time of each message, in seconds or in nanoseconds",
        )
    if "t_ns" in table:
        at_ns = [int(time) for time in table["t_ns"]]
    else:
        seconds = np.asarray(table["t"], dtype=np.float64)
        if not np.isfinite(seconds).all():
            raise _error(topic, "a time is not finite", "remove such messages")
        at_ns = [int(time) for time in np.round(seconds * 1e9)]
    if any(later < earlier for earlier, later in zip(at_ns, at_ns[1:])):
        raise _error(topic, "times decrease", "sort the messages by time")
    return at_ns


def _error(topic: str, cause: str, help: str) -> ReplayError:
    return ReplayError(_unusable(topic), cause, help)


def _unusable(topic: str) -> str:
    return f"cannot use the arrays of topic `{topic}`"

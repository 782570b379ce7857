"""Topics, fields and samples, as a lambda reads them, over the rings of a replay. Clamps every
number that a lambda passes."""

from __future__ import annotations

from typing import Any, Callable, Dict, List, Mapping, Optional, Union

import numpy as np

from ..data import Column, Counts, DataError, Identity, Stamps, Value
from ._frame import Frame, FramePool, requested
from ._manifest import Input
from ._path import MissingElement, NotANumber, FieldPath, compile_path
from ._ring import Cell, Lease, Ring
from ._session import cut, i64, u64
from ._types import Types, stamp_of

SAMPLES_PER_CALL, TEXTS_PER_FIELD, PATH_BYTES, PATHS = 256, 4096, 1024, 256


class InputState:
    """State that all objects of one input share, for the whole replay."""

    def __init__(
        self, declared: Input, types: Types, limits: Mapping[str, int], frame_pool: FramePool
    ) -> None:
        self.declared, self.types = declared, types
        self.limits, self.frame_pool = limits, frame_pool
        self.ring = Ring(declared.depth, declared.hold, declared.max_size)
        self.skipped = 0
        self.is_stamped = types.is_stamped(declared.type_name)

    def message(self, cell: Cell) -> Any:
        """Returns the decoded message of a sample. Raises DataError (``malformed``)."""
        if cell.message is None:
            try:
                cell.message = self.types.decode(cell.arrival.cdr, self.declared.type_name)
            except Exception as error:
                raise self.malformed(str(error) or type(error).__name__) from None
        return cell.message

    def malformed(self, why: str) -> DataError:
        declared = self.declared
        return DataError(
            f"a sample of `{declared.topic}` contradicts its type `{declared.type_name}`: {why}",
            "malformed",
        )

    def number(self, cell: Cell, path: FieldPath) -> float:
        try:
            return path.number(self.message(cell))
        except NotANumber:
            of_type = f"field `{path.text}` of `{self.declared.type_name}`"
            why = f"{of_type} is not a number; `get` reads it"
            raise DataError(why, "wrong-field") from None
        except MissingElement as error:
            raise self.malformed(str(error)) from None

    def counts(self) -> Counts:
        ring = self.ring
        return Counts(ring.head, None, ring.overwritten, ring.no_slot, ring.too_big, self.skipped)

    def identity(self, cell: Cell) -> Identity:
        return Identity(self.declared.topic, cell.arrival.writer, cell.arrival.seq)

    def stamps(self, cell: Cell) -> Stamps:
        header_ns = None
        if self.is_stamped:
            try:
                seconds, nanoseconds = stamp_of(
                    self.message(cell), self.declared.type_name, self.types
                )
                header_ns = seconds * 1_000_000_000 + nanoseconds
            except DataError:
                pass
        return Stamps(cell.arrival.at_ns, cell.arrival.publish_ns, header_ns)


class Field:
    """A compiled path into the messages of one topic."""

    def __init__(self, source: InputState, path: FieldPath) -> None:
        self._source, self._path = source, path

    @property
    def path(self) -> str:
        return self._path.text

    def __repr__(self) -> str:
        return f"<Field `{self.path}`>"


def _path(field: Field, source: InputState) -> FieldPath:
    """Returns the path of a field. Raises DataError (``wrong-field``) if the field belongs to
    another input."""
    if source is not field._source:
        belongs, asked = field._source.declared.name, source.declared.name
        raise DataError(
            f"field `{field.path}` belongs to input `{belongs}`, not to `{asked}`", "wrong-field"
        )
    return field._path


class FieldCache:
    """The fields of one input that have been compiled so far."""

    def __init__(self, source: InputState) -> None:
        self._source = source
        self._known: Dict[str, Field] = {}

    def at(self, path: Any) -> Field:
        if not isinstance(path, str):
            raise TypeError(f"'{type(path).__name__}' object cannot be converted to 'PyString'")
        field = self._known.get(path)
        if field is None:
            size = len(path.encode())
            if size > PATH_BYTES:
                why = f"has {size} bytes; a path has at most {PATH_BYTES}"
                raise DataError(f"field `{cut(path, 64)}` {why}", "wrong-field")
            field = Field(
                self._source,
                compile_path(self._source.types, self._source.declared.type_name, path),
            )
            # Bounds the memory of a lambda that generates paths.
            if len(self._known) < PATHS:
                self._known[path] = field
        return field

    def of(self, given: Any) -> FieldPath:
        """Returns the path of a field, or compiles a path."""
        if isinstance(given, Field):
            return _path(given, self._source)
        if not isinstance(given, str):
            raise TypeError("a field must be a Field, or its path as a str")
        return _path(self.at(given), self._source)


class Sample:
    """One message; keeps its cell of the ring."""

    def __init__(self, source: InputState, fields: FieldCache, lease: Lease) -> None:
        self._source, self._fields, self._lease = source, fields, lease

    @property
    def _cell(self) -> Cell:
        return self._lease.cell

    @property
    def identity(self) -> Identity:
        return self._source.identity(self._cell)

    @property
    def stamps(self) -> Stamps:
        return self._source.stamps(self._cell)

    def get(self, field: Union[Field, str]) -> Value:
        path, source = self._fields.of(field), self._source
        try:
            value: Value = path.value(source.message(self._cell))
        except MissingElement as error:
            raise source.malformed(str(error)) from None
        most = self._most(value)
        if most is not None and _length(value) > most:
            why = f"has {_length(value)} items; one call returns at most {most}: read it with `cdr`"
            raise DataError(f"field `{path.text}` {why}", "wrong-field")
        return value

    def _most(self, value: Value) -> Optional[int]:
        limits = self._source.limits
        if isinstance(value, (str, bytes)):
            return limits["call_bytes"]
        if isinstance(value, list):
            return min(limits["call_items"], TEXTS_PER_FIELD)
        return limits["call_items"] if isinstance(value, np.ndarray) else None

    def number(self, field: Union[Field, str]) -> float:
        return self._source.number(self._cell, self._fields.of(field))

    @property
    def size(self) -> int:
        return len(self._cell.arrival.cdr) - 4

    @property
    def big_endian(self) -> bool:
        return self._cell.arrival.cdr[1] == 0

    def cdr(self, offset: int = 0, len: Optional[int] = None) -> bytes:
        most, kind = self._source.limits["call_bytes"], f"sample of `{self._source.declared.topic}`"
        return requested(self._cell.arrival.cdr[4:], offset, len, most, kind)

    def as_frame(self) -> Frame:
        source, cell = self._source, self._cell
        about = (source.identity(cell), source.stamps(cell))
        return source.frame_pool.frame(
            source.declared, lambda: source.message(cell), self._lease, about
        )

    def __repr__(self) -> str:
        return f"<Sample {self.identity.topic} seq {self.identity.seq}, at {self.stamps.at_ns} ns>"


def _length(value: Any) -> int:
    return len(value.encode()) if isinstance(value, str) else len(value)


class Topic:
    """The ring of one input."""

    def __init__(self, source: InputState) -> None:
        self._source, self._fields = source, FieldCache(source)

    @property
    def name(self) -> str:
        return self._source.declared.name

    @property
    def ros_topic(self) -> str:
        return self._source.declared.topic

    @property
    def type_name(self) -> str:
        return self._source.declared.type_name

    def newest(self) -> Optional[Sample]:
        cell = self._source.ring.newest()
        return None if cell is None else sample(self, cell)

    def last(self, n: int) -> List[Sample]:
        return self._samples(u64(n), lambda _: True)

    def since(self, since_ns: int) -> List[Sample]:
        since = i64(since_ns)
        return self._samples(SAMPLES_PER_CALL, lambda arrival: arrival.at_ns > since)

    def _samples(self, most: int, keep: Callable[[Any], bool]) -> List[Sample]:
        most = min(most, self._source.limits["call_items"], SAMPLES_PER_CALL)
        return [sample(self, cell) for cell in self._source.ring.newest_while(most, keep)]

    def counts(self) -> Counts:
        return self._source.counts()

    def field(self, path: str) -> Field:
        return self._fields.at(path)

    def column(self, field: Union[Field, str], n: int) -> Column:
        path = self._fields.of(field)
        return self._column(path, u64(n), lambda _: True)

    def column_since(self, field: Union[Field, str], since_ns: int) -> Column:
        path, since = self._fields.of(field), i64(since_ns)
        return self._column(path, self._source.ring.depth, lambda arrival: arrival.at_ns > since)

    def _column(self, path: FieldPath, most: int, keep: Callable[[Any], bool]) -> Column:
        source = self._source
        cells = source.ring.newest_while(min(most, source.limits["call_items"]), keep)
        values = [source.number(cell, path) for cell in cells]
        at_ns = [cell.arrival.at_ns for cell in cells]
        return Column(np.array(at_ns, dtype=np.int64), np.array(values, dtype=np.float64))

    def __repr__(self) -> str:
        return f"<Topic `{self.name}`: {self.ros_topic} {self.type_name}>"


def sample(topic: Topic, cell: Cell) -> Sample:
    """Creates the sample object of a cell for the lambda."""
    return Sample(topic._source, topic._fields, cell.lease())

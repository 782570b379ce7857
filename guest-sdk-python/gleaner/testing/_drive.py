"""Reads recorded drives, message by message in the order of the host's replay. `rosbags` reads the
files."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any, Dict, Iterable, Iterator, List, NamedTuple, Sequence, Tuple, Union

import numpy as np

from ..data import Column, Guid
from ._error import ReplayError, nearest, quoted
from ._path import MissingElement, NotANumber, compile_path
from ._ring import Arrival
from ._types import Definitions, Types, gathered, none

Name = Union[str, "os.PathLike[str]"]


class Delivery(NamedTuple):
    """A message and its topic."""

    topic: str
    arrival: Arrival


class Drive:
    """A recorded drive: MCAP files, or rosbag2 directories of either storage. Several files are
    read as one drive.

    ``path`` is a path or a list of paths. The attribute ``topics`` maps each topic to its type.
    Raises ReplayError for files that cannot be read."""

    def __init__(self, path: Union[Name, Sequence[Name]]) -> None:
        self.paths = _paths(path)
        self._shown = ", ".join(map(str, self.paths))
        self.topics: Dict[str, str] = {}
        with _opened(self.paths) as reader:
            for connection in reader.connections:
                first = self.topics.setdefault(connection.topic, connection.msgtype)
                if first != connection.msgtype:
                    topic, second = connection.topic, connection.msgtype
                    cause = f"topic `{topic}` is of type `{first}` and of `{second}`"
                    raise ReplayError(f"cannot use drive `{self._shown}`", cause)
            self._own = reader.typestore
            spans = [(one.start_time, one.end_time) for one in reader.readers if one.message_count]
        self.start_ns: int = min((start for start, _ in spans), default=0)
        """Stamp of the first message of all topics, in ns; 0 if there is none."""
        self.begins_ns = self.start_ns
        self.end_ns: int = max((end for _, end in spans), default=1) - 1
        """Stamp of the last message of all topics, in ns."""

    def __repr__(self) -> str:
        seconds = (self.end_ns - self.start_ns) / 1e9
        return f"<Drive {self._shown}: {seconds:.1f} s, {len(self.topics)} topics>"

    @property
    def is_partial(self) -> bool:
        """Returns whether topics of a lambda may be missing."""
        return False

    def type_of(self, topic: str) -> str:
        """Returns the type of a topic. Raises ReplayError, which names the most similar topic."""
        if topic not in self.topics:
            near = nearest(topic, self.topics)
            help = "pass remap={FROM: TO} if the lambda uses another name"
            if near:
                help = f"did you mean `{near}`?"
            cause = f"it has no topic `{topic}`; it has {quoted(self.topics)}"
            raise ReplayError(f"cannot use drive `{self._shown}`", cause, help)
        return self.topics[topic]

    def types(self, wanted: Iterable[str], more: Definitions) -> Types:
        """Collects types: from the files, or else from ``more``. Raises ReplayError for a type in
        neither."""
        return gathered(self._own, wanted, more)

    def deliveries(self, topics: Iterable[str]) -> Iterator[Delivery]:
        """Returns the messages of these topics by stamp; those with equal stamps in the order of
        the files, then of the channels."""
        wanted = set(topics)
        counted: Dict[Tuple[str, Guid], int] = {}
        with _opened(self.paths) as reader:
            chosen = [connection for connection in reader.connections if connection.topic in wanted]
            files = {
                id(c.owner): file
                for file, owner in enumerate(reader.readers)
                for c in owner.connections
            }
            messages = _readable(
                self._shown, reader.messages(connections=chosen) if chosen else iter(())
            )
            for at_ns, group in itertools.groupby(messages, key=lambda message: message[1]):
                # The sort is stable: messages of one channel and instant keep their order in the
                # file.
                ordered = sorted(
                    ((files[id(c.owner)], c.id, c, raw) for c, _, raw in group),
                    key=lambda it: it[:2],
                )
                for file, channel, connection, raw in ordered:
                    writer = _writer(file, channel)
                    key = connection.topic, writer
                    seq = counted[key] = counted.get(key, 0) + 1
                    data = _checked(self._shown, connection.topic, raw)
                    yield Delivery(connection.topic, Arrival(at_ns, at_ns, writer, seq, data))

    def column(self, topic: str, path: str) -> Column:
        """Returns the values of a numeric field in all messages of a topic: two arrays, ``at_ns``
        and ``values``.

        Raises ReplayError for a topic that the drive does not have, DataError for a field that does
        not exist."""
        type_name = self.type_of(topic)
        types = self.types([type_name], Definitions({}, None))
        field = compile_path(types, type_name, path)
        at_ns, values = [], []
        for _, arrival in self.deliveries([topic]):
            try:
                values.append(field.number(types.decode(arrival.cdr, type_name)))
            except NotANumber:
                raise ReplayError(f"field `{path}` of `{type_name}` is not a number") from None
            except MissingElement as error:
                raise ReplayError(f"cannot read `{path}` of `{topic}`", str(error)) from None
            at_ns.append(arrival.at_ns)
        return Column(np.array(at_ns, dtype=np.int64), np.array(values, dtype=np.float64))


def _paths(path: Union[Name, Sequence[Name]]) -> List[Path]:
    if isinstance(path, (str, os.PathLike)):
        return [Path(path)]
    return [Path(one) for one in path]


def _opened(paths: Sequence[Path]) -> Any:
    from rosbags.highlevel import AnyReader

    shown = ", ".join(map(str, paths))
    missing = [path for path in paths if not path.exists()]
    if missing or not paths:
        raise ReplayError(
            f"there is no drive `{missing[0] if missing else ''}`",
            help="pass MCAP files or rosbag2 directories",
        )
    try:
        # A directory is one bag; only files can be read together.
        return _Reader(AnyReader(paths, default_typestore=none()))
    except Exception as error:
        raise _unreadable(shown, error) from None


class _Reader:
    """An `AnyReader` that raises ReplayError."""

    def __init__(self, inner: Any) -> None:
        self._inner = inner

    def __enter__(self) -> Any:
        try:
            return self._inner.__enter__()
        except Exception as error:
            raise _unreadable(", ".join(map(str, self._inner.paths)), error) from None

    def __exit__(self, *raised: Any) -> None:
        self._inner.__exit__(*raised)


def _readable(shown: str, messages: Iterator[Any]) -> Iterator[Any]:
    while True:
        try:
            message = next(messages)
        except StopIteration:
            return
        except Exception as error:
            raise _unreadable(shown, error) from None
        yield message


def _unreadable(shown: str, error: Exception) -> ReplayError:
    help = (
        "`gleaner replay` reads a damaged MCAP file up to the damage; rosbags needs a complete one"
    )
    return ReplayError(f"cannot read drive `{shown}`", str(error) or type(error).__name__, help)


def _checked(shown: str, topic: str, raw: Any) -> bytes:
    data = bytes(raw)
    if data[:2] not in (b"\0\0", b"\0\1") or len(data) < 4:
        raise ReplayError(
            f"cannot read drive `{shown}`",
            f"a message of `{topic}` is not CDR: it begins with {data[:4]!r}",
        )
    return data


def _writer(file: int, channel: int) -> Guid:
    """Returns the writer that the host derives for a channel: `mcap`, the index of the file in the
    drive, the id of the channel."""
    return Guid(int.from_bytes(b"mcap", "big") << 32 | file, (channel & 0xFFFF_FFFF) << 32)

"""Reads recorded drives, message by message in the order of the host's replay. `rosbags` reads the
files."""

from __future__ import annotations

import contextlib
import heapq
import itertools
import os
from pathlib import Path
from typing import Any, Dict, Iterable, Iterator, List, NamedTuple, Sequence, Tuple, Union

import numpy as np
from rosbags.interfaces import Connection, MessageDefinitionFormat
from rosbags.rosbag2 import Reader

from ..data import Column, Guid
from ._error import ReplayError, nearest, quoted
from ._files import DrivePath
from ._path import MissingElement, NotANumber, compile_path
from ._ring import Arrival
from ._types import PASS_TYPES, Definitions, Types, gathered, parsed

Name = Union[str, "os.PathLike[str]"]


class Delivery(NamedTuple):
    """A message and its topic."""

    topic: str
    arrival: Arrival


class Drive:
    """A recorded drive: MCAP files, or rosbag2 directories of either storage. Several files are
    read as one drive.

    ``path`` is a path or a list of paths. The attribute ``topics`` maps each topic to its type.
    Raises ReplayError for files that cannot be read. A topic that cannot be read is an error where
    it is used."""

    def __init__(self, path: Union[Name, Sequence[Name]]) -> None:
        self.paths = _paths(path)
        self._shown = ", ".join(map(str, self.paths))
        self.topics: Dict[str, str] = {}
        # The definition is that of each file's own channel: the metadata of a directory has one for
        # each name of a type.
        self._channels: Dict[str, List[Connection]] = {}
        self._digests: Dict[str, Dict[str, None]] = {}
        with _opened(self.paths) as readers:
            for reader in readers:
                inside = [
                    connection
                    for storage in getattr(reader.storage, "storages", [reader.storage])
                    for connection in storage.connections
                ]
                for one in inside:
                    self._channels.setdefault(one.topic, []).append(one)
                for one in [*reader.connections, *inside]:
                    self.topics.setdefault(one.topic, one.msgtype)
                    self._digests.setdefault(one.topic, {})[one.digest] = None
            spans = [(one.start_time, one.end_time) for one in readers if one.message_count]
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
        found = {channel.msgtype: None for channel in self._channels.get(topic, [])}
        if len(found) > 1:
            cause = f"the drive has it as {quoted(found)}"
            help = "pass files that have one of them"
            raise ReplayError(f"topic `{topic}` has more than one type", cause, help)
        return self.topics[topic]

    def types(self, topic: str, more: Definitions) -> Types:
        """Returns the types of a topic: from the files, or else from ``more``. Raises ReplayError
        for a topic that cannot be read."""
        type_name = self.type_of(topic)
        what = f"cannot read topic `{topic}` of type `{type_name}`"
        found = [_types_of(channel, more, what) for channel in self._channels.get(topic, [])]
        for other in found[1:]:
            fields = found[0].layout(type_name), other.layout(type_name)
            for one, two in itertools.zip_longest(*fields, fillvalue="no field"):
                if one != two:
                    cause = f"the drive has two definitions of the type, with `{one}` and `{two}`"
                    help = "pass files that have one of them, or use `gleaner replay`"
                    raise ReplayError(what, cause, help)
        types = found[0] if found else gathered({}, type_name, more, what)
        for digest in filter(None, self._digests[topic]):
            if types.digest(type_name) not in (None, digest):
                cause = f"the definition of the type has not the hash of the topic, `{digest}`"
                raise ReplayError(what, cause, "`gleaner replay` finds the one that has, if any")
        return types

    def deliveries(self, topics: Iterable[str]) -> Iterator[Delivery]:
        """Returns the messages of these topics by stamp; those with equal stamps in the order of
        the files, then of the channels."""
        wanted = set(topics)
        counted: Dict[Tuple[str, Guid], int] = {}
        with _opened(self.paths) as readers:
            streams = [_messages(file, reader, wanted) for file, reader in enumerate(readers)]
            messages = _readable(self._shown, heapq.merge(*streams, key=lambda it: it[0]))
            for at_ns, group in itertools.groupby(messages, key=lambda it: it[0]):
                # The sort is stable: messages of one channel and instant keep their order in the
                # file.
                for _, file, channel, raw in sorted(group, key=lambda it: (it[1], it[2].id)):
                    writer = _writer(file, channel.id)
                    key = channel.topic, writer
                    seq = counted[key] = counted.get(key, 0) + 1
                    data = _checked(channel, raw)
                    yield Delivery(channel.topic, Arrival(at_ns, at_ns, writer, seq, data))

    def column(self, topic: str, path: str) -> Column:
        """Returns the values of a numeric field in all messages of a topic: two arrays, ``at_ns``
        and ``values``.

        Raises ReplayError for a topic that the drive does not have, DataError for a field that does
        not exist."""
        type_name = self.type_of(topic)
        types = self.types(topic, Definitions({}, None))
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


@contextlib.contextmanager
def _opened(paths: Sequence[Path]) -> Iterator[List[Reader]]:
    missing = [path for path in paths if not path.exists()]
    if missing or not paths:
        raise ReplayError(
            f"there is no drive `{missing[0] if missing else ''}`",
            help="pass MCAP files or rosbag2 directories",
        )
    with contextlib.ExitStack() as stack:
        try:
            readers = [stack.enter_context(Reader(DrivePath(path))) for path in paths]
        except Exception as error:
            raise _unreadable(", ".join(map(str, paths)), error) from None
        yield readers


def _types_of(channel: Connection, more: Definitions, what: str) -> Types:
    """Returns the types of a channel. Raises ReplayError, which begins with ``what``."""
    encoding = getattr(channel.ext, "serialization_format", "")
    if encoding != "cdr":
        help = "only messages in CDR, the encoding of ROS 2, can be read"
        raise ReplayError(what, f"its messages are encoded as `{encoding}`", help)
    form, text = channel.msgdef
    if form == MessageDefinitionFormat.MSG:
        help = "record it with the text of its .msg; other topics of the drive can be read"
        own = parsed(channel.msgtype, text, help, what)
        return gathered(own, channel.msgtype, more, what)
    if form == MessageDefinitionFormat.IDL and more.find(channel.msgtype) is None:
        cause = "its definition in the drive is in IDL, which is not read"
        raise ReplayError(what, cause, PASS_TYPES % channel.msgtype)
    return gathered({}, channel.msgtype, more, what)


def _messages(
    file: int, reader: Reader, topics: Iterable[str]
) -> Iterator[Tuple[int, int, Connection, bytes]]:
    """Yields stamp, number of the file, channel and bytes of the messages of these topics."""
    chosen = [one for one in reader.connections if one.topic in topics]
    # No choice would be all.
    for channel, at_ns, raw in reader.messages(chosen) if chosen else ():
        yield at_ns, file, channel, raw


def _readable(shown: str, messages: Iterator[Any]) -> Iterator[Any]:
    try:
        yield from messages
    except Exception as error:
        raise _unreadable(shown, error) from None


def _unreadable(shown: str, error: Exception) -> ReplayError:
    why = f"rosbags does not know {error}" if isinstance(error, KeyError) else str(error)
    help = "try `gleaner replay`: it reads more files than rosbags, which reads drives here"
    return ReplayError(f"cannot read drive `{shown}`", why or type(error).__name__, help)


def _checked(channel: Connection, raw: Any) -> bytes:
    data = bytes(raw)
    if data[:2] not in (b"\0\0", b"\0\1") or len(data) < 4:
        raise ReplayError(
            f"cannot read topic `{channel.topic}` of type `{channel.msgtype}`",
            f"a message of `{channel.topic}` is not CDR: it begins with {data[:4]!r}",
            "`gleaner replay` skips and counts such messages",
        )
    return data


def _writer(file: int, channel: int) -> Guid:
    """Returns the writer that the host derives for a channel: `mcap`, the index of the file in the
    drive, the id of the channel."""
    return Guid(int.from_bytes(b"mcap", "big") << 32 | file, (channel & 0xFFFF_FFFF) << 32)

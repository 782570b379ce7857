"""Compares the values in a clip with those in its drive, each decoded by third-party readers.

    values.py DRIVE CLIP

Each message of the clip must be one of the drive, with the same bytes, and decode to the same
values by the schema of its channel in either file: a right message under a wrong schema is a wrong
value. `rosbags` knows one definition for each type of a file, so it compares only drives that have
one. Prints the number of values that each reader compared.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from pathlib import Path
from typing import Any, Dict, Iterator, List, Optional, Set, Tuple

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

Key = Tuple[str, int, bytes]
# The fields of each message, with their values.
Decoded = Dict[Key, List[Tuple[str, str]]]


def values(message: Any, path: str = "") -> Iterator[Tuple[str, str]]:
    """The fields of a decoded message, arrays element by element; `repr` makes NaN equal."""
    names = getattr(message, "__slots__", None) or getattr(message, "__dataclass_fields__", None)
    if names:
        for name in names:
            if not name.startswith("__"):
                yield from values(getattr(message, name), f"{path}.{name}")
    elif isinstance(message, (list, tuple)) or hasattr(message, "tolist"):
        yield path, repr(list(message))
    else:
        yield path, repr(message)


def by_mcap_ros2(path: Path, wanted: Optional[Set[Key]]) -> Decoded:
    factory = DecoderFactory()
    found: Decoded = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            decode = factory.decoder_for(channel.message_encoding, schema)
            key = (channel.topic, message.log_time, message.data)
            if decode and (wanted is None or key in wanted):
                found[key] = list(values(decode(message.data)))
    return found


def by_rosbags(path: Path, wanted: Optional[Set[Key]]) -> Decoded:
    found: Decoded = {}
    with AnyReader([path]) as reader:
        for connection, log_time, data in reader.messages():
            key = (connection.topic, log_time, bytes(data))
            if wanted is None or key in wanted:
                found[key] = list(values(reader.deserialize(data, connection.msgtype)))
    return found


def definitions(path: Path) -> Dict[str, Set[bytes]]:
    """The definitions of each type of a file."""
    found: Dict[str, Set[bytes]] = defaultdict(set)
    with path.open("rb") as file:
        for schema in make_reader(file).get_summary().schemas.values():
            found[schema.name].add(schema.data.strip())
    return found


def main(drive: Path, clip: Path) -> None:
    readers = {"mcap-ros2-support": by_mcap_ros2}
    if all(len(texts) == 1 for texts in definitions(drive).values()):
        readers["rosbags"] = by_rosbags
    for name, read in readers.items():
        found = read(clip, None)
        source = read(drive, set(found))
        assert found, f"{name}: the clip has no message"
        for key, decoded in found.items():
            assert key in source, f"{name}: {key[:2]} is not in the drive"
            assert decoded == source[key], f"{name}: {key[:2]}: {decoded}, not {source[key]}"
        print(f"{name}: {sum(map(len, found.values()))} values")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

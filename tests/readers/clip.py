"""Reads a clip with the readers of others, and compares it with the drive that it was cut from.

    clip.py DRIVE CLIP FROM_NS TO_NS TOPIC...

The clip has to hold every message of the topics with a log time from FROM_NS to TO_NS, byte for byte, and nothing else, and to state the
checksums of docs/clips.md. Prints one line for each reader; an assertion that fails says what differs.
"""

from __future__ import annotations

import struct
import sys
import zlib
from collections import Counter
from pathlib import Path
from typing import Iterator, Tuple

from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader

Message = Tuple[str, int, bytes]


def by_mcap(path: Path) -> Iterator[Message]:
    with path.open("rb") as file:
        for _, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            yield channel.topic, message.log_time, message.data


def by_rosbags(path: Path) -> Iterator[Message]:
    with AnyReader([path]) as reader:
        for connection, log_time, data in reader.messages():
            # Every type is known, and every message of it can be read.
            reader.deserialize(data, connection.msgtype)
            yield connection.topic, log_time, bytes(data)


def by_mcap_ros2(path: Path) -> Counter[Tuple[str, int]]:
    return Counter((message.channel.topic, message.log_time_ns) for message in read_ros2_messages(str(path)))


def checksums(path: Path) -> tuple[dict[str, str], dict[str, str]]:
    """The checksums of all topics that have messages, by these and by the records."""
    found: Counter[str] = Counter()
    with path.open("rb") as file:
        reader = make_reader(file)
        for _, channel, message in reader.iter_messages():
            head = struct.pack("<QQI", message.log_time, message.publish_time, message.sequence)
            found[channel.topic] += zlib.crc32(head + message.data) ** 2
        records = [record.metadata for record in reader.iter_metadata() if record.name == "gleaner.topic"]
    stated = {record["topic"]: record["checksum"] for record in records if record["messages"] != "0"}
    return {topic: f"{total % 2**64:016x}" for topic, total in found.items()}, stated


def main(drive: Path, clip: Path, from_ns: int, to_ns: int, topics: list[str]) -> None:
    wanted = Counter(m for m in by_mcap(drive) if m[0] in topics and from_ns <= m[1] <= to_ns)
    assert wanted, "the drive holds nothing of the window"

    found = list(by_mcap(clip))
    assert Counter(found) == wanted, differences(wanted, Counter(found))
    by_messages, by_records = checksums(clip)
    assert by_messages == by_records, f"checksums {by_messages}, stated {by_records}"
    print(f"mcap: {len(found)} messages")

    found = list(by_rosbags(clip))
    assert Counter(found) == wanted, differences(wanted, Counter(found))
    print(f"rosbags: {len(found)} messages")

    read = by_mcap_ros2(clip)
    assert read == Counter((topic, log_time) for topic, log_time, _ in wanted.elements()), "mcap-ros2-support reads others"
    print(f"mcap-ros2-support: {sum(read.values())} messages")


def differences(wanted: Counter[Message], found: Counter[Message]) -> str:
    def told(messages: Counter[Message]) -> list[tuple[str, int, int]]:
        return [(topic, log_time, len(data)) for topic, log_time, data in list(messages)[:3]]

    return f"missing: {told(wanted - found)}, too many: {told(found - wanted)}"


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5:])

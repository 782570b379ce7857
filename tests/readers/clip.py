"""Reads a clip with third-party readers, and compares it with the drive from which it was recorded.

    clip.py DRIVE CLIP FROM_NS TO_NS TOPIC...

The clip must hold every message of the topics with a log time from FROM_NS to TO_NS, byte for byte,
and no other, and state the checksums of docs/clips.md. Prints one line for each reader; a failed
assertion names the difference.
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
            # Every type is defined, and every message can be deserialized.
            reader.deserialize(data, connection.msgtype)
            yield connection.topic, log_time, bytes(data)


def by_mcap_ros2(path: Path) -> Counter[Tuple[str, int]]:
    messages = read_ros2_messages(str(path))
    return Counter((message.channel.topic, message.log_time_ns) for message in messages)


def checksums(path: Path) -> tuple[dict[str, str], dict[str, str]]:
    """The checksums of all topics with messages: computed from these, and as in the records."""
    found: Counter[str] = Counter()
    with path.open("rb") as file:
        reader = make_reader(file)
        for _, channel, message in reader.iter_messages():
            head = struct.pack("<QQI", message.log_time, message.publish_time, message.sequence)
            found[channel.topic] += zlib.crc32(head + message.data) ** 2
        metadata = [record for record in reader.iter_metadata() if record.name == "gleaner.topic"]
        records = [record.metadata for record in metadata]
    stated = {r["topic"]: r["checksum"] for r in records if r["messages"] != "0"}
    return {topic: f"{total % 2**64:016x}" for topic, total in found.items()}, stated


def main(drive: Path, clip: Path, from_ns: int, to_ns: int, topics: list[str]) -> None:
    wanted = Counter(m for m in by_mcap(drive) if m[0] in topics and from_ns <= m[1] <= to_ns)
    assert wanted, "the drive has no messages in the window"

    found = list(by_mcap(clip))
    assert Counter(found) == wanted, differences(wanted, Counter(found))
    by_messages, by_records = checksums(clip)
    assert by_messages == by_records, f"checksums {by_messages}, stated {by_records}"
    print(f"mcap: {len(found)} messages")

    found = list(by_rosbags(clip))
    assert Counter(found) == wanted, differences(wanted, Counter(found))
    print(f"rosbags: {len(found)} messages")

    read = by_mcap_ros2(clip)
    expected = Counter((topic, log_time) for topic, log_time, _ in wanted.elements())
    assert read == expected, "mcap-ros2-support reads other messages"
    print(f"mcap-ros2-support: {sum(read.values())} messages")


def differences(wanted: Counter[Message], found: Counter[Message]) -> str:
    def shown(messages: Counter[Message]) -> list[tuple[str, int, int]]:
        return [(topic, log_time, len(data)) for topic, log_time, data in list(messages)[:3]]

    return f"missing: {shown(wanted - found)}, too many: {shown(found - wanted)}"


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5:])

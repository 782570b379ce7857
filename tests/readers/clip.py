"""Reads a clip with the readers of others, and compares it with the drive that it was cut from.

    clip.py DRIVE CLIP FROM_NS TO_NS TOPIC...

The clip has to hold every message of the topics with a log time from FROM_NS to TO_NS, byte for byte, and nothing else. Prints one
line for each reader; an assertion that fails says what differs.
"""

from __future__ import annotations

import sys
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


def main(drive: Path, clip: Path, from_ns: int, to_ns: int, topics: list[str]) -> None:
    wanted = Counter(m for m in by_mcap(drive) if m[0] in topics and from_ns <= m[1] <= to_ns)
    assert wanted, "the drive holds nothing of the window"

    found = list(by_mcap(clip))
    assert Counter(found) == wanted, differences(wanted, Counter(found))
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

"""Compares the clips of a run with its drives, both read by third-party readers.

    clips.py OUT DRIVE...

Each clip that OUT/clips.jsonl lists must

- have every message of its topics that the drives have in its window, byte for byte, and no other;
  it may lack as many as its line and OUT/summary.json count;
- decode to the values of the drives, by the schema of the channel in either file: a right message
  under a wrong schema is a wrong value;
- state the checksums of docs/clips.md.

Latched messages have the time of the clip's begin, and those of a live run the time of their
arrival: then bytes and values are compared, and no times. `rosbags` knows one definition for each
type of a file, so it reads only files that have one. Prints the number of values that each reader
compared.
"""

from __future__ import annotations

import json
import struct
import sys
import zlib
from collections import Counter, defaultdict
from functools import partial
from pathlib import Path
from typing import Any, Callable, Dict, Iterator, List, NamedTuple, Set, Tuple

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader


class Content(NamedTuple):
    topic: str
    type_name: str
    data: bytes


# Content and log time of a message, and the decoder of its channel.
Messages = Iterator[Tuple[Content, int, Callable[[bytes], Any]]]


FIELDS: Dict[type, List[str]] = {}


def fields(message: Any) -> List[str]:
    kind = type(message)
    if kind not in FIELDS:
        names = getattr(kind, "__slots__", ()) or getattr(kind, "__annotations__", ())
        FIELDS[kind] = [name for name in names if not name.startswith("__")]
    return FIELDS[kind]


def values(message: Any, path: str = "") -> Iterator[Tuple[str, str]]:
    """The fields of a decoded message, by their paths; `repr` makes NaN equal."""
    if names := fields(message):
        for name in names:
            yield from values(getattr(message, name), f"{path}.{name}")
    elif isinstance(message, list) and message and fields(message[0]):
        for index, part in enumerate(message):
            yield from values(part, f"{path}[{index}]")
    elif hasattr(message, "tobytes"):
        yield path, f"{message.dtype} {message.tobytes()!r}"
    else:
        yield path, repr(message)


def by_mcap_ros2(path: Path) -> Messages:
    factory = DecoderFactory()
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            content = Content(channel.topic, schema.name if schema else "", message.data)
            decoder = partial(factory.decoder_for, channel.message_encoding, schema)
            yield content, message.log_time, lambda data: (decoder() or bytes)(data)


def by_rosbags(path: Path) -> Messages:
    with AnyReader([path]) as reader:
        for connection, at_ns, data in reader.messages():
            content = Content(connection.topic, connection.msgtype, bytes(data))
            yield content, at_ns, partial(reader.deserialize, typ=connection.msgtype)


def is_for_rosbags(path: Path) -> bool:
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    schemas = list(summary.schemas.values()) if summary else []
    is_plain = all(schema.encoding == "ros2msg" for schema in schemas)
    definitions = {(it.name, it.data.strip()) for it in schemas}
    return is_plain and len(definitions) == len({name for name, _ in definitions})


def main(out: Path, drives: List[Path]) -> None:
    lines = [json.loads(line) for line in (out / "clips.jsonl").read_text().splitlines()]
    assert lines, "there are no clips"
    paths = [out / line["file"] for line in lines]
    readers: Dict[str, Callable[[Path], Messages]] = {"mcap-ros2-support": by_mcap_ros2}
    if all(map(is_for_rosbags, drives + paths)):
        readers["rosbags"] = by_rosbags
    for name, read in readers.items():
        clips = [
            [(key, at_ns, list(values(decode(key.data)))) for key, at_ns, decode in read(path)]
            for path in paths
        ]
        wanted = {key for clip in clips for key, _, _ in clip}
        drive, decoded = [], defaultdict(list)
        for key, at_ns, decode in (message for path in drives for message in read(path)):
            drive.append((key, at_ns))
            if key in wanted:
                decoded[key].append(list(values(decode(key.data))))
        for line, path, clip in zip(lines, paths, clips):
            compare(out, line, Counter((key, at_ns) for key, at_ns, _ in clip), drive)
            for key, at_ns, found in clip:
                where = f"{name}, {line['file']}: {key.topic} at {at_ns}"
                assert found in decoded[key], f"{where}: {found}, not {decoded[key]}"
        print(f"{name}: {sum(len(found) for clip in clips for _, _, found in clip)} values")


def compare(
    out: Path,
    line: Dict[str, Any],
    clip: Counter[Tuple[Content, int]],
    drive: List[Tuple[Content, int]],
) -> None:
    """Compares the messages of a clip with those of its window, and its checksums."""
    has_times, latched = inspect(out / line["file"])
    if not has_times:
        return
    topics = {(topic["topic"], topic["type_name"]): topic for topic in line["topics"]}
    window = Counter(
        (key, at_ns)
        for key, at_ns in drive
        if line["from_ns"] <= at_ns <= line["to_ns"] and key[:2] in topics
    )
    others = [(key.topic, at) for key, at in clip - window if key.topic not in latched]
    assert not others, f"{line['file']}: not in the window of the drive: {others[:3]}"
    malformed = json.loads((out / "summary.json").read_text()).get("malformed", {})
    missing = Counter(key[:2] for key, _ in (window - clip).elements())
    for kind, counts in topics.items():
        may = malformed.get(kind[0], 0) + max((counts["received"] or 0) - counts["messages"], 0)
        is_known = counts["received"] is not None
        assert not is_known or missing[kind] <= may, (
            f"{line['file']}: {missing[kind]} messages of {kind} are missing; {may} may"
        )


def inspect(clip: Path) -> Tuple[bool, Set[str]]:
    """Checks the checksums. Returns whether the times are those of the drive, and the latched
    topics."""
    found: Counter[str] = Counter()
    latched = set()
    with clip.open("rb") as file:
        reader = make_reader(file)
        for _, channel, message in reader.iter_messages(log_time_order=False):
            head = struct.pack("<QQI", message.log_time, message.publish_time, message.sequence)
            found[channel.topic] += zlib.crc32(head + message.data) ** 2
            if "gleaner.latched" in channel.metadata:
                latched.add(channel.topic)
        records = [(record.name, record.metadata) for record in reader.iter_metadata()]
    computed = {topic: f"{total % 2**64:016x}" for topic, total in found.items()}
    topics = [it for name, it in records if name == "gleaner.topic" and it["messages"] != "0"]
    stated = {it["topic"]: it["checksum"] for it in topics}
    assert computed == stated, f"{clip.name}: checksums {computed}, stated {stated}"
    clock = [it["clock"] for name, it in records if name == "gleaner.clip"]
    return clock == ["log time of the drive"], latched


if __name__ == "__main__":
    given = map(Path, sys.argv[2:])
    files = [file for it in given for file in (it.glob("*.mcap") if it.is_dir() else [it])]
    main(Path(sys.argv[1]), [file for file in files if file.stat().st_size])

"""Tests `gleaner.testing` over drives with topics that it cannot read: each matters only where it
is used. `mcap` writes the files, and `struct` the messages."""

from __future__ import annotations

import struct
import tempfile
import unittest
from pathlib import Path
from typing import List, Tuple

import home  # noqa: F401
from mcap.writer import Writer

from gleaner.testing import Drive, ReplayError
from gleaner.testing._types import Definitions

WHEELS, IDL = "car/msg/Wheels", "car/msg/Idl"
OLD, NEW = b"float32 left\nfloat32 right\n", b"uint32 status\nfloat32 left\nfloat32 right\n"
COMMENTED = b"# of a car\nuint8 UNIT=3\n" + OLD
CDR = b"\0\1\0\0"
# Topic, type, format and text of its definition, encoding, and message.
Channel = Tuple[str, str, str, bytes, str, bytes]


def wheels(topic: str, left: float, definition: bytes = OLD) -> Channel:
    begin = CDR + struct.pack("<I", 7) * (definition == NEW)
    return topic, WHEELS, "ros2msg", definition, "cdr", begin + struct.pack("<ff", left, 0)


class ForeignTopics(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def write(self, *channels: Channel, profile: str = "ros2") -> Path:
        """Writes a drive with a message on each channel."""
        path = self.folder / f"{len(list(self.folder.iterdir()))}.mcap"
        writer = Writer(str(path))
        writer.start(profile, "tests")
        for n, (topic, type_name, form, definition, encoding, message) in enumerate(channels):
            schema = writer.register_schema(type_name, form, definition) if type_name else 0
            writer.add_message(writer.register_channel(topic, encoding, schema), n, message, n)
        writer.finish()  # type: ignore[no-untyped-call]
        return path

    def left(self, drive: Drive, topic: str = "/wheels") -> List[float]:
        return list(drive.column(topic, "left").values)

    def refused(self, drive: Drive, what: str, cause: str, topic: str = "/wheels") -> None:
        with self.assertRaises(ReplayError) as raised:
            self.left(drive, topic)
        self.assertIn(f"{what}\n  cause: {cause}", str(raised.exception))
        self.assertNotIn("damage", str(raised.exception))

    def test_topics_that_cannot_be_read_are_refused_only_where_they_are_used(self) -> None:
        srv, idl = b"bool data\n---\nbool success\n", b"module car { struct Idl {}; };"
        path = self.write(
            # The content of such a schema is not text.
            ("/proto", "foxglove.Log", "protobuf", b"\n\xff\xfe", "protobuf", b"\x08\x01"),
            ("/json", "Log", "jsonschema", b"{}", "json", b"{}"),
            ("/bare", "", "", b"", "cdr", CDR),
            ("/service", "std_srvs/srv/SetBool_Event", "ros2msg", srv, "cdr", CDR),
            ("/idl", IDL, "ros2idl", idl, "cdr", CDR),
            ("/xcdr2", WHEELS, "ros2msg", OLD, "cdr", b"\0\7\0\0abcd"),
            ("/two", "std_msgs/msg/String", "ros2msg", b"string data\n", "cdr", CDR),
            ("/two", "std_msgs/msg/Int8", "ros2msg", b"int8 data\n", "cdr", CDR),
            wheels("/wheels", 3.5),
            profile="",
        )
        drive = Drive(path)
        self.assertEqual(self.left(drive), [3.5])
        for topic, type_name, cause in (
            ("/proto", "foxglove.Log", "its messages are encoded as `protobuf`"),
            ("/json", "Log", "its messages are encoded as `json`"),
            ("/service", "std_srvs/srv/SetBool_Event", "the definition is not that of a message:"),
            ("/idl", IDL, "its definition in the drive is in IDL, which is not read"),
            ("/xcdr2", WHEELS, "a message of `/xcdr2` is not CDR: it begins with"),
        ):
            self.refused(drive, f"cannot read topic `{topic}` of type `{type_name}`", cause, topic)
        both = "the drive has it as `std_msgs/msg/String`, `std_msgs/msg/Int8`"
        self.refused(drive, "topic `/two` has more than one type", both, "/two")
        # As in the host, a lambda can bring what the drive has in IDL only.
        types = drive.types("/idl", Definitions({IDL: OLD.decode()}, None))
        self.assertEqual(list(types.layout(IDL)), ["float32 left", "float32 right"])

    def test_two_layouts_of_a_type_are_right_on_two_topics_and_refused_on_one(self) -> None:
        two = Drive(self.write(wheels("/old", 1), wheels("/new", 2, NEW)))
        self.assertEqual([self.left(two, "/old"), self.left(two, "/new")], [[1.0], [2.0]])
        one = self.write(wheels("/wheels", 1), wheels("/wheels", 2, NEW))
        first, second = self.write(wheels("/wheels", 1)), self.write(wheels("/wheels", 2, NEW))
        self.assertEqual([self.left(Drive(path)) for path in (first, second)], [[1.0], [2.0]])
        what = f"cannot read topic `/wheels` of type `{WHEELS}`"
        both = "the drive has two definitions of the type, with `float32 left` and `uint32 status`"
        for paths in ([one], [first, second]):
            self.refused(Drive(paths), what, both)
        again = self.write(wheels("/wheels", 5, COMMENTED))
        self.assertEqual(self.left(Drive([first, again])), [1.0, 5.0])

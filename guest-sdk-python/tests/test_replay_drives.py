"""Tests `gleaner.testing` over recorded drives: MCAP files, rosbag2 directories of both storages,
and unreadable ones."""

from __future__ import annotations

import tempfile
import unittest
from pathlib import Path
from typing import Any, Dict, List

import drive
import home
import numpy as np
from hosted import GREY
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from gleaner import Context, DataError, Sample
from gleaner.testing import Drive, ReplayError, replay

SAMPLE = home.CHECKOUT / "examples" / "data" / "highway_drive.mcap"
HELLO = home.CHECKOUT / "examples" / "hello" / "python"
STORE = get_typestore(Stores.ROS2_HUMBLE)
SPEED = "geometry_msgs/msg/Twist"


def manifest(**of_input: Any) -> Dict[str, Any]:
    return {
        "lambda": {"name": "probe", "version": "0.1.0", "kind": "python", "entry": "main.py"},
        "schedule": {"event": "speed"},
        "input": [{"name": "speed", "topic": "/speed", "type": SPEED, **of_input}],
    }


class Speeds:
    """An event for each sample, of its speed."""

    def __init__(self, ctx: Context) -> None:
        self.field = ctx.input("speed").field("linear.x")

    def on_event(self, ctx: Context, event: Sample) -> None:
        ctx.event("speed", event.number(self.field), seq=event.identity.seq)


def bag(path: Path, speeds: List[float], storage: StoragePlugin, **compression: Any) -> None:
    """Writes a rosbag2 directory with a message every second, from second 1."""
    with_compression = compression.pop("mode", None)
    writer = Writer(path, version=9, storage_plugin=storage)
    if with_compression is not None:
        writer.set_compression(with_compression, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/speed", SPEED, typestore=STORE)
        vector, twist = STORE.types["geometry_msgs/msg/Vector3"], STORE.types[SPEED]
        for n, speed in enumerate(speeds, 1):
            message = twist(
                linear=vector(x=speed, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=0.0)
            )
            writer.write(connection, n * 1_000_000_000, STORE.serialize_cdr(message, SPEED))


class Drives(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)

    def test_bags_of_both_storages_and_all_compressions_are_drives(self) -> None:
        for storage in (StoragePlugin.MCAP, StoragePlugin.SQLITE3):
            for mode in (None, CompressionMode.FILE, CompressionMode.MESSAGE):
                if (storage, mode) == (StoragePlugin.MCAP, CompressionMode.FILE):
                    continue  # `rosbags` does not write these.
                with self.subTest(storage=storage, mode=mode):
                    path = self.folder / f"{storage.name}-{mode}"
                    bag(path, [3.5, 4.5], storage, mode=mode)
                    run = replay(Speeds, path, manifest=manifest())
                    self.assertEqual(
                        [(t.at_s, t.score, t.attributes) for t in run.triggers],
                        [(0.0, 3.5, {"seq": 1}), (1.0, 4.5, {"seq": 2})],
                    )
                    self.assertEqual((run.start_ns, run.end_ns), (1_000_000_000, 2_000_000_000))

    def test_several_files_are_one_drive_in_the_order_of_time(self) -> None:
        paths = [self.folder / "first.mcap", self.folder / "second.mcap"]
        drive.write(paths[0], [GREY, GREY], [1000, 3000])
        drive.write(paths[1], [GREY, GREY], [1000, 2000])
        camera = {"name": "speed", "topic": "/camera", "type": "sensor_msgs/msg/Image"}

        class Writers(Speeds):
            def __init__(self, ctx: Context) -> None:
                pass

            def on_event(self, ctx: Context, event: Sample) -> None:
                ctx.event(str(event.identity.writer)[8:16], event.identity.seq)

        run = replay(Writers, paths, manifest={**manifest(), "input": [camera]})
        found = [(t.at_ns // 1_000_000, t.label, t.score) for t in run.triggers]
        self.assertEqual(
            found,
            [
                (1000, "00000000", 1),
                (1000, "00000001", 1),
                (2000, "00000001", 2),
                (3000, "00000000", 2),
            ],
        )

    def test_a_drive_can_be_read_without_a_lambda(self) -> None:
        sample = Drive(SAMPLE)
        self.assertEqual(sample.topics["/imu/data"], "sensor_msgs/msg/Imu")
        self.assertEqual(repr(sample).split(": ")[1], "40.0 s, 3 topics>")
        column = sample.column("/imu/data", "linear_acceleration.z")
        self.assertEqual((len(column.values), column.at_ns[0] - sample.start_ns), (4170, 1_792_276))
        self.assertTrue(8 < column.values.mean() < 11, "gravity")
        with self.assertRaisesRegex(DataError, "has no field `linear`"):
            sample.column("/imu/data", "linear.z")
        with self.assertRaisesRegex(ReplayError, "is not a number"):
            sample.column("/imu/data", "header.frame_id")
        with self.assertRaisesRegex(ReplayError, "did you mean `/imu/data`"):
            sample.column("/imu/dat", "linear_acceleration.z")
        # An open drive can be replayed, too.
        self.assertEqual(len(replay(HELLO, sample, config={"brake_mps2": -1.4}).triggers), 3)

    def test_topics_are_remapped_as_in_ros(self) -> None:
        path = self.folder / "bag"
        bag(path, [3.5], StoragePlugin.SQLITE3)
        self.assertEqual(len(replay(Speeds, path, manifest=manifest()).triggers), 1)
        other = manifest(topic="/velocity")
        with self.assertRaisesRegex(ReplayError, "it has no topic `/velocity`; it has `/speed`"):
            replay(Speeds, path, manifest=other)
        run = replay(Speeds, path, manifest=other, remap={"/velocity": "/speed"})
        self.assertEqual((run.decisions[0].topic, run.triggers[0].score), ("/velocity", 3.5))

    def test_a_remapped_topic_must_be_in_the_manifest(self) -> None:
        path = self.folder / "bag"
        bag(path, [3.5], StoragePlugin.SQLITE3)
        with self.assertRaisesRegex(
            ReplayError,
            "no input has the topic `/velocty` of remap\n.*the manifest has `/speed`, `/other`",
        ):
            given = {**manifest(), "record": {"topics": ["/speed", "/other"]}}
            replay(Speeds, path, manifest=given, remap={"/velocty": "/speed"})

    def test_two_inputs_may_be_one_topic_of_the_drive(self) -> None:
        path = self.folder / "bag"
        bag(path, [3.5, 4.5], StoragePlugin.SQLITE3)

        class Both(Speeds):
            def on_event(self, ctx: Context, event: Sample) -> None:
                ctx.event(
                    "seen",
                    event.number("linear.x"),
                    **{name: ctx.input(name).counts().received for name in ctx.inputs()},
                )

        inputs = [
            {"name": name, "topic": f"/{name}", "type": SPEED}
            for name in ("first", "speed", "third")
        ]
        # Each input gets its own delivery: a woken lambda reads the new sample on inputs before its
        # own, and not yet on those after it.
        run = replay(
            Both,
            path,
            manifest={**manifest(), "input": inputs},
            remap={f"/{name}": "/speed" for name in ("first", "third")},
        )
        self.assertEqual(
            [(t.score, t.attributes) for t in run.triggers],
            [
                (3.5, {"first": 1, "speed": 1, "third": 0}),
                (4.5, {"first": 2, "speed": 2, "third": 1}),
            ],
        )
        self.assertEqual(
            {name: count.received for name, count in run.counts.items()},
            {"first": 2, "speed": 2, "third": 2},
        )

    def test_a_record_without_a_topic_of_the_drive_is_refused(self) -> None:
        path = self.folder / "bag"
        bag(path, [3.5], StoragePlugin.SQLITE3)
        record = {**manifest(), "record": {"topics": ["/imu", "/camera"]}}
        with self.assertRaisesRegex(
            ReplayError,
            "none of the topics of \\[record\\]\n.*has `/imu`, `/camera`\n"
            ".*the drive has `/speed`; pass remap=",
        ):
            replay(Speeds, path, manifest=record)
        # Some topics may be missing, and arrays need not have all of them.
        self.assertEqual(
            len(replay(Speeds, path, manifest=record, remap={"/imu": "/speed"}).windows), 1
        )
        self.assertEqual(len(replay(Speeds, {"/speed": {"t": [0]}}, manifest=record).windows), 1)

    def test_an_input_of_another_type_is_refused(self) -> None:
        with self.assertRaisesRegex(
            ReplayError, "input `speed` is of type .*\n.*topic `/speed` is of type `geometry_msgs"
        ):
            path = self.folder / "bag"
            bag(path, [1.0], StoragePlugin.SQLITE3)
            replay(Speeds, path, manifest=manifest(type="sensor_msgs/msg/Imu"))

    def test_samples_that_are_too_large_are_counted(self) -> None:
        path = self.folder / "bag"
        bag(path, [1.0, 2.0], StoragePlugin.MCAP)
        run = replay(Speeds, path, manifest=manifest(max_size="10 B"))
        self.assertEqual(
            (run.decisions, run.counts["speed"].too_big, run.counts["speed"].received), ([], 2, 0)
        )

    def test_incomplete_and_missing_drives_are_refused_by_name(self) -> None:
        cut, other = self.folder / "cut.mcap", self.folder / "other.mcap"
        cut.write_bytes(SAMPLE.read_bytes()[:100_000])
        other.write_text("no drive")
        empty = self.folder / "empty"
        empty.mkdir()
        for path in (cut, other, empty):
            with (
                self.subTest(path=path),
                self.assertRaisesRegex(ReplayError, f"cannot read drive `{path}`\n  cause: ."),
            ):
                replay(HELLO, path)
        with self.assertRaisesRegex(ReplayError, "there is no drive `nowhere.mcap`"):
            replay(HELLO, "nowhere.mcap")

    def test_reading_a_message_that_contradicts_its_type_is_a_fault(self) -> None:
        path = self.folder / "bag"
        with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            connection = writer.add_connection("/speed", SPEED, typestore=STORE)
            writer.write(connection, 1, b"\0\1\0\0short")
            writer.write(connection, 2, b"\0\1\0\0" + np.arange(6.0).tobytes())
        run = replay(Speeds, path, manifest=manifest())
        self.assertEqual([decision.fault is not None for decision in run.decisions], [True, False])
        self.assertIn(
            "a sample of `/speed` contradicts its type `geometry_msgs/msg/Twist`",
            str(run.faults[0].fault),
        )

    def test_bytes_that_are_not_cdr_end_the_replay(self) -> None:
        path = self.folder / "bag"
        with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
            writer.write(writer.add_connection("/speed", SPEED, typestore=STORE), 1, b"xy")
        with self.assertRaisesRegex(ReplayError, "a message of `/speed` is not CDR"):
            replay(Speeds, path, manifest=manifest())

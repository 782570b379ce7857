"""Tests message definitions in `gleaner.testing`: those of a drive, of the lambda, and of ROS 2, in
this order."""

from __future__ import annotations

import contextlib
import sqlite3
import tempfile
import unittest
from pathlib import Path
from typing import Any, Dict, List

import home  # noqa: F401
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from gleaner import Context, DataError, Sample
from gleaner.testing import Drive, ReplayError, replay

WHEELS = "car/msg/Wheels"
OF_WHEELS, OF_WHEEL = "Wheel[] wheels\n", "# Of one wheel.\nfloat32 speed\n"

MANIFEST = """
[lambda]
name = "wheels"
version = "0.1.0"
kind = "python"
entry = "main.py"
[schedule]
event = "wheels"
[[input]]
name = "wheels"
topic = "/wheels"
type = "car/msg/Wheels"
"""

SOURCE = "def on_event(ctx, event): ctx.event('speed', event.number('wheels[0].speed'))\n"


def bag(path: Path, speed: float, with_definitions: bool) -> None:
    """Writes a rosbag2 directory with one message. Before ROS 2 Iron, databases had no
    definitions."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(OF_WHEEL, "car/msg/Wheel"))
    store.register(get_types_from_msg(OF_WHEELS, WHEELS))
    with Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection("/wheels", WHEELS, typestore=store)
        message = store.types[WHEELS](wheels=[store.types["car/msg/Wheel"](speed=speed)])
        writer.write(connection, 1, store.serialize_cdr(message, WHEELS))
    if not with_definitions:
        (file,) = path.glob("*.db3")
        with contextlib.closing(sqlite3.connect(file)) as database:
            database.executescript(
                "DROP TABLE message_definitions; UPDATE schema SET schema_version = 3;"
            )


class Definitions(unittest.TestCase):
    def setUp(self) -> None:
        folder = tempfile.TemporaryDirectory()
        self.addCleanup(folder.cleanup)
        self.folder = Path(folder.name)
        self.lambda_ = self.folder / "lambda"
        self.write({"main.py": SOURCE, "lambda.toml": MANIFEST})

    def write(self, files: Dict[str, str]) -> None:
        for inside, text in files.items():
            path = self.lambda_ / inside
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text, encoding="utf-8")

    def scores(self, drive: Any, **how: Any) -> List[Any]:
        run = replay(self.lambda_, drive, **how)
        self.assertEqual(run.faults, [])
        return [trigger.score for trigger in run.triggers]

    def test_a_drive_without_definitions_uses_those_that_are_passed(self) -> None:
        bag(self.folder / "bag", 3.5, with_definitions=False)
        with self.assertRaisesRegex(
            ReplayError,
            "there is no definition of `car/msg/Wheels`\n.*pass types=.*msg/ beside the lambda",
        ):
            replay(self.lambda_, self.folder / "bag")
        with self.assertRaisesRegex(
            ReplayError,
            "there is no definition of `car/msg/Wheel`, to which `car/msg/Wheels` refers",
        ):
            replay(self.lambda_, self.folder / "bag", types={WHEELS: OF_WHEELS})
        types = {WHEELS: OF_WHEELS, "car/msg/Wheel": OF_WHEEL}
        self.assertEqual(self.scores(self.folder / "bag", types=types), [3.5])

    def test_definitions_in_the_folder_msg_of_the_lambda_are_used(self) -> None:
        bag(self.folder / "bag", 3.5, with_definitions=False)
        for files in (
            {"msg/car/msg/Wheels.msg": OF_WHEELS, "msg/car/Wheel.msg": OF_WHEEL},
            {"msg/Wheels.msg": OF_WHEELS, "msg/Wheel.msg": OF_WHEEL},
        ):
            self.write({**files, "msg/car/msg/Other.msg": "float32 4 ="})
            self.assertEqual(self.scores(self.folder / "bag"), [3.5])
            for inside in files:
                (self.lambda_ / inside).unlink()
        self.write({"msg/car/msg/Wheels.msg": "float32 4 ="})
        with self.assertRaisesRegex(
            ReplayError,
            "(?s)cannot use the definition of `car/msg/Wheels`\n"
            ".*correct `.*/msg/car/msg/Wheels.msg`",
        ):
            replay(self.lambda_, self.folder / "bag")
        (self.lambda_ / "msg/car/msg/Wheels.msg").write_bytes(b"\xff")
        with self.assertRaisesRegex(ReplayError, "cannot read `.*/msg/car/msg/Wheels.msg`"):
            replay(self.lambda_, self.folder / "bag")

    def test_recorded_definitions_take_precedence(self) -> None:
        bag(self.folder / "bag", 3.5, with_definitions=True)
        self.write({"msg/car/msg/Wheels.msg": "float32 other\n"})
        self.assertEqual(self.scores(self.folder / "bag", types={WHEELS: "string other\n"}), [3.5])

    def test_a_definition_that_has_not_the_hash_of_the_topic_is_refused(self) -> None:
        bag(self.folder / "bag", 3.5, with_definitions=True)
        (file,) = (self.folder / "bag").glob("*.db3")
        with contextlib.closing(sqlite3.connect(file)) as database, database:
            database.execute(
                "UPDATE message_definitions SET encoded_message_definition = 'float32 speed' "
                "WHERE topic_type LIKE '%/Wheels'"
            )
        refused = f"cannot read topic `/wheels` of type `{WHEELS}`\n.*not the hash of the topic"
        with self.assertRaisesRegex(ReplayError, refused):
            replay(self.lambda_, self.folder / "bag")

    def test_definitions_of_the_lambda_take_precedence_over_ros_2(self) -> None:
        self.write(
            {
                "lambda.toml": MANIFEST.replace(WHEELS, "geometry_msgs/msg/Vector3"),
                "main.py": "def on_event(ctx, event): ctx.event('speed', event.number('speed'))\n",
                "msg/geometry_msgs/msg/Vector3.msg": "float32 speed\n",
            }
        )
        self.assertEqual(self.scores({"/wheels": {"t": [0], "speed": [2]}}), [2.0])
        # Without the package it does not replace a type of ROS 2.
        (self.lambda_ / "msg/geometry_msgs/msg/Vector3.msg").rename(
            self.lambda_ / "msg/Vector3.msg"
        )
        with self.assertRaisesRegex(ReplayError, "has no field `speed`"):
            replay(self.lambda_, {"/wheels": {"t": [0], "speed": [2]}})

    def test_a_class_uses_definitions_beside_its_manifest(self) -> None:
        class Speeds:
            def __init__(self, ctx: Context) -> None:
                try:
                    ctx.input("wheels").field("speed")
                except DataError as error:
                    ctx.log("info", str(error))

            def on_event(self, ctx: Context, event: Sample) -> None:
                ctx.event("speed", event.number("wheels[0].speed"))

        bag(self.folder / "bag", 3.5, with_definitions=False)
        self.write({"msg/car/Wheels.msg": OF_WHEELS, "msg/car/Wheel.msg": OF_WHEEL})
        run = replay(Speeds, self.folder / "bag", manifest=self.lambda_ / "lambda.toml")
        self.assertEqual([trigger.score for trigger in run.triggers], [3.5])
        self.assertIn("has no field `speed`", run.log[0].message)

    def test_a_drive_without_a_definition_can_be_opened(self) -> None:
        bag(self.folder / "bag", 3.5, with_definitions=False)
        drive = Drive(self.folder / "bag")
        self.assertEqual(drive.topics, {"/wheels": WHEELS})
        with self.assertRaisesRegex(ReplayError, "there is no definition of `car/msg/Wheels`"):
            drive.column("/wheels", "wheels[0].speed")
        bag(self.folder / "other", 4.5, with_definitions=True)
        self.assertEqual(
            Drive(self.folder / "other").column("/wheels", "wheels[0].speed").values.tolist(), [4.5]
        )

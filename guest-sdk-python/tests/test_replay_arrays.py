"""Tests `gleaner.testing.replay` over arrays: the arguments of a user, and the errors of invalid
ones. Needs no host."""

from __future__ import annotations

import contextlib
import copy
import io
import types
import unittest
import zlib
from typing import Any, Dict, List, Tuple

import home  # noqa: F401
import numpy as np
from PIL import Image

from gleaner import Context, DataError, Sample
from gleaner.testing import ReplayError, StartError, _manifest, replay

IMU = "/imu/data"

# Invalid values, and the expected part of the error.
Cases = List[Tuple[Dict[str, Any], str]]


def manifest(**tables: Any) -> Dict[str, Any]:
    """Returns a manifest as a dict, with these tables in place of the defaults."""
    given: Dict[str, Any] = {
        "lambda": {"name": "probe", "version": "0.1.0", "kind": "python", "entry": "main.py"},
        "schedule": {"event": "imu"},
        "input": [{"name": "imu", "topic": IMU, "type": "sensor_msgs/msg/Imu", "depth": 3}],
    }
    return {**copy.deepcopy(given), **tables}


def imu(z: List[float]) -> Dict[str, Any]:
    return {IMU: {"t": np.arange(len(z)) / 10, "linear_acceleration.z": z}}


def encoded(form: str, size: Tuple[int, int], mode: str) -> bytes:
    file = io.BytesIO()
    Image.new(mode, size, 128 if mode == "L" else (200, 100, 50)).save(file, form)
    return file.getvalue()


def chunk(kind_and_data: bytes) -> bytes:
    """Returns a chunk of a PNG."""
    return (
        (len(kind_and_data) - 4).to_bytes(4, "big")
        + kind_and_data
        + zlib.crc32(kind_and_data).to_bytes(4, "big")
    )


class Above:
    """An event for each sample above a threshold."""

    def __init__(self, ctx: Context) -> None:
        self.limit: float = ctx.config.get("limit", 1.0)

    def on_event(self, ctx: Context, event: Sample) -> None:
        z = event.number("linear_acceleration.z")
        if z > self.limit:
            ctx.event("above", z, n=len(ctx.input("imu").last(9)))


class Arrays(unittest.TestCase):
    def test_times_and_values_of_arrays_are_those_of_triggers(self) -> None:
        run = replay(Above, imu([0, 2, 0, 0, 3]), manifest=manifest())
        self.assertEqual(
            [(t.at_s, t.score, t.attributes) for t in run.triggers],
            [(0.1, 2.0, {"n": 2}), (0.4, 3.0, {"n": 3})],
        )
        self.assertEqual(
            (len(run.decisions), run.faults, run.start_ns, run.end_ns), (5, [], 0, 400_000_000)
        )
        self.assertEqual((run.counts["imu"].received, run.counts["imu"].overwritten), (5, 2))
        times, scores = run.series("above")
        self.assertEqual((times.tolist(), scores.tolist()), ([0.1, 0.4], [2.0, 3.0]))

    def test_config_overrides_the_manifest(self) -> None:
        items = {"limit": {"default": 1.0, "max": 10, "unit": "m/s^2"}}
        run = replay(
            Above,
            imu([0, 2, 0, 0, 3]),
            manifest=manifest(config=items),
            config={"limit": np.float32(2.5)},
        )
        self.assertEqual([t.score for t in run.triggers], [3.0])
        refused: Cases = [
            ({"limt": 1}, "did you mean `limit`"),
            ({"limit": "1"}, "use a number"),
            ({"limit": float("nan")}, "use a number"),
            ({"limit": 11}, "its max is 10"),
        ]
        for config, why in refused:
            with self.assertRaisesRegex(ReplayError, why):
                replay(Above, imu([0]), manifest=manifest(config=items), config=config)

    def test_headers_have_the_stamps_and_other_fields_are_empty(self) -> None:
        class Lambda(Above):
            def on_event(self, ctx: Context, event: Sample) -> None:
                assert event.stamps == (2_500_000_000, 2_500_000_000, 2_500_000_000), event.stamps
                assert event.get("header.frame_id") == "" and event.number("orientation.w") == 0
                covariance: Any = event.get("orientation_covariance")
                assert covariance.tolist() == [0.0] * 8 + [4.5]
                assert event.size == len(event.cdr()) > 0 and not event.big_endian

        arrays = {IMU: {"t_ns": [2_500_000_000], "orientation_covariance": [[0] * 8 + [4.5]]}}
        self.assertEqual(replay(Lambda, arrays, manifest=manifest()).faults, [])

    def test_images_are_arrays_of_numpy(self) -> None:
        class Lambda(Above):
            def on_event(self, ctx: Context, event: Sample) -> None:
                frame = event.as_frame()
                ctx.event(frame.info.encoding, frame.mean_luma(), shape=str(frame.array().shape))

        inputs = [{"name": "imu", "topic": "/camera", "type": "sensor_msgs/msg/Image"}]
        given = {
            "t": [0, 1],
            "image": [np.full((2, 3), 7, np.uint8), np.full((4, 5, 3), 9, np.uint8)],
        }
        run = replay(Lambda, {"/camera": given}, manifest=manifest(input=inputs))
        self.assertEqual(
            [(t.label, t.score, t.attributes["shape"]) for t in run.triggers],
            [("mono8", 7.0, "(2, 3)"), ("rgb8", 9.0, "(4, 5, 3)")],
        )
        with self.assertRaisesRegex(ReplayError, "use uint8 of shape"):
            replay(
                Lambda,
                {"/camera": {"t": [0], "image": [np.zeros((2, 3))]}},
                manifest=manifest(input=inputs),
            )

    def test_compressed_images_are_decoded_within_the_limits(self) -> None:
        kept: List[Any] = []

        class Lambda(Above):
            def on_event(self, ctx: Context, event: Sample) -> None:
                try:
                    frame = event.as_frame()
                    assert event.as_frame().array() is not frame.array(), "decoded once, two arrays"
                    ctx.event(frame.info.encoding, frame.mean_luma(), size=frame.info.size)
                    kept.append(frame)
                except DataError as error:
                    ctx.event(error.kind, 0.0, why=str(error))

        inputs = [
            {
                "name": "imu",
                "topic": "/camera",
                "type": "sensor_msgs/msg/CompressedImage",
                "decoded_size": "600 B",
            }
        ]
        small, grey, large = (
            encoded("JPEG", (20, 10), "RGB"),
            encoded("PNG", (5, 4), "L"),
            encoded("JPEG", (21, 10), "RGB"),
        )
        header = b"IHDR" + (60_000).to_bytes(4, "big") * 2 + b"\x08\2\0\0\0"
        bomb = (
            b"\x89PNG\r\n\x1a\n"
            + chunk(header)
            + chunk(b"IDAT" + zlib.compress(b""))
            + chunk(b"IEND")
        )
        data = [small, grey, large, bomb, small[:400], b"GIF89a", b"", small, small, small]
        run = replay(
            Lambda,
            {"/camera": {"t": range(len(data)), "data": data}},
            manifest=manifest(input=inputs),
        )
        self.assertEqual(run.faults, [])
        found = [(t.label, t.attributes.get("size", t.attributes.get("why"))) for t in run.triggers]
        self.assertEqual(found[:2], [("rgb8", 600), ("rgb8", 60)])
        self.assertEqual(
            [label for label, _ in found[2:]],
            ["no-room", "no-room", *["not-a-frame"] * 3, "rgb8", "no-room", "no-room"],
        )
        self.assertIn(
            "21x10 (630 bytes as rgb8); this input's decoded_size is 600 bytes", str(found[2][1])
        )
        self.assertIn("every slot for decoded images of `/camera` is held", str(found[-1][1]))

    def test_custom_types_are_defined_by_their_text(self) -> None:
        class Lambda(Above):
            def on_event(self, ctx: Context, event: Sample) -> None:
                ctx.event(
                    "wheel",
                    event.number("speeds[1]"),
                    name=str(event.get("names")),
                    flag=str(event.get("on")),
                )

        inputs = [{"name": "imu", "topic": "/wheels", "type": "car/msg/Wheels"}]
        arrays = {
            "/wheels": {"t": [0.0], "speeds": [[1.0, 2.0]], "names": [["a", "b"]], "on": [True]}
        }
        with self.assertRaisesRegex(ReplayError, "pass types="):
            replay(Lambda, arrays, manifest=manifest(input=inputs))
        types = {"car/msg/Wheels": "float32[] speeds\nstring[] names\nbool on\n"}
        run = replay(Lambda, arrays, manifest=manifest(input=inputs), types=types)
        self.assertEqual(
            (run.triggers[0].score, run.triggers[0].attributes),
            (2.0, {"name": "['a', 'b']", "flag": "True"}),
        )

    def test_topics_are_merged_by_time(self) -> None:
        class Lambda(Above):
            def on_event(self, ctx: Context, event: Sample) -> None:
                speed = ctx.input("speed").newest()
                ctx.event("speed", -1.0 if speed is None else speed.number("twist.linear.x"))

        speed = {"name": "speed", "topic": "/speed", "type": "geometry_msgs/msg/TwistStamped"}
        declared = manifest(input=[*manifest()["input"], speed])
        arrays = {**imu([0, 0, 0]), "/speed": {"t": [0.05, 0.2], "twist.linear.x": [5, 6]}}
        self.assertEqual(
            [t.score for t in replay(Lambda, arrays, manifest=declared).triggers], [-1.0, 5.0, 5.0]
        )
        # Messages with equal times are in the order of the topics; a topic may be missing.
        arrays = {"/speed": arrays["/speed"], IMU: arrays[IMU]}
        self.assertEqual(
            [t.score for t in replay(Lambda, arrays, manifest=declared).triggers], [-1.0, 5.0, 6.0]
        )
        self.assertEqual(
            [t.score for t in replay(Lambda, imu([0]), manifest=declared).triggers], [-1.0]
        )

    def test_inconsistent_arrays_are_refused(self) -> None:
        refused: Cases = [
            ({"linear_acceleration.z": [1]}, "it needs one of `t` and `t_ns`"),
            ({"t": [0], "t_ns": [0]}, "it needs one of `t` and `t_ns`"),
            ({"t": [1, 0]}, "times decrease"),
            ({"t": [float("nan")]}, "a time is not finite"),
            ({"t": [0], "linear_acceleration.zz": [1]}, "has no field `zz`"),
            ({"t": [0], "linear_acceleration": [1]}, "is a whole `geometry_msgs/msg/Vector3`"),
            ({"t": [0, 1], "linear_acceleration.z": [1]}, "has 1 values for 2 times"),
            (
                {"t": [0], "orientation_covariance": [[1, 2]]},
                "message 0 cannot be encoded: .* has 9 elements, and the array has 2",
            ),
            ({"t": [0], "header.stamp.sec": [0.5]}, "is a whole number, and 0.5 is not"),
        ]
        for table, why in refused:
            with self.subTest(table=table), self.assertRaisesRegex(ReplayError, why):
                replay(Above, {IMU: table}, manifest=manifest())
        with self.assertRaisesRegex(ReplayError, "no input of the lambda has this topic"):
            replay(Above, {**imu([0]), "/other": {"t": [0]}}, manifest=manifest())
        with self.assertRaisesRegex(ReplayError, "nothing would wake the lambda"):
            replay(Above, {}, manifest=manifest())


class Manifests(unittest.TestCase):
    def test_invalid_manifests_are_refused_by_key(self) -> None:
        one = manifest()["input"][0]
        refused: Cases = [
            ({"schedul": {}}, "did you mean `schedule`"),
            ({"schedule": {"event": "imo"}}, "names no input: `imo`"),
            ({"schedule": {"event": "imu", "period": "1s"}}, "needs one of `event` and `period`"),
            ({"schedule": {"period": "1s", "backlog": "each"}}, "missed ticks are counted"),
            ({"schedule": {"period": "1 day"}}, 'for example "50ms"'),
            ({"schedule": {"period": "1us"}}, "its range is 1000000 to"),
            ({"input": [{**one, "depth": 0}]}, "has a `depth` of 0"),
            ({"input": [{**one, "depth": True}]}, "not a whole number"),
            ({"input": [{**one, "dept": 1}]}, "did you mean `depth`"),
            ({"input": [{**one, "max_size": "1 MB"}]}, 'for example "2 MiB"'),
            ({"input": [{**one, "type": "Imu"}]}, "has the type `Imu`"),
            ({"input": [{**one, "decoded_size": "1 MiB"}]}, "is not decoded"),
            ({"input": [one, one]}, "two \\[\\[input\\]\\] with the name `imu`"),
            ({"limits": {"log_lines": 0}}, "has a `log_lines` of 0"),
            ({"limits": {"deadline": 5}}, 'for example "50ms"'),
            ({"config": {"a": {"unit": "m"}}}, "`config.a` has no `default`"),
            ({"config": {"a": [1]}}, "`default` of an unsupported type"),
        ]
        for tables, why in refused:
            with self.subTest(why=why), self.assertRaisesRegex(ReplayError, why):
                replay(Above, imu([0]), manifest=manifest(**tables))

    def test_a_class_requires_a_manifest(self) -> None:
        with self.assertRaisesRegex(ReplayError, "there is no manifest beside"):
            replay(Above, imu([0]))
        with self.assertRaisesRegex(ReplayError, "cannot read manifest `nowhere.toml`"):
            replay(Above, imu([0]), manifest="nowhere.toml")
        with self.assertRaisesRegex(ReplayError, "there is no lambda `nowhere`"):
            replay("nowhere", imu([0]))

    def test_manifests_of_the_checkout_can_be_read(self) -> None:
        found = sorted(home.CHECKOUT.glob("*/*/*/lambda.toml")) + sorted(
            home.CHECKOUT.glob("tests/lambdas/*/*/lambda.toml")
        )
        self.assertGreater(len(found), 6)
        for path in found:
            with self.subTest(path=path):
                self.assertTrue(_manifest.read(path, {}).name)


class Lambdas(unittest.TestCase):
    def test_plain_functions_of_a_module_are_a_lambda(self) -> None:
        module = types.ModuleType("plain")
        exec(
            "def init(ctx): ctx.log('info', 'made')\ndef on_event(ctx, event): ctx.event('e', 1)",
            module.__dict__,
        )
        run = replay(module, imu([0]), manifest=manifest())
        self.assertEqual((len(run.triggers), [line.message for line in run.log]), (1, ["made"]))

    def test_a_lambda_without_the_handler_of_its_schedule_does_not_start(self) -> None:
        with self.assertRaisesRegex(StartError, "has no `on_tick\\(self, ctx\\)`, which `period`"):
            replay(Above, imu([0]), manifest=manifest(schedule={"period": "1s"}))

    def test_the_exception_of_init_is_the_cause(self) -> None:
        class Lambda(Above):
            def __init__(self, ctx: Context) -> None:
                raise KeyError("gone")

        with self.assertRaises(StartError) as caught:
            replay(Lambda, imu([0]), manifest=manifest())
        self.assertIsInstance(caught.exception.__cause__, KeyError)
        self.assertEqual(caught.exception.kind, "exception")

    def test_a_lambda_of_another_language_is_refused(self) -> None:
        with self.assertRaisesRegex(ReplayError, "is of kind `wasm`"):
            replay(home.CHECKOUT / "examples" / "hello" / "rust", imu([0]))

    def test_printed_text_can_go_to_standard_output(self) -> None:
        class Lambda(Above):
            def on_event(self, ctx: Context, event: Sample) -> None:
                print("seen")

        output = io.StringIO()
        with contextlib.redirect_stdout(output):
            run = replay(Lambda, imu([0]), manifest=manifest(), prints_to_log=False)
        self.assertEqual((output.getvalue(), run.log), ("seen\n", []))
        self.assertEqual(
            [line.message for line in replay(Lambda, imu([0]), manifest=manifest()).log], ["seen"]
        )

    def test_scratch_survives_a_fault(self) -> None:
        class Lambda(Above):
            def on_event(self, ctx: Context, event: Sample) -> None:
                ctx.scratch.append("seen", b"x")
                ctx.event(
                    "seen",
                    len(ctx.scratch.get("seen")),
                    free=ctx.scratch.free(),
                    entries=str(ctx.scratch.entries()),
                )
                raise RuntimeError("no")

        run = replay(Lambda, imu([0, 0, 0]), manifest=manifest(limits={"scratch": "70 B"}))
        self.assertEqual([t.score for t in run.triggers], [1.0, 2.0])
        self.assertEqual([t.attributes["free"] for t in run.triggers], [1, 0])
        self.assertIn("needs 1 bytes of scratch and 0 are free", str(run.faults[2].fault))

    def test_triggers_over_the_limit_per_minute_are_counted(self) -> None:
        run = replay(Above, imu([2] * 700), manifest=manifest(limits={"events_per_minute": 5}))
        # The second minute begins at 60 s: 600 samples in the first, then 100.
        self.assertEqual((len(run.triggers), run.triggers_refused), (10, 700 - 10 - run.backed_off))
        self.assertGreater(run.backed_off, 0)

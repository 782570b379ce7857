"""Tests lambdas in the real host: each test replays a small drive through `start.py` and checks the
decisions."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import home
from drive import Image
from hosted import GREY, Hosted

import gleaner


class Arrays(Hosted):
    def array_of(self, image: Image, *checks: str) -> None:
        """Asserts `checks` on `array`, the pixels of `image`."""
        source = (
            "import numpy as np\n"
            "def on_event(ctx, event):\n    frame = event.as_frame()\n    array = frame.array()\n"
        )
        lines = [
            f"    assert {check}, (array.dtype, array.shape, array.strides, array.tolist())\n"
            for check in checks
        ]
        self.replay(source + "".join(lines), [image])

    def test_colour_has_a_channel_axis(self) -> None:
        image = Image(2, 2, "bgr8", 6, bytes(range(12)))
        self.array_of(
            image,
            "array.dtype == np.uint8",
            "array.tobytes() == bytes(range(12))",
            "array.shape == (2, 2, 3)",
        )
        image = Image(1, 2, "rgba8", 4, bytes(range(8)))
        self.array_of(image, "array.shape == (2, 1, 4)", "array[1, 0].tolist() == [4, 5, 6, 7]")

    def test_padding_of_rows_is_skipped(self) -> None:
        image = Image(2, 2, "rgb8", 8, bytes(range(16)))
        self.array_of(
            image, "array.strides == (8, 3, 1)", "array[1].tolist() == [[8, 9, 10], [11, 12, 13]]"
        )

    def test_grey_and_bayer_have_two_axes(self) -> None:
        self.array_of(GREY, "array.tolist() == [[7, 9]]", "array.dtype == np.uint8")
        self.array_of(Image(2, 1, "bayer_rggb8", 2, b"\x01\x02"), "array.tolist() == [[1, 2]]")

    def test_sixteen_bit_pixels_keep_their_byte_order(self) -> None:
        self.array_of(Image(2, 1, "mono16", 4, b"\x01\x00\x00\x01"), "array.tolist() == [[1, 256]]")
        image = Image(2, 1, "mono16", 4, b"\x01\x00\x00\x01", big_endian=True)
        self.array_of(
            image,
            "array.tolist() == [[256, 1]]",
            "array.dtype == np.dtype('>u2')",
            "(array + 1).sum() == 259",
        )
        # An odd number of bytes per row puts the pixels at an odd address.
        image = Image(2, 2, "bayer_gbrg16", 5, bytes([1, 0, 2, 0, 9, 3, 0, 4, 0, 9]))
        self.array_of(image, "array.tolist() == [[1, 2], [3, 4]]", "not array.flags.aligned")

    def test_yuv422_has_two_numbers_for_each_pixel(self) -> None:
        self.array_of(
            Image(2, 1, "yuv422", 4, b"\x01\x02\x03\x04"), "array.tolist() == [[[1, 2], [3, 4]]]"
        )

    def test_an_array_is_read_only(self) -> None:
        source = """
            def on_event(ctx, event):
                array = event.as_frame().array()
                for write in (
                    lambda: array.fill(0),
                    lambda: array.setflags(write=True),
                    lambda: array.__setitem__(0, 0),
                ):
                    try:
                        write()
                    except ValueError:
                        pass
                    else:
                        raise AssertionError("it was written to")
        """
        self.replay(source, [GREY])

    def test_numpy_and_dlpack_share_the_memory(self) -> None:
        source = """
            import numpy as np

            def on_event(ctx, event):
                frame = event.as_frame()
                array = frame.array()
                assert np.shares_memory(array, np.asarray(frame))
                assert np.asarray(frame, dtype=float).tolist() == [[7.0, 9.0]]
                assert not np.shares_memory(array, np.array(frame, copy=True))
                assert tuple(frame.__dlpack_device__()) == (1, 0)
                if np.lib.NumpyVersion(np.__version__) >= "2.1.0":
                    shared = np.from_dlpack(frame)
                    assert np.shares_memory(array, shared) and not shared.flags.writeable
                else:
                    try:
                        np.from_dlpack(frame)
                    except BufferError:
                        pass
        """
        self.replay(source, [GREY])

    def test_the_slot_is_released_with_the_last_view(self) -> None:
        source = """
            kept = []

            def on_event(ctx, event):
                kept.append(event.as_frame().array()[:, 1:])
                if len(kept) == 3:
                    assert [view.tolist() for view in kept] == [[[0]], [[1]], [[2]]]
                    kept.clear()
                ctx.event("no-slot", ctx.input("camera").counts().no_slot)
        """
        images = [Image(2, 1, "mono8", 2, bytes([99, n % 3])) for n in range(60)]
        decisions = self.replay(source, images, depth=1)
        self.assertEqual([decision["triggers"][0]["score"] for decision in decisions], [0.0] * 60)


class Data(Hosted):
    # As `drive` writes it, 5 ns before the log time.
    PUBLISHED_NS = 999_999_995

    def test_a_sample_has_identity_stamps_and_fields(self) -> None:
        source = """
            import gleaner

            def on_event(ctx, event):
                expected = gleaner.Stamps(1_000_000_000, PUBLISHED_NS, 7_000_000_500)
                assert event.stamps == expected, event.stamps
                assert event.stamps.at_ns == ctx.now_ns()
                assert (event.identity.topic, event.identity.seq) == ("/camera", 1), event.identity
                assert event.get("encoding") == "mono8" and event.get("is_bigendian") == 0
                assert event.get("data") == b"\\x07\\x09"
                assert event.number("header.stamp.sec") == 7.0
                assert event.size == len(event.cdr()) and not event.big_endian
                assert event.cdr(event.size - 2) == b"\\x07\\x09"
                assert event.cdr(8, 4) == b"\\x04\\x00\\x00\\x00"
                assert repr(event) == "<Sample /camera seq 1, at 1000000000 ns>", repr(event)
                frame = event.as_frame()
                assert frame.info == gleaner.FrameInfo(2, 1, "mono8", 2, False, 2), frame.info
                assert frame.identity == event.identity and frame.stamps == event.stamps
                assert (frame.mean_luma(), frame.mean_luma((1, 0, 1, 1))) == (8.0, 9.0)
                assert frame.mean_luma(gleaner.Roi(0, 0, 1, 1)) == 7.0
                assert frame.histogram()[7:10].tolist() == [1, 0, 1]
                assert frame.resize(4, 2).info.size == 8 and frame.to_gray().read(1) == b"\\x09"
                ctx.event(str(event.identity.writer), 0.0)
        """
        decision = self.replay(source.replace("PUBLISHED_NS", str(self.PUBLISHED_NS)), [GREY])[0]
        self.assertEqual(decision["triggers"][0]["label"], decision["writer"])

    def test_a_topic_shows_its_ring(self) -> None:
        source = """
            import numpy as np

            def on_event(ctx, event):
                camera = ctx.input("camera")
                assert camera is ctx.input("camera") and ctx.inputs() == ["camera"]
                assert (camera.name, camera.ros_topic) == ("camera", "/camera")
                assert camera.type_name == "sensor_msgs/msg/Image"
                assert camera.field("step") is camera.field("step")
                assert camera.field("step").path == "step"
                seq = event.identity.seq
                assert camera.newest().identity == event.identity
                expected = [s for s in (seq - 1, seq) if s]
                assert [sample.identity.seq for sample in camera.last(2)] == expected
                assert [sample.identity.seq for sample in camera.since(ctx.now_ns() - 1)] == [seq]
                at_ns, values = camera.column("width", 10)
                assert at_ns.dtype == np.int64 and values.dtype == np.float64
                assert at_ns[-1] == ctx.now_ns()
                column = camera.column_since(camera.field("width"), ctx.now_ns() - 1)
                assert column.values.tolist() == [float(seq)]
                assert camera.counts().received == seq and camera.counts().lost is None
        """
        self.replay(source, [Image(n, 1, "mono8", n, bytes(n)) for n in (1, 2, 3)])

    def test_a_number_out_of_range_is_an_overflow(self) -> None:
        source = """
            def on_event(ctx, event):
                camera, frame = ctx.input("camera"), event.as_frame()
                whole = (camera.last, lambda n: camera.column("width", n), event.cdr, frame.read)
                half = (
                    lambda n: event.cdr(0, n),
                    lambda n: frame.read(0, n),
                    lambda n: frame.resize(n, 1),
                    lambda n: frame.mean_luma((n, 0, 1, 1)),
                )
                signed = (camera.since, lambda n: camera.column_since("width", n))
                for calls, fitting, others in (
                    (whole, (0, 2**64 - 1), (-1, 2**64)),
                    (half, (1,), (-1, 2**32, 2**64)),
                    (signed, (-2**63, 2**63 - 1), (-2**63 - 1, 2**63)),
                ):
                    for n, call in enumerate(calls):
                        for number in fitting:
                            call(number)
                        for number in others:
                            try:
                                call(number)
                            except OverflowError as error:
                                ctx.log("info", str(error))
                                continue
                            raise AssertionError((n, number))
        """
        self.replay(source, [GREY])
        negative, much, range, long = (
            "can't convert negative int to unsigned",
            "int too big to convert",
            "out of range integral type conversion attempted",
            "Python int too large to convert to C long",
        )
        self.assertEqual(
            [text for _, text in self.log()],
            [negative, much] * 4 + [range, range, long] * 4 + [long, long] * 2,
        )

    def test_configuration_has_the_types_of_the_manifest(self) -> None:
        source = """
            def on_event(ctx, event):
                expected = {"text": "a", "number": 1.5, "whole": 2, "flag": True}
                assert ctx.config == expected, ctx.config
                assert ctx.config["flag"] is True and ctx.missed == 0
        """
        self.replay(source, [GREY])

    def test_a_refusal_has_a_kind(self) -> None:
        source = """
            import gleaner

            def refused(call, *arguments):
                try:
                    call(*arguments)
                except gleaner.Error as error:
                    return type(error).__name__, error.kind
                return None

            def on_event(ctx, event):
                frame = event.as_frame()
                found = [
                    refused(ctx.input, "imo"),
                    refused(ctx.input("camera").field, "with"),
                    refused(event.number, "encoding"),
                    refused(frame.mean_luma, (5, 5, 1, 1)),
                    refused(frame.resize, 0, 1),
                    refused(ctx.event, "", 1.0),
                    refused(gleaner.Model.open, "detector"),
                ]
                assert found == [
                    ("DataError", "no-such-input"),
                    ("DataError", "no-such-field"),
                    ("DataError", "wrong-field"),
                    ("DataError", "out-of-range"),
                    ("DataError", "out-of-range"),
                    ("TriggerError", "invalid"),
                    ("InferenceError", "no-such-model"),
                ], found
        """
        self.replay(source, [GREY])


class Triggers(Hosted):
    def test_keyword_arguments_become_attributes_of_plain_types(self) -> None:
        source = """
            import numpy as np

            def on_event(ctx, event):
                more = {"whole": np.int64(3), "flag": np.bool_(True), "a key": 2.5}
                ctx.event("e", np.float32(0.5), label="l", score=-1, **more)
                ctx.start("s", why="rain")
                ctx.stop("s")
        """
        triggers = self.replay(source, [GREY])[0]["triggers"]
        attributes = {"label": "l", "score": -1, "whole": 3, "flag": True, "a key": 2.5}
        self.assertEqual(
            triggers[0], {"kind": "event", "label": "e", "score": 0.5, "attributes": attributes}
        )
        self.assertIs(triggers[0]["attributes"]["flag"], True)
        self.assertEqual(
            [(t["kind"], t["label"], t["attributes"]) for t in triggers[1:]],
            [
                ("start", "s", {"why": "rain"}),
                ("stop", "s", {}),
            ],
        )

    def test_an_attribute_of_another_type_is_named(self) -> None:
        for boxes, name in (
            ("[1, 2]", "list"),
            ("numpy.zeros(2)", "ndarray"),
            ("numpy.zeros(0)", "ndarray"),
        ):
            message = self.fault(
                f"import numpy\ndef on_event(ctx, event): ctx.event('e', 1, boxes={boxes})"
            )
            self.assertTrue(
                message.endswith(
                    f"TypeError: attribute `boxes` of `e` is of type `{name}`; "
                    "give bool, int, float or str"
                ),
                message,
            )

    def test_triggers_are_refused_outside_of_a_wake(self) -> None:
        source = """
            import gleaner

            refusals = []

            class Lambda:
                def __init__(self, ctx):
                    for call in (
                        lambda: ctx.event("e", 1.0),
                        lambda: ctx.start("s"),
                        lambda: ctx.stop("s"),
                    ):
                        try:
                            call()
                        except gleaner.TriggerError as error:
                            refusals.append(error.kind)
                            assert str(error).startswith("triggers belong to a wake"), error

                def on_event(self, ctx, event):
                    ctx.event(" ".join(refusals), 1.0)
                    raise RuntimeError("create a fresh instance in the next wake")
        """
        self.fault(source)
        labels = [
            [trigger["label"] for trigger in decision["triggers"]] for decision in self.decisions()
        ]
        self.assertEqual(
            labels,
            [["invalid invalid invalid"], ["invalid invalid invalid invalid invalid invalid"]],
        )


class Ticks(Hosted):
    SOURCE = (
        "class Lambda:\n    def __init__(self, ctx): pass\n"
        "    def on_tick(self, ctx): ctx.event('t', ctx.missed)"
    )

    def test_the_clock_wakes_up_to_the_last_instant(self) -> None:
        decisions = self.replay(self.SOURCE, [GREY] * 4, wakes=3, schedule='period = "100ms"')
        self.assertEqual({decision["cause"] for decision in decisions}, {"tick"})
        self.assertEqual([decision["triggers"][0]["score"] for decision in decisions], [0.0] * 3)

    def test_the_next_tick_counts_those_of_a_long_gap_as_missed(self) -> None:
        decisions = self.replay(
            self.SOURCE,
            [GREY] * 3,
            wakes=4,
            schedule='period = "1ms"',
            at_ms=[1_000, 200_000, 200_003],
        )
        # The missed ticks are those at 1,001 ms to 199,999 ms.
        self.assertEqual(
            [decision["triggers"][0]["score"] for decision in decisions], [198_999.0, 0.0, 0.0, 0.0]
        )


class Faults(Hosted):
    def test_a_fault_has_a_traceback_and_is_followed_by_a_fresh_instance(self) -> None:
        source = """
            made = []

            class Lambda:
                def __init__(self, ctx):
                    self.wakes = 0
                    made.append(1)

                def on_event(self, ctx, event):
                    self.wakes += 1
                    ctx.event("seen", self.wakes * 10 + len(made))
                    raise RuntimeError("no")
        """
        message = self.fault(source, wake=1)
        self.assertEqual(
            message,
            "Traceback (most recent call last):\n"
            f'  File "{self.folder}/build/main.py", line 12, in on_event\n'
            '    raise RuntimeError("no")\nRuntimeError: no',
        )
        scores = [decision["triggers"][0]["score"] for decision in self.decisions()]
        self.assertEqual(scores, [11, 12], "a fresh instance, and the module unchanged")

    def test_an_exit_of_the_process_is_a_fault(self) -> None:
        self.assertTrue(
            self.fault("import sys\ndef on_event(ctx, event): sys.exit(3)").endswith(
                "SystemExit: 3"
            )
        )
        self.assertTrue(
            self.fault("def on_event(ctx, event): raise KeyboardInterrupt").endswith(
                "KeyboardInterrupt"
            )
        )

    def test_a_long_message_keeps_its_end(self) -> None:
        message = self.fault(
            "def on_event(ctx, event): raise RuntimeError('é' * 9000 + ' at last')"
        )
        self.assertTrue(message.endswith("é at last"))
        self.assertIn(len(message.encode()), (4095, 4096))

    def test_an_error_before_the_first_wake_ends_the_replay(self) -> None:
        for source, cause in {
            "raise RuntimeError('no')": "in import: Traceback",
            "def init(ctx): raise RuntimeError('no')\n"
            "def on_event(ctx, event): pass": "in init: Traceback",
            "def on_tick(ctx): pass": "in import: `main.py` has no `on_event(ctx, event)`",
        }.items():
            ended = self.start(source, [GREY])
            self.assertEqual(ended.returncode, 6, ended.stderr)
            self.assertIn(f"error: cannot start lambda `probe`\n  cause: {cause}", ended.stderr)

    def test_a_panic_of_the_host_is_a_fault_and_the_replay_continues(self) -> None:
        # Without this module, the bindings of numpy panic at their first use.
        source = """
            import sys

            def on_event(ctx, event):
                sys.modules["numpy._core.multiarray"] = sys.modules["numpy.core.multiarray"] = None
                event.as_frame().array()
        """
        message = self.fault(source, wake=1)
        self.assertIn(
            "line 6, in on_event\n    event.as_frame().array()\npyo3_runtime.PanicException: ",
            message,
        )
        self.assertEqual([line for line in self.log() if not line[1].startswith("gleaner: ")], [])

    def test_a_running_thread_does_not_keep_the_process(self) -> None:
        source = """
            import threading
            threading.Thread(target=threading.Event().wait).start()
            def on_event(ctx, event): pass
        """
        self.replay(source, [GREY])


class Starting(Hosted):
    def refusal(self, *arguments: str, home_folder: Path = home.SDK) -> str:
        command = [sys.executable, "-I", str(home_folder / "start.py"), *arguments]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=60)
        self.assertEqual(ended.returncode, 2, ended.stderr)
        return ended.stderr

    def test_another_version_of_the_package_is_refused(self) -> None:
        package = self.folder / "gleaner"
        package.mkdir()
        os.symlink(home.SDK / "start.py", self.folder / "start.py")
        (package / "__init__.py").write_text('__version__ = "9.9.9"')
        (package / "_host.py").write_text("")
        message = self.refusal(self.extension, home_folder=self.folder)
        self.assertIn(
            f"  cause: the package gleaner has version 9.9.9, and {self.extension} has "
            f"{gleaner.__version__}\n  help:  ",
            message,
        )

    def test_an_extension_that_cannot_be_loaded_is_refused(self) -> None:
        message = self.refusal(str(self.folder / "lib_gleaner.so"))
        self.assertIn("lib_gleaner.so: cannot open shared object file", message)
        self.assertIn("help:", message)

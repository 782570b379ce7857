"""Tests pictures of 16 bits and long messages with `gleaner.testing.replay`. Needs no host; values
and errors are those of the host."""

from __future__ import annotations

import io
import unittest
from typing import Any, List

import home  # noqa: F401
import numpy as np
from PIL import Image
from test_replay_arrays import Above, encoded, manifest

from gleaner import Context, DataError, Sample
from gleaner.testing import replay

DEPTH = np.array([[0, 1, 255, 256], [1000, 2308, 40000, 65535]], np.uint16)


class Pictures(unittest.TestCase):
    def test_depth_keeps_its_16_bits_or_is_refused_by_name(self) -> None:
        file = io.BytesIO()
        found: List[str] = []
        Image.fromarray(DEPTH).save(file, "PNG")
        png, jpeg = file.getvalue(), encoded("JPEG", (20, 10), "L")
        after, colour = bytes(12) + png, png[:25] + b"\2" + png[26:]
        cases = [
            ("16UC1; png compressed ", png, ""),
            ("png", png, ""),
            ("16UC1; compressedDepth", after, ""),
            ("16UC1; compressedDepth png", after, ""),
            ("32FC1; compressedDepth png", after, "32FC1 has 32 bits per value, and the PNG has"),
            ("16UC1; jpeg compressed ", jpeg, "16UC1 has 16 bits per value, and the JPEG has 8"),
            ("compressedDepth", after, "name the encoding, as in `16UC1; compressedDepth png`"),
            ("bayer_rggb8; png compressed ", jpeg, "debayer first, for example by image_proc"),
            ("h264", b"\0\0\0\1", "its 4 bytes start with [00, 00, 00, 01]; publish JPEG or PNG"),
            ("png", colour, "PNG is of 16 bits per value with colour or alpha"),
        ]

        class Lambda(Above):
            def on_event(self, ctx: Context, event: Sample) -> None:
                try:
                    frame = event.as_frame()
                    assert frame.info.encoding == "mono16"
                    assert frame.array().tolist() == DEPTH.tolist()
                    assert frame.to_gray().array().tolist() == (DEPTH >> 8).tolist()
                    frame.resize(2, 1)
                except DataError as error:
                    found.append(f"{error.kind}: {error}")

        given = {"format": [case[0] for case in cases], "data": [case[1] for case in cases]}
        inputs = [{"name": "imu", "topic": "/depth", "type": "sensor_msgs/msg/CompressedImage"}]
        declared, arrays = manifest(input=inputs), {"/depth": {"t": range(len(cases)), **given}}
        self.assertEqual(replay(Lambda, arrays, manifest=declared).faults, [])
        self.assertEqual(len(found), len(cases))
        for (_, _, why), error in zip(cases, found):
            self.assertIn(why or "resize of mono16 would keep 8 of its 16 bits", error)
            self.assertIn("not-a-frame: a sample of `/depth` is not a readable image: ", error)

    def test_a_message_beyond_the_limit_of_one_call_is_read_in_pieces_or_refused(self) -> None:
        pixels = np.arange(700 * 600 * 3, dtype=np.uint32).astype(np.uint8)
        read: List[bytes] = []

        class Lambda(Above):
            def on_event(self, ctx: Context, event: Sample) -> None:
                frame = event.as_frame()
                calls: Any = ((event.cdr, event.size), (frame.read, frame.info.size))
                for call, size in calls:
                    read.append(b"".join(call(at, 1 << 20) for at in range(0, size, 1 << 20)))
                    assert call(size - 5) == read[-1][-5:] and call(size, 9) == b""
                    for asked in ((), (0, size)):
                        try:
                            raise AssertionError(call(*asked))
                        except DataError as error:
                            assert error.kind == "out-of-range", error
                            assert "returns at most 1048576: read it in pieces" in str(error), error

        inputs = [{"name": "imu", "topic": "/camera", "type": "sensor_msgs/msg/Image"}]
        given = {"t": [0], "image": [pixels.reshape(600, 700, 3)]}
        run = replay(Lambda, {"/camera": given}, manifest=manifest(input=inputs))
        self.assertEqual(run.faults, [])
        self.assertEqual(read[1], pixels.tobytes())
        self.assertTrue(read[0].endswith(read[1]))

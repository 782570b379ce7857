"""Calls every function of the interface and reports the results. Its twin must get the same."""

from __future__ import annotations

from typing import Any, Callable

import numpy as np
from gleaner import Context, Error, InferenceError, Model, Preprocess, Roi, Sample, Tensor


class Lambda:
    def __init__(self, ctx: Context) -> None:
        config = dict(ctx.config)
        self.every: int = config.pop("every")
        expected = {"number": 1.5, "count": 3, "yes": True, "word": "probe"}
        if config != expected or ctx.inputs() != ["camera", "imu"]:
            raise ValueError(f"unexpected {ctx.config}")
        self.camera, self.imu = ctx.input("camera"), ctx.input("imu")
        self.forward = self.imu.field("linear_acceleration.x")
        self.covariance = self.imu.field("orientation_covariance")
        self.frame_id = self.imu.field("header.frame_id")
        self.stamp = self.imu.field("header.stamp.nanosec")
        self.data = self.camera.field("data")

    def on_event(self, ctx: Context, sample: Sample) -> None:
        # Hashing is slow in Python, so only some images are used.
        if sample.identity.seq % self.every != 0:
            return
        self.topics(ctx)
        self.samples(ctx, sample)
        self.frames(ctx, sample)
        self.tensors(ctx, sample)
        self.refusals(ctx, sample)
        ctx.log("info", f"{self.forward.path} {ctx.now_ns()}")
        ctx.start("recording", why="probing")
        ctx.stop("recording")

    def topics(self, ctx: Context) -> None:
        counts = self.imu.counts()
        newest = self.newest()
        since = newest.stamps.at_ns - 50_000_000
        last, later = self.imu.column(self.forward, 5), self.imu.column_since(self.forward, since)
        ctx.event(
            "topic",
            newest.number(self.forward),
            names=" ".join([self.imu.name, self.imu.ros_topic, self.imu.type_name]),
            received=counts.received,
            overwritten=counts.overwritten,
            refused=counts.no_slot + counts.too_big + counts.skipped,
            lost=counts.lost is not None,
            last=float(last.values[0]),
            last_at=int(last.at_ns[0]),
            since=len(later.values),
            samples=sum(sample.identity.seq for sample in self.imu.last(7)),
            samples_since=len(self.imu.since(since)),
        )

    def samples(self, ctx: Context, sample: Sample) -> None:
        identity, stamps, imu = sample.identity, sample.stamps, self.newest()
        ctx.event(
            "sample",
            float(sample.size),
            topic=identity.topic,
            writer=str(identity.writer),
            seq=identity.seq,
            at=stamps.at_ns,
            published=stamps.publish_ns,
            header=-1 if stamps.header_ns is None else stamps.header_ns,
            big_endian=sample.big_endian,
            cdr=fnv1a(sample.cdr(10, 100)),
            end=len(sample.cdr(sample.size - 1, 100)),
            covariance=float(imu.get(self.covariance)[0]),  # type: ignore[index]
            frame_id=str(imu.get(self.frame_id)),
            nanosec=int(imu.number(self.stamp)),
            data=fnv1a(bytes(sample.get(self.data))),  # type: ignore[arg-type]
        )

    def frames(self, ctx: Context, sample: Sample) -> None:
        frame = sample.as_frame()
        info = frame.info
        corner = Roi(10, 20, 33, 44)
        small, gray = frame.resize(60, 40), frame.to_gray()
        read = np.frombuffer(frame.read(1000, 5000), np.uint8)
        assert np.array_equal(frame.array().ravel()[1000:6000], read)
        ctx.event(
            "frame",
            frame.mean_luma(),
            width=info.width,
            height=info.height,
            step=info.step,
            size=info.size,
            encoding=info.encoding,
            big_endian=info.big_endian,
            seq=frame.identity.seq,
            at=frame.stamps.at_ns,
            corner=frame.mean_luma(corner),
            histogram=fnv1a(np.asarray(frame.histogram(corner), "<u4").tobytes()),
            read=fnv1a(frame.read(1000, 5000)),
            small=fnv1a(small.array().tobytes()),
            gray=fnv1a(gray.array().tobytes()),
        )

    def tensors(self, ctx: Context, sample: Sample) -> None:
        tensor = Tensor.create("int16", [2, 3])
        tensor.write(3, bytes([1, 2, 3, 4, 5]))
        assert np.array_equal(tensor.array(), np.frombuffer(tensor.read(), "<i2").reshape(2, 3))
        values = Tensor.from_values(np.array([[0.5], [-1.0], [2.0]], np.float32))
        how = Preprocess(32, 24, placement="corner", bgr=True, mean=(0.5, 0.25, 0.0))
        try:
            pixels = fnv1a(Tensor.from_frame(sample.as_frame(), how).read())
        except InferenceError:  # A fake host does not convert frames.
            pixels = -1
        ctx.event(
            "tensor",
            float(values.array().sum()),
            element=tensor.element,
            shape=str(tensor.shape),
            size=tensor.size,
            read=fnv1a(tensor.read(2, 9)),
            end=len(tensor.read(11, 9)),
            values=fnv1a(values.read()),
            pixels=pixels,
        )

    def refusals(self, ctx: Context, sample: Sample) -> None:
        frame = sample.as_frame()
        tensor = Tensor.create("uint8", [4])
        ctx.event(
            "refusals",
            0.0,
            input=kind(lambda: ctx.input("nothing")),
            field=kind(lambda: self.imu.field("nothing")),
            other=kind(lambda: self.camera.column(self.forward, 1)),
            text=kind(lambda: self.imu.column(self.frame_id, 1)),
            image=kind(lambda: self.newest().as_frame()),
            outside=kind(lambda: frame.mean_luma(Roi(9999, 0, 1, 1))),
            size=kind(lambda: frame.resize(0, 1)),
            room=kind(lambda: frame.resize(16_384, 16_384)),
            label=kind(lambda: ctx.event("", 0.0)),
            score=kind(lambda: ctx.event("x", float("inf"))),
            model=kind(lambda: Model.open("nothing")),
            empty=kind(lambda: Tensor.create("boolean", [2, 0])),
            write=kind(lambda: tensor.write(1, bytes(4))),
            tensor=kind(lambda: Tensor.from_frame(frame, Preprocess(0, 8))),
        )

    def newest(self) -> Sample:
        sample = self.imu.newest()
        assert sample is not None
        return sample


def kind(call: Callable[[], Any]) -> str:
    """Returns the kind of the refusal; `none` for a result."""
    try:
        call()
    except Error as error:
        return str(error.kind)
    return "none"


def fnv1a(data: bytes) -> int:
    value = 0x811C9DC5
    for byte in data:
        value = (value ^ byte) * 0x01000193 & 0xFFFFFFFF
    return value

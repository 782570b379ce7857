"""Samples, fields and frames: interface ``data`` of the WIT package, and the data types of
``types``.

The objects of the host implement the protocols here; plain values are named tuples. A property is
constant and needs no call of the host; a method calls the host.

A handle keeps its sample in memory until the handle is dropped: a held sample cannot be
overwritten. If a lambda holds too many, a replay refuses new samples, which ``Counts.no_slot``
counts, and a live wake ends in a fault.

The maximum numbers of bytes (1 MiB) and values (65,536) below are the defaults of ``call_bytes``
and ``call_items`` in ``[limits]``. The manifest and the vehicle can lower them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, List, Literal, NamedTuple, Optional, Protocol, Tuple, Union

from .error import Error

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

Value = Union[bool, int, float, str, bytes, "npt.NDArray[np.float64]", List[str]]
"""Value of one field of a message. Arrays of numbers are float64, at most 65,536; arrays of strings
are lists, at most 4,096; ``uint8[]`` and ``byte[]`` are bytes, like a string at most 1 MiB. A
longer value is refused, never truncated."""

Encoding = Literal[
    "rgb8",
    "bgr8",
    "rgba8",
    "bgra8",
    "mono8",
    "mono16",
    "yuv422",
    "yuv422_yuy2",
    "bayer_rggb8",
    "bayer_bggr8",
    "bayer_gbrg8",
    "bayer_grbg8",
    "bayer_rggb16",
    "bayer_bggr16",
    "bayer_gbrg16",
    "bayer_grbg16",
]
"""Pixel layout of a frame, named as in ROS ``sensor_msgs/image_encodings``. ``yuv422`` is U Y V Y,
``yuv422_yuy2`` is Y U Y V, two bytes per pixel. Bayer patterns are raw: the host does not convert
their colours."""

DataErrorKind = Literal[
    "no-such-input",
    "no-such-field",
    "wrong-field",
    "malformed",
    "not-a-frame",
    "no-room",
    "out-of-range",
]


class DataError(Error):
    """An error in reading data. The message names the object, the cause and the way out.

    ``no-such-input``: the manifest has no ``[[input]]`` of that name. ``no-such-field``: the
    message type has no such field, or the path names a whole message. ``wrong-field``: the field is
    not a number, is too long, or belongs to another topic. ``malformed``: the bytes of the sample
    contradict its type. ``not-a-frame``: the sample is not an image, or an image that the host
    cannot read. ``no-room``: the image exceeds ``decoded_size`` of the input, all slots for decoded
    images are held, or the frames of the lambda reach ``memory`` or ``frames`` in ``[limits]``.
    ``out-of-range``: a region or size is out of range.
    """

    kind: DataErrorKind


class Guid(NamedTuple):
    """GUID of the DDS writer that sent a sample: 16 bytes, as two big-endian halves. In replay it
    is derived from the file and the channel, and is the same in every replay."""

    high: int
    low: int

    def __str__(self) -> str:
        """Returns 32 hexadecimal digits, as in ``decisions.jsonl``."""
        return f"{self.high:016x}{self.low:016x}"


class Identity(NamedTuple):
    """Unique identity of a sample."""

    topic: str
    """Name of the ROS topic in the manifest (before ``--remap``), such as ``/imu/data``."""
    writer: Guid
    seq: int
    """Sequence number, strictly increasing for each writer; a gap means lost samples."""


class Stamps(NamedTuple):
    """Timestamps of a sample in nanoseconds, on three clocks. The clocks may differ, so compare
    only stamps of the same clock."""

    at_ns: int
    """Time of reception since 1970 (UTC), on the vehicle's clock, which never goes back; in replay,
    the log time. Samples, wakes and clips are ordered by this clock."""
    publish_ns: int
    """Time of publication, on the writer's clock."""
    header_ns: Optional[int]
    """``header.stamp`` of the message; None unless its type begins with a ``std_msgs/msg/Header``
    or a time ``stamp``."""


class Counts(NamedTuple):
    """Numbers of received and lost samples of one topic since the lambda's process started."""

    received: int
    """Samples that entered the ring."""
    lost: Optional[int]
    """Samples that were lost before they reached this process; None if the transport cannot count
    them."""
    overwritten: int
    """Samples that newer ones replaced in the ring."""
    no_slot: int
    """Samples that the ring refused because the lambda held every cell."""
    too_big: int
    """Samples that the ring refused because they exceed ``max_size`` of the input."""
    skipped: int
    """Samples that should have woken the lambda and did not: it was busy, or newer samples had
    replaced them."""


class Column(NamedTuple):
    """Values of one field in the newest samples, oldest first. Both arrays have the shape (n,)."""

    at_ns: npt.NDArray[np.int64]
    """``Stamps.at_ns`` of each sample."""
    values: npt.NDArray[np.float64]
    """Value of the field in each sample; true is 1."""


class FrameInfo(NamedTuple):
    """Size and pixel layout of a frame."""

    width: int
    """Width in pixels, 1 to 65,535."""
    height: int
    """Height in pixels, 1 to 65,535."""
    encoding: Encoding
    step: int
    """Bytes from the start of one row to the next; at least ``width`` times the bytes per pixel."""
    big_endian: bool
    """Byte order of 16-bit encodings: true if the high byte comes first."""
    size: int
    """Bytes of pixel data: ``step * (height - 1)`` plus the bytes of the last row."""


class Roi(NamedTuple):
    """Region of interest in pixels, from the upper left corner of the frame. It is clipped to the
    frame, and refused if no pixel is left."""

    x: int
    y: int
    width: int
    height: int


class Data(Protocol):
    """The functions of the interface ``data``; part of :class:`gleaner.Context`."""

    def input(self, name: str) -> Topic:
        """Returns the input ``name`` of the manifest.

        Raises DataError: ``no-such-input``, which lists the inputs."""

    def inputs(self) -> list[str]:
        """Returns the names of all inputs, in the order of the manifest."""

    def now_ns(self) -> int:
        """Returns the time of the current wake in nanoseconds: ``at_ns`` of its sample or tick. In
        replay it is the recorded time; in the first ``init`` it is 0."""


class Topic(Protocol):
    """The ring of one ``[[input]]``: its newest samples, at most ``depth``.

    Methods with a parameter ``field`` accept a path, too: it is compiled at its first use and then
    cached.
    """

    @property
    def name(self) -> str:
        """Name of the input in the manifest."""

    @property
    def ros_topic(self) -> str:
        """Name of the ROS topic, such as ``/imu/data``."""

    @property
    def type_name(self) -> str:
        """ROS message type, such as ``sensor_msgs/msg/Imu``."""

    def newest(self) -> Sample | None:
        """Returns the newest sample; None before the first one."""

    def last(self, n: int) -> list[Sample]:
        """Returns the ``n`` newest samples, oldest first; fewer if the ring holds fewer. ``n`` is
        clamped to 256."""

    def since(self, since_ns: int) -> list[Sample]:
        """Returns the samples with ``at_ns`` later than ``since_ns``, oldest first; at most the
        newest 256."""

    def counts(self) -> Counts:
        """Returns the numbers of received and lost samples of this topic since the lambda's process
        started."""

    def field(self, path: str) -> Field:
        """Compiles the path of a field, such as ``linear_acceleration.x``, ``cov[3]`` or
        ``fields[2].name``. Do this once, in ``__init__``: compiling takes microseconds.

        Raises DataError: ``no-such-field``, which lists the existing fields and the most similar
        one; ``wrong-field`` for a path of more than 1,024 bytes."""

    def column(self, field: Field | str, n: int) -> Column:
        """Returns the values of ``field`` in the ``n`` newest samples, oldest first. ``n`` is
        clamped to 65,536.

        Raises DataError: ``wrong-field`` if the field is not a number or belongs to another topic;
        ``malformed``."""

    def column_since(self, field: Field | str, since_ns: int) -> Column:
        """Returns the values of ``field`` in all samples of the ring with ``at_ns`` later than
        ``since_ns``, oldest first; at most the newest 65,536.

        Raises as :meth:`column`."""


class Field(Protocol):
    """A compiled path into the messages of one topic."""

    @property
    def path(self) -> str:
        """The path, as it was compiled."""


class Sample(Protocol):
    """One message."""

    @property
    def identity(self) -> Identity:
        """Unique identity of the sample: topic, writer and sequence number."""

    @property
    def stamps(self) -> Stamps:
        """Timestamps of the sample, on three clocks."""

    def get(self, field: Field | str) -> Value:
        """Returns the value of a field, of any type.

        Raises DataError: ``wrong-field`` if the field belongs to another topic or exceeds the
        length that one call can return (see ``Value``; read such a field in pieces with ``cdr``);
        ``malformed``."""

    def number(self, field: Field | str) -> float:
        """Returns the value of a numeric or boolean field, as a 64-bit float; true is 1.

        Raises DataError: ``wrong-field`` if the field is not a number or belongs to another topic;
        ``malformed``."""

    @property
    def size(self) -> int:
        """Size of the message in bytes, without the CDR encapsulation header."""

    @property
    def big_endian(self) -> bool:
        """True if the message is big-endian CDR."""

    def cdr(self, offset: int = 0, len: int | None = None) -> bytes:
        """Returns raw CDR bytes without the encapsulation header: ``len`` from ``offset``, or all
        from there; fewer only where the message ends.

        Raises DataError: ``out-of-range`` for more than 1 MiB; read a longer message in pieces,
        such as ``[cdr(at, 1 << 20) for at in range(0, size, 1 << 20)]``."""

    def as_frame(self) -> Frame:
        """Returns the message as an image. The type must be ``sensor_msgs/msg/Image`` or
        ``sensor_msgs/msg/CompressedImage``. This call decodes a JPEG or PNG to rgb8, and a grey PNG
        of 16 bits (also ``16UC1; compressedDepth``) to mono16, once for each sample.

        Raises DataError: ``not-a-frame``, also for formats that are not decoded or contradict the
        bytes, such as ``32FC1``, ``h264``, RVL and PNG of 16 bits with colour; ``no-room`` if the
        decoded image exceeds ``decoded_size``, all slots for decoded images are held, or the lambda
        holds as many frames as ``frames`` in ``[limits]`` allows; ``malformed``."""


class Frame(Protocol):
    """A sample as an image. ``numpy.asarray`` and ``torch.from_dlpack`` accept it without a copy.

    The pixels are read-only. DLPack can express that since version 1.0, and numpy supports it since
    2.1; older versions raise an exception.
    """

    @property
    def info(self) -> FrameInfo:
        """Size and pixel layout of the frame."""

    @property
    def identity(self) -> Identity:
        """Identity of the sample that the frame comes from, also after ``resize`` and
        ``to_gray``."""

    @property
    def stamps(self) -> Stamps:
        """Timestamps of the sample that the frame comes from."""

    def mean_luma(self, roi: Roi | tuple[int, int, int, int] | None = None) -> float:
        """Returns the mean luma (ITU-R BT.601), 0 to 255, of the whole frame or of ``roi``. It is
        computed with integers, so it is the same on every CPU.

        Raises DataError: ``out-of-range`` if ``roi`` has no pixel in the frame; ``not-a-frame`` for
        Bayer encodings."""

    def histogram(
        self, roi: Roi | tuple[int, int, int, int] | None = None
    ) -> npt.NDArray[np.uint32]:
        """Returns the number of pixels at each of the 256 luma levels. Luma is rounded down; that
        of a 16-bit pixel is its high byte.

        Raises as :meth:`mean_luma`."""

    def resize(self, width: int, height: int) -> Frame:
        """Creates a frame of ``width`` by ``height`` pixels, each side 1 to 16,384. Its encoding is
        rgb8, or mono8 if this frame is of mono8. A new pixel is the mean of the area that it covers
        where the frame shrinks, and a linear interpolation where it grows.

        Raises DataError: ``out-of-range``; ``no-room`` if the frames that the lambda created would
        together exceed ``memory`` in ``[limits]``, or the lambda holds as many frames as ``frames``
        allows; ``not-a-frame`` for Bayer encodings, and for mono16, whose values would lose 8
        bits."""

    def to_gray(self) -> Frame:
        """Creates a mono8 frame of the same size. Luma is rounded down; that of a 16-bit pixel is
        its high byte.

        Raises DataError: ``no-room``, as :meth:`resize`; ``not-a-frame`` for Bayer encodings."""

    def read(self, offset: int = 0, len: int | None = None) -> bytes:
        """Returns a copy of pixel bytes: ``len`` from ``offset``, or all from there; fewer only
        where the frame ends. :meth:`array` needs no copy, and has no limit.

        Raises DataError: ``out-of-range`` for more than 1 MiB."""

    def array(self) -> npt.NDArray[Any]:
        """Returns the pixels as a read-only array, without a copy, whatever their size.

        Shape (height, width, 3) or (height, width, 4) for colour; (height, width) for grey and
        Bayer; (height, width, 2) for yuv422, with U or V before Y, and for yuy2, with U or V after
        Y. The type is uint8, or uint16 in the byte order of the frame. The slot of the image is
        held until the last view of the array is dropped, so copy pixels that are kept for long."""

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """Returns the array of :meth:`array`, for ``numpy.asarray``."""

    def __dlpack__(self, **options: Any) -> Any:
        """Returns the array of :meth:`array`, for ``from_dlpack`` of numpy and torch."""

    def __dlpack_device__(self) -> tuple[int, int]:
        """Returns the device of the pixels: the CPU, (1, 0)."""

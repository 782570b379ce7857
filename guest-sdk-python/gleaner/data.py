"""Samples, fields and frames: interface ``data`` of the WIT package, and the plain values of ``types``.

The host hands out objects that behave as the protocols here say; plain values are made from the named tuples. What is a
property never changes and costs nothing; what is a method asks the host.

A sample that a lambda holds cannot be overwritten, and a lambda that holds too many makes the ring refuse new ones
(``Counts.no_slot``): let go of what is not needed.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, List, Literal, NamedTuple, Optional, Protocol, Tuple, Union

from .error import Error

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

Value = Union[bool, int, float, str, bytes, "npt.NDArray[np.float64]", List[str]]
"""One field of a message. Arrays of numbers are float64, ``uint8[]`` and ``byte[]`` are bytes; one call hands out at most
65,536 numbers, 4,096 strings or 1 MiB."""

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
"""Pixel layout, named as in ROS ``sensor_msgs/image_encodings``. ``yuv422`` is U Y V Y, ``yuv422_yuy2`` is Y U Y V. The
Bayer patterns are raw: the host neither reads nor converts their colours."""

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
    """A read of data that failed.

    ``no-such-input``: no ``[[input]]`` of that name. ``no-such-field``: the type has no such field, or it is not a value.
    ``wrong-field``: it is no number, or of another topic. ``malformed``: the sample's bytes contradict its type.
    ``not-a-frame``: no image, or one that the host cannot read. ``no-room``: the image is larger than the input's
    ``decoded_size``, or every slot is held. ``out-of-range``: a region or size that does not fit.
    """

    kind: DataErrorKind


class Guid(NamedTuple):
    """Who sent a sample: the 16 bytes of a DDS writer GUID, as two big-endian halves. In replay it is made from the file
    and the channel, and stays the same in every replay."""

    high: int
    low: int

    def __str__(self) -> str:
        """32 hexadecimal digits, as in ``decisions.jsonl``."""
        return f"{self.high:016x}{self.low:016x}"


class Identity(NamedTuple):
    """What makes a sample different from every other one."""

    topic: str
    """ROS topic as the manifest gives it (before ``--remap``), such as ``/imu/data``."""
    writer: Guid
    seq: int
    """Rises strictly for each writer; gaps are samples that were lost on the way."""


class Stamps(NamedTuple):
    """When a sample came to be, in nanoseconds. The three clocks may differ: compare like with like."""

    at_ns: int
    """When the vehicle received it: the clock that orders samples, wakes and clips. In replay: the log time."""
    publish_ns: int
    """When the writer published it, by the writer's clock."""
    header_ns: Optional[int]
    """``header.stamp``, where the type starts with a ``std_msgs/msg/Header``."""


class Counts(NamedTuple):
    """What became of the samples of one topic since the lambda started."""

    received: int
    """Entered the ring."""
    lost: Optional[int]
    """Known to be lost before they reached this process; None where the transport cannot know."""
    overwritten: int
    """Left the ring to make room for newer ones."""
    no_slot: int
    """Refused because every cell was held."""
    too_big: int
    """Refused because they exceed the input's ``max_size``."""
    skipped: int
    """Should have woken the lambda and did not, because it was busy or the ring moved on."""


class Column(NamedTuple):
    """Newest values of one field, oldest first; both arrays have the shape (n,)."""

    at_ns: npt.NDArray[np.int64]
    """``Stamps.at_ns`` of each sample."""
    values: npt.NDArray[np.float64]


class FrameInfo(NamedTuple):
    """Shape of a frame."""

    width: int
    """Pixels, 1 to 65,535."""
    height: int
    """Pixels, 1 to 65,535."""
    encoding: Encoding
    step: int
    """Bytes from one row to the next; at least ``width`` times the bytes of a pixel."""
    big_endian: bool
    """Byte order of the 16-bit encodings."""
    size: int
    """Bytes of pixel data: ``step * (height - 1)`` plus the last row."""


class Roi(NamedTuple):
    """Region of interest in pixels, not empty. What lies outside the frame is left out; all of it must not."""

    x: int
    y: int
    width: int
    height: int


class Data(Protocol):
    """Part of :class:`gleaner.Context`."""

    def input(self, name: str) -> Topic:
        """The ``[[input]]`` of that name.

        Raises DataError (``no-such-input``), which lists those of the manifest."""

    def inputs(self) -> list[str]:
        """Names of all inputs, in the manifest's order."""

    def now_ns(self) -> int:
        """Time of this wake in nanoseconds: ``at_ns`` of the sample or the tick. Virtual in replay."""


class Topic(Protocol):
    """The ring of one ``[[input]]``: its newest samples, ``depth`` at most.

    Where a field is asked for, its path does as well: it is compiled at its first use and remembered.
    """

    @property
    def name(self) -> str:
        """The input's ``name``."""

    @property
    def ros_topic(self) -> str:
        """The ROS topic, such as ``/imu/data``."""

    @property
    def type_name(self) -> str:
        """The ROS type, such as ``sensor_msgs/msg/Imu``."""

    def newest(self) -> Sample | None:
        """Newest sample; None before the first."""

    def last(self, n: int) -> list[Sample]:
        """The ``n`` newest samples, oldest first; fewer if the ring holds fewer. ``n`` is clamped to 256."""

    def since(self, since_ns: int) -> list[Sample]:
        """Samples with ``at_ns`` later than ``since_ns``, oldest first; the newest 256 at most."""

    def counts(self) -> Counts:
        """What became of the samples."""

    def field(self, path: str) -> Field:
        """Compiles the path of a field, such as ``linear_acceleration.x``, ``cov[3]``, ``fields[2].name``.

        Raises DataError (``no-such-field``), which names the nearest field that exists: do this in ``__init__``."""

    def column(self, field: Field | str, n: int) -> Column:
        """``field`` of the ``n`` newest samples. ``n`` is clamped to 65,536.

        Raises DataError: ``wrong-field`` if it is no number or of another topic; ``malformed``."""

    def column_since(self, field: Field | str, since_ns: int) -> Column:
        """``field`` of all samples in the ring with ``at_ns`` later than ``since_ns``.

        Raises as :meth:`column`."""


class Field(Protocol):
    """A compiled path into the messages of one topic."""

    @property
    def path(self) -> str:
        """The path as it was written."""


class Sample(Protocol):
    """One message."""

    @property
    def identity(self) -> Identity:
        """What makes it different from every other one."""

    @property
    def stamps(self) -> Stamps:
        """When it came to be."""

    def get(self, field: Field | str) -> Value:
        """Any field.

        Raises DataError: ``wrong-field`` if it is of another topic or longer than one call hands out; ``malformed``."""

    def number(self, field: Field | str) -> float:
        """A numeric or boolean field.

        Raises DataError: ``wrong-field`` if it is no number or of another topic; ``malformed``."""

    @property
    def size(self) -> int:
        """Size of the message in bytes, without the CDR encapsulation header."""

    @property
    def big_endian(self) -> bool:
        """Whether the message is big-endian CDR."""

    def cdr(self, offset: int = 0, len: int | None = None) -> bytes:
        """Raw CDR bytes from ``offset``, ``len`` at most; clamped to the message and to 1 MiB."""

    def as_frame(self) -> Frame:
        """The message as an image: ``sensor_msgs/msg/Image``, or ``sensor_msgs/msg/CompressedImage`` in JPEG or PNG, which
        is decoded to rgb8 now, once for each sample.

        Raises DataError: ``not-a-frame``; ``no-room``."""


class Frame(Protocol):
    """A sample seen as an image. Also an argument of ``numpy.asarray`` and ``torch.from_dlpack``, without a copy.

    DLPack says that an array is read-only since its version 1.0, which numpy has since 2.1; older ones refuse.
    """

    @property
    def info(self) -> FrameInfo:
        """Its shape."""

    @property
    def identity(self) -> Identity:
        """Identity of the sample behind it."""

    @property
    def stamps(self) -> Stamps:
        """Stamps of the sample behind it."""

    def mean_luma(self, roi: Roi | tuple[int, int, int, int] | None = None) -> float:
        """Mean luma (ITU-R BT.601), 0 to 255, of the frame or of ``roi``. Computed in integers, so equal on every CPU.

        Raises DataError: ``out-of-range``; ``not-a-frame`` for Bayer encodings."""

    def histogram(
        self, roi: Roi | tuple[int, int, int, int] | None = None
    ) -> npt.NDArray[np.uint32]:
        """256 counts of the pixels' luma.

        Raises as :meth:`mean_luma`."""

    def resize(self, width: int, height: int) -> Frame:
        """A new frame of that many pixels, rgb8, or mono8 for grey encodings. Each side 1 to 16,384.

        Raises DataError: ``out-of-range``; ``no-room``; ``not-a-frame`` for Bayer encodings."""

    def to_gray(self) -> Frame:
        """A new mono8 frame of the same size.

        Raises DataError: ``no-room``; ``not-a-frame`` for Bayer encodings."""

    def read(self, offset: int = 0, len: int | None = None) -> bytes:
        """A copy of the pixel bytes from ``offset``, ``len`` at most; clamped to the frame and to 1 MiB."""

    def array(self) -> npt.NDArray[Any]:
        """The pixels themselves, read-only: no copy is made, whatever their size.

        Shape (height, width, 3) or (height, width, 4) for colour, (height, width) for grey and Bayer, (height, width, 2)
        for yuv422, which has U or V before Y, or after it for yuy2. uint8, or uint16 in the frame's own byte order. The
        slot is held until the last view of the array is gone: copy what is kept for longer."""

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        """What ``numpy.asarray`` calls."""

    def __dlpack__(self, **options: Any) -> Any:
        """What ``from_dlpack`` of numpy and torch calls."""

    def __dlpack_device__(self) -> tuple[int, int]:
        """The CPU: (1, 0)."""

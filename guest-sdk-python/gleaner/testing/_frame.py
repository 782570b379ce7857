"""A sample as an image. Raw pixels are not copied; Pillow decodes JPEG and PNG, once for each
sample and up to `decoded_size`."""

from __future__ import annotations

import io
import warnings
import weakref
from typing import Any, Callable, List, Mapping, Optional, Tuple, TypeVar

import numpy as np
import numpy.typing as npt

from ..data import DataError, FrameInfo, Identity, Roi, Stamps
from . import _pixels
from ._manifest import COMPRESSED_IMAGE, MIB, Input
from ._pixels import LAYOUTS, ImageError, Picture, RangeError
from ._ring import Lease
from ._session import piece, u32

About = Tuple[Identity, Stamps]
T = TypeVar("T")


_WAY_OUT = "drop frames and tensors that are not needed, or raise"


def no_memory(size: int, left: int) -> str:
    """Text for a frame or tensor of ``size`` bytes, while ``left`` are left."""
    why = f"a new frame or tensor needs {size} bytes, and {left} are left"
    return f"{why}; {_WAY_OUT} `memory` in [limits]"


class Budget:
    """Limits the number of frames and tensors that a lambda holds, and the bytes of those that it
    created."""

    def __init__(self, limits: Mapping[str, int]) -> None:
        self.frames_allowed = self.frames = limits["frames"]
        self.bytes = limits["memory"]
        self.call_bytes = limits["call_bytes"]

    def take(self, size: int) -> Reservation:
        """Takes one frame and ``size`` bytes. Raises DataError (``no-room``)."""
        if self.frames == 0:
            why = f"the lambda holds {self.frames_allowed} frames and tensors"
            raise DataError(f"{why}; {_WAY_OUT} `frames` in [limits]", "no-room")
        if size > self.bytes:
            raise DataError(no_memory(size, self.bytes), "no-room")
        return Reservation(self, size)


class Reservation:
    """A share of the budget, released when neither a frame nor an array over its pixels refers to
    it."""

    def __init__(self, budget: Budget, size: int) -> None:
        self.budget, self._size = budget, size
        budget.frames -= 1
        budget.bytes -= size

    def __del__(self) -> None:
        self.budget.frames += 1
        self.budget.bytes += self._size


class DecodedImage:
    """The pixels of a JPEG or PNG, in one slot of the input."""

    def __init__(self, shown: Picture) -> None:
        self.picture = shown


class FramePool:
    """Decoded images of one input, up to the number of its slots."""

    def __init__(self, declared: Input, budget: Budget) -> None:
        self._slots, self._slot_bytes = declared.hold + 1, declared.decoded_size
        self.budget = budget
        self._held: List[weakref.ref[DecodedImage]] = []
        self._newest: Optional[Tuple[int, DecodedImage]] = None

    def frame(
        self, declared: Input, message: Callable[[], Any], lease: Lease, about: About
    ) -> Frame:
        """Creates the frame of a message. Raises DataError."""
        if declared.type_name not in ("sensor_msgs/msg/Image", COMPRESSED_IMAGE):
            raise DataError(
                f"a sample of `{declared.topic}` is not an image: its type is "
                f"`{declared.type_name}`",
                "not-a-frame",
            )
        given = message()
        taken = self.budget.take(0)
        try:
            if declared.type_name == COMPRESSED_IMAGE:
                decoded = self._decoded(declared, lease.cell.position, given)
                return Frame(about, decoded.picture, taken, decoded)
            data = np.asarray(given.data, dtype=np.uint8)
            size = int(given.width), int(given.height)
            raw = _pixels.picture(
                *size, str(given.encoding), int(given.step), bool(given.is_bigendian), data
            )
            return Frame(about, raw, taken, lease)
        except ImageError as error:
            raise _not_a_frame(declared.topic, error) from None

    def _decoded(self, declared: Input, position: int, given: Any) -> DecodedImage:
        if self._newest is not None and self._newest[0] == position:
            return self._newest[1]
        # Release the previous image first: its slot may be needed now.
        self._newest = None
        data = np.asarray(given.data).tobytes()
        file, encoding = _pixels.compressed(str(given.format), data)
        opened = _open(declared, file)
        width, height = opened.size
        if 3 * width * height > self._slot_bytes:
            says = f"image has a size of {width}x{height} ({_size(3 * width * height)} as rgb8)"
            raise _too_large(
                declared, f"{says}; this input's decoded_size is {_size(self._slot_bytes)}"
            )
        self._held = [held for held in self._held if held() is not None]
        if len(self._held) >= self._slots:
            why = f"drop frames that are not needed, or raise `hold` of input `{declared.name}`"
            raise DataError(
                f"every slot for decoded images of `{declared.topic}` is held; {why}", "no-room"
            )
        decoded = DecodedImage(_picture(opened, encoding))
        self._held.append(weakref.ref(decoded))
        self._newest = (position, decoded)
        return decoded


def _open(declared: Input, data: bytes) -> Any:
    """Reads the header. Raises ImageError; DataError for a size that Pillow treats as an attack."""
    from PIL import Image

    try:
        with warnings.catch_warnings():
            # Images that Pillow only warns of are limited by `decoded_size`.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            opened = Image.open(io.BytesIO(data), formats=["JPEG", "PNG"])
    except Image.DecompressionBombError as error:
        raise _too_large(declared, str(error)) from None
    except Exception as error:
        raise ImageError(str(error)) from None
    if opened.mode == "CMYK":
        raise ImageError("JPEG with four colour channels is not supported")
    return opened


def _too_large(declared: Input, why: str) -> DataError:
    return DataError(f"an image of `{declared.topic}` is too large: {why}", "no-room")


def _picture(opened: Any, encoding: str) -> Picture:
    try:
        if encoding == "mono16":
            values = np.asarray(opened).astype("<u2")
            return _pixels.tight(values.view(np.uint8).reshape(*values.shape, 2), encoding)
        return _pixels.tight(np.asarray(opened.convert("RGB")), encoding)
    except Exception as error:
        raise ImageError(
            f"cannot decode the {opened.format} of {opened.width}x{opened.height}: {error}"
        ) from None


def requested(whole: bytes, offset: int, length: Optional[int], most: int, kind: str) -> bytes:
    """Returns ``length`` bytes from ``offset``, or fewer where ``whole`` ends. Raises DataError
    (``out-of-range``) for more than ``most``."""
    found = piece(whole, offset, None if length is None else u32(length), 2**32 - 1)
    if len(found) > most:
        raise DataError(
            f"{len(found)} bytes of a {kind} are requested; one call returns at most {most}: read "
            "it in pieces, by `offset` and `len`",
            "out-of-range",
        )
    return found


def _size(count: int) -> str:
    return f"{count} bytes" if count < MIB else f"{count / MIB:.1f} MiB"


def _not_a_frame(topic: str, error: ImageError) -> DataError:
    return DataError(f"a sample of `{topic}` is not a readable image: {error}", "not-a-frame")


class View:
    """The object from which numpy creates an array. It keeps the memory of the pixels while a view
    of them exists."""

    def __init__(self, shown: Picture, holds: Tuple[Any, ...]) -> None:
        pixel, channels = LAYOUTS[shown.encoding]
        item = pixel // channels
        shape: Tuple[int, ...] = (shown.height, shown.width, channels)
        strides: Tuple[int, ...] = (shown.step, pixel, item)
        if channels == 1:
            shape, strides = shape[:2], strides[:2]
        self._holds = (*holds, shown.data)
        self.__array_interface__ = {
            "version": 3,
            "shape": shape,
            "strides": strides,
            "typestr": "|u1" if item == 1 else ">u2" if shown.big_endian else "<u2",
            "data": (shown.data.__array_interface__["data"][0], True),
        }


class Frame:
    """A sample as an image. The frame keeps its pixels in memory."""

    def __init__(self, about: About, shown: Picture, taken: Reservation, holds: Any) -> None:
        self._about, self._picture, self._taken, self._holds = about, shown, taken, holds

    @property
    def info(self) -> FrameInfo:
        width, height, encoding, step, big_endian, data = self._picture
        size = len(data)
        return FrameInfo(width, height, encoding, step, big_endian, size)  # type: ignore[arg-type]

    @property
    def identity(self) -> Identity:
        return self._about[0]

    @property
    def stamps(self) -> Stamps:
        return self._about[1]

    def mean_luma(self, roi: Optional[Roi | tuple[int, int, int, int]] = None) -> float:
        return self._call(lambda: _pixels.mean_luma(self._picture, _roi(roi)))

    def histogram(
        self, roi: Optional[Roi | tuple[int, int, int, int]] = None
    ) -> npt.NDArray[np.uint32]:
        return self._call(lambda: _pixels.histogram(self._picture, _roi(roi)))

    def resize(self, width: int, height: int) -> Frame:
        width, height = u32(width), u32(height)
        size = width * height * (1 if self._picture.is_grey else 3)
        if self._picture.encoding == "mono16":
            way_out = "call `to_gray` first, or read its pixels"
            error = ImageError(f"resize of mono16 would keep 8 of its 16 bits: {way_out}")
            raise _not_a_frame(self.identity.topic, error)
        return self._made(
            "resize", (width, height), size, lambda: _pixels.resize(self._picture, width, height)
        )

    def to_gray(self) -> Frame:
        shown = self._picture
        return self._made(
            "grey image", None, shown.width * shown.height, lambda: _pixels.to_gray(shown)
        )

    def read(self, offset: int = 0, len: Optional[int] = None) -> bytes:
        most, kind = self._taken.budget.call_bytes, f"frame of `{self.identity.topic}`"
        return requested(self._picture.data.tobytes(), offset, len, most, kind)

    def array(self) -> npt.NDArray[Any]:
        return np.asarray(View(self._picture, (self._holds, self._taken)))

    def __array__(self, *arguments: Any, **named: Any) -> npt.NDArray[Any]:
        return self.array().__array__(*arguments, **named)

    def __dlpack__(self, **options: Any) -> Any:
        return self.array().__dlpack__(**options)

    def __dlpack_device__(self) -> Tuple[int, int]:
        return 1, 0

    def _call(self, operation: Callable[[], T]) -> T:
        try:
            return operation()
        except RangeError as error:
            raise DataError(str(error), "out-of-range") from None
        except ImageError as error:
            raise _not_a_frame(self.identity.topic, error) from None

    def _made(
        self,
        operation: str,
        size: Optional[Tuple[int, int]],
        needed: int,
        make: Callable[[], Picture],
    ) -> Frame:
        def made() -> Frame:
            # Check the arguments first, then take memory from the budget, then create the pixels.
            _pixels.check(self._picture, operation, size)
            taken = self._taken.budget.take(needed)
            return Frame(self._about, make(), taken, None)

        return self._call(made)

    def __repr__(self) -> str:
        shown = self._picture
        return f"<Frame {self.identity.topic}, {shown.width}x{shown.height} {shown.encoding}>"


def _roi(roi: Optional[Roi | tuple[int, int, int, int]]) -> Optional[Tuple[int, int, int, int]]:
    if roi is None:
        return None
    x, y, width, height = (u32(number) for number in roi)
    return x, y, width, height

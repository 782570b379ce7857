"""Implements the host's operations on frames in numpy, with integers only, so that results equal
those of the host bit for bit.

Sources: ITU-R BT.601 for luma; JFIF 1.02 for colours of yuv422, both as in `pixels` of the crate
`gleaner-rules`; formats of compressed images as in the crate `gleaner-image`."""

from __future__ import annotations

import re
from typing import Any, NamedTuple, Optional, Tuple

import numpy as np
import numpy.typing as npt

Bytes = npt.NDArray[np.uint8]

MAX_SIDE, MAX_RESIZED_SIDE = 65_535, 16_384
PNG = b"\x89PNG\r\n\x1a\n"

# Bytes per pixel and numbers per pixel, by the name in the WIT.
LAYOUTS = {
    "rgb8": (3, 3),
    "bgr8": (3, 3),
    "rgba8": (4, 4),
    "bgra8": (4, 4),
    "mono8": (1, 1),
    "mono16": (2, 1),
    "yuv422": (2, 2),
    "yuv422_yuy2": (2, 2),
    **{f"bayer_{pattern}8": (1, 1) for pattern in ("rggb", "bggr", "gbrg", "grbg")},
    **{f"bayer_{pattern}16": (2, 1) for pattern in ("rggb", "bggr", "gbrg", "grbg")},
}
# Current names in ROS that differ from those in the WIT.
IN_ROS = {"yuv422": "uyvy", "yuv422_yuy2": "yuyv"}
# Other names in ROS.
NAMES = {
    "8UC3": "bgr8",
    "8UC1": "mono8",
    "16UC1": "mono16",
    "uyvy": "yuv422",
    "yuyv": "yuv422_yuy2",
}
# Indices of red, green and blue in a pixel.
COLOURS = {"rgb8": (0, 1, 2), "bgr8": (2, 1, 0), "rgba8": (0, 1, 2), "bgra8": (2, 1, 0)}
# Indices of U, the left Y, V and the right Y in a pair of pixels.
PAIRS = {"yuv422": (0, 1, 2, 3), "yuv422_yuy2": (1, 0, 3, 2)}


class ImageError(Exception):
    """An image is inconsistent, or has raw Bayer pixels."""


class RangeError(Exception):
    """A region or a size is out of range."""


class Picture(NamedTuple):
    """Pixels with a validated size: `data` has `step` bytes for each row except the last, which may
    be shorter."""

    width: int
    height: int
    encoding: str
    step: int
    big_endian: bool
    data: Bytes

    @property
    def is_grey(self) -> bool:
        return self.encoding in ("mono8", "mono16")


def picture(
    width: int, height: int, encoding: str, step: int, big_endian: bool, data: Bytes
) -> Picture:
    """Creates a picture from the fields of a `sensor_msgs/msg/Image`. Raises ImageError with the
    numbers that do not fit."""
    name = NAMES.get(encoding, encoding)
    if name not in LAYOUTS:
        raise ImageError(
            f"encoding `{encoding[:40]}` is not supported; supported are "
            f"{', '.join([*LAYOUTS, *NAMES])}"
        )
    ros_name = IN_ROS.get(name, name)
    for side in (width, height):
        if not 1 <= side <= MAX_SIDE:
            raise ImageError(f"image size is {width}x{height}; each side must be 1 to {MAX_SIDE}")
    if name in PAIRS and width % 2:
        raise ImageError(
            f"image of {ros_name} is {width} pixels wide; two pixels share a colour, so the width "
            "must be even"
        )
    row = width * LAYOUTS[name][0]
    if step < row:
        raise ImageError(
            f"image of {width}x{height} {ros_name} has a step of {step} bytes; a row needs {row}"
        )
    needed = step * (height - 1) + row
    if len(data) < needed:
        raise ImageError(
            f"image of {width}x{height} {ros_name} with {step} bytes per row needs {needed} bytes; "
            f"it has {len(data)}"
        )
    return Picture(width, height, name, step, big_endian, data[:needed])


def compressed(format: str, data: bytes) -> Tuple[bytes, str]:
    """Returns the file in a `sensor_msgs/msg/CompressedImage`, and the encoding of its pixels, rgb8
    or mono16. Raises ImageError for a format that is not decoded, or contradicts the bytes."""
    words, why = re.split("[; ]", format), ""
    is_depth = "compressedDepth" in words
    file = data[12:] if is_depth and data[12:].startswith(PNG) else data
    kind, found = ("PNG" if file.startswith(PNG) else "JPEG"), "8"
    if kind == "PNG" and file[24:25] == b"\x10":
        found = "16"
        if file[25:26] != b"\0":
            why = "PNG is of 16 bits per value with colour or alpha, which is not supported"
            raise ImageError(f"{why}: publish baseline JPEG, or PNG of 8 bits")
    sizes = ("8", "16", "32", "64")
    named = [(word, n) for word in words for n in re.findall("[0-9]+", word) if n in sizes]
    if not file.startswith((b"\xff\xd8\xff", PNG)):
        start = ", ".join(f"{byte:02x}" for byte in file[:8])
        why = f"data is neither JPEG nor PNG: its {len(file)} bytes start with [{start}]; "
        why += "publish JPEG or PNG, depth as `16UC1; compressedDepth png`"
    elif is_depth and not named:
        why = "name the encoding, as in `16UC1; compressedDepth png`"
    elif named and named[-1][0].startswith("bayer_"):
        why = "raw pixels have no colour: debayer first, for example by image_proc"
    elif named and named[-1][1] != found:
        name, bits = named[-1]
        why = (
            f"{name} has {bits} bits per value, and the {kind} has {found}: publish depth as 16UC1 "
            "in PNG, others with 8 bits, and name what is sent"
        )
    if why:
        raise ImageError(f"format `{format[:64]}`: {why}")
    return file, "mono16" if found == "16" else "rgb8"


def rows(shown: Picture) -> Bytes:
    """Returns all pixels without a copy, of shape (height, width, bytes per pixel)."""
    pixel = LAYOUTS[shown.encoding][0]
    shape, strides = (shown.height, shown.width, pixel), (shown.step, pixel, 1)
    return np.lib.stride_tricks.as_strided(shown.data, shape, strides, writeable=False)


def region(shown: Picture, roi: Optional[Tuple[int, int, int, int]]) -> Bytes:
    """Returns the pixels of a region, or all. Raises RangeError if the region has no pixel in the
    image."""
    if roi is None:
        return rows(shown)
    x, y, width, height = roi
    if x >= shown.width or y >= shown.height or width == 0 or height == 0:
        raise RangeError(
            f"region {width}x{height} at ({x}, {y}) has no pixel in the image of "
            f"{shown.width}x{shown.height}"
        )
    return rows(shown)[y : y + height, x : x + width]


def check(shown: Picture, operation: str, size: Optional[Tuple[int, int]] = None) -> None:
    """Raises ImageError for raw Bayer pixels, and RangeError for an unsupported size."""
    if shown.encoding.startswith("bayer"):
        why = "its pixels have no colour until it is debayered"
        raise ImageError(f"{operation} of a raw image ({shown.encoding}): {why}")
    if size is not None and not all(1 <= side <= MAX_RESIZED_SIDE for side in size):
        raise RangeError(
            f"resize to {size[0]}x{size[1]}: each side must be 1 to {MAX_RESIZED_SIDE}"
        )


def mean_luma(shown: Picture, roi: Optional[Tuple[int, int, int, int]]) -> float:
    check(shown, "mean luma")
    pixels = region(shown, roi)
    sums = [int(total) for total in pixels.sum(axis=(0, 1), dtype=np.uint64)]
    if shown.encoding in COLOURS:
        red, green, blue = (sums[at] for at in COLOURS[shown.encoding])
        total, scale = 299 * red + 587 * green + 114 * blue, 1000
    elif shown.encoding == "mono16":
        high = 0 if shown.big_endian else 1
        total, scale = 256 * sums[high] + sums[1 - high], 257
    else:
        total, scale = sums[PAIRS[shown.encoding][1] if shown.encoding in PAIRS else 0], 1
    return float(total) / float(scale * pixels.shape[0] * pixels.shape[1])


def grey(shown: Picture, pixels: Bytes) -> Bytes:
    """Returns the grey level of each pixel, of shape (height, width)."""
    if shown.encoding in COLOURS:
        red, green, blue = (pixels[..., at].astype(np.uint32) for at in COLOURS[shown.encoding])
        return ((299 * red + 587 * green + 114 * blue) // 1000).astype(np.uint8)
    if shown.encoding == "mono16":
        return pixels[..., 0 if shown.big_endian else 1]
    return pixels[..., PAIRS[shown.encoding][1] if shown.encoding in PAIRS else 0]


def histogram(shown: Picture, roi: Optional[Tuple[int, int, int, int]]) -> npt.NDArray[np.uint32]:
    check(shown, "histogram")
    levels = grey(shown, region(shown, roi))
    return np.bincount(levels.ravel(), minlength=256).astype(np.uint32)


def to_gray(shown: Picture) -> Picture:
    return tight(grey(shown, rows(shown)), "mono8")


def tight(pixels: Bytes, encoding: str) -> Picture:
    """Returns a picture without padding, from an array of shape (height, width) or (height, width,
    3)."""
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels, dtype=np.uint8).reshape(-1)
    return Picture(width, height, encoding, width * LAYOUTS[encoding][0], False, data)


def colours(shown: Picture) -> Bytes:
    """Returns red, green and blue of each pixel, of shape (height, width, 3)."""
    pixels = rows(shown)
    if shown.encoding in COLOURS:
        return pixels[..., COLOURS[shown.encoding]]
    pairs = pixels.reshape(shown.height, shown.width // 2, 4).astype(np.int32)
    at_u, at_left, at_v, at_right = PAIRS[shown.encoding]
    u, v = pairs[..., at_u] - 128, pairs[..., at_v] - 128
    both = [_from_yuv(pairs[..., at], u, v) for at in (at_left, at_right)]
    return np.stack(both, axis=2).reshape(shown.height, shown.width, 3)


def _from_yuv(y: Any, u: Any, v: Any) -> Bytes:
    """Converts to RGB, with factors in 1/65536, rounded to nearest."""
    luma = (y << 16) + (1 << 15)
    channels = [luma + 91_881 * v, luma - 22_554 * u - 46_802 * v, luma + 116_130 * u]
    return np.stack([np.clip(channel >> 16, 0, 255) for channel in channels], axis=-1).astype(
        np.uint8
    )


def resize(shown: Picture, width: int, height: int) -> Picture:
    """Scales each axis by itself: the mean of the covered area where the image shrinks, linear
    interpolation where it grows, rounded to nearest."""
    pixels = grey(shown, rows(shown))[..., None] if shown.is_grey else colours(shown)
    down, down_total = _weights(shown.height, height)
    across, across_total = _weights(shown.width, width)
    # Sums stay below 2^40, so matrix products of f64, which numpy computes fast, are exact in any
    # order.
    planes = [
        across @ (down @ pixels[..., channel].astype(np.float64)).T
        for channel in range(pixels.shape[2])
    ]
    sums = np.stack([plane.T for plane in planes], axis=-1).astype(np.int64)
    total = down_total * across_total
    made = ((sums + total // 2) // total).astype(np.uint8)
    return tight(made[..., 0], "mono8") if shown.is_grey else tight(made, "rgb8")


def _weights(old: int, new: int) -> Tuple[npt.NDArray[np.float64], int]:
    """Returns the integer weights of old pixels (columns) in new ones (rows), and the sum of each
    row."""
    at = np.arange(new, dtype=np.int64)
    if new <= old:
        # The axis is divided into old * new pieces; the weight is the number of pieces that both
        # share.
        start, source = at[:, None] * old, np.arange(old, dtype=np.int64)[None, :] * new
        shared = np.minimum(start + old, source + new) - np.maximum(start, source)
        return np.maximum(shared, 0).astype(np.float64), old
    middle = np.maximum((2 * at + 1) * old - new, 0)
    first, past = middle // (2 * new), middle % (2 * new)
    last = np.minimum(first + 1, old - 1)
    weights = np.zeros((new, old))
    weights[at, first] += np.where(last == first, 2 * new, 2 * new - past)
    weights[at, last] += np.where(last == first, 0, past)
    return weights, 2 * new

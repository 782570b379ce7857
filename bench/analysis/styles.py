"""Colour, dashes, marker and hatch of each side: the same in every figure and table."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from typing import Iterable

# Lengths of dashes and gaps, in widths of the line. Each has a hatch for areas.
DASHES: tuple[tuple[float, ...], ...] = (
    (),
    (5, 2),
    (1, 1.4),
    (6, 1.6, 1, 1.6),
    (10, 2.5),
    (6, 1.4, 1, 1.4, 1, 1.4),
    (2.5, 1.4),
    (10, 1.6, 3, 1.6),
)
# Hatches of lines only: dots make files twenty times as large.
HATCHES = ("", "////", "||||", "xxxx", "\\\\\\\\", "----", "++++", "//")

# Families of sides: the beginnings of their names, colours from one hue, and markers. The first
# colours differ in lightness (L* of 28, 54, 65, 42 and 0), so that they differ in grey, too.
FAMILIES: tuple[tuple[tuple[str, ...], tuple[str, ...], str], ...] = (
    (("wasm",), ("#0a428f", "#3f7fd0", "#86b1ec", "#02205a"), "o^<H8spD"),
    (("Python",), ("#d55e00", "#e8963f", "#8a3d00", "#b9742e"), "Dd8p>H<s"),
    (("stand-in",), ("#cf86b8", "#a04a86", "#e3b3d4", "#6d2a59"), "XP>h*v<o"),
    (("rclpy",), ("#007250", "#3fa37f", "#00402c", "#86c9ae"), "vspd>8Ho"),
    (("native", "bare", "memcpy"), ("#000000", "#6e6e6e", "#9a9a9a", "#3c3c3c"), "*h8Po^ds"),
    (
        (),
        ("#7a6a00", "#0091a8", "#a61c3c", "#a89420", "#5b4bb3", "#66c2d1", "#d9667f", "#4d4400"),
        "ph<>vPXd",
    ),
)
OTHERS = len(FAMILIES) - 1

# Variants of a family that are known, so that their style never depends on other names.
VARIANTS = {
    "without checks": 1,
    "SDK kernel": 2,
    "in real time": 3,
    "fuel only": 4,
    "epochs only": 5,
    "memory kept": 1,
    "depth 1": 2,
    "bare reader": 1,
    "memcpy": 2,
}
BASES = ("wasm", "Python", "rclpy", "stand-in (Cyclone DDS for Python)", "native Rust", "native")


@dataclass(frozen=True)
class Style:
    """The look of one side."""

    colour: str
    dashes: tuple[float, ...]
    marker: str
    hatch: str


def _style(family: int, variant: int) -> Style:
    _, colours, markers = FAMILIES[family]
    # Steps of 3 through 8 patterns: neighbours differ clearly, and none repeats in a family.
    dash = (family + 3 * variant) % len(DASHES)
    return Style(colours[variant % len(colours)], DASHES[dash], markers[variant], HATCHES[dash])


def _family(side: str) -> int:
    for index, (beginnings, *_) in enumerate(FAMILIES):
        if any(side.startswith(beginning) for beginning in beginnings):
            return index
    return OTHERS


def styles(names: Iterable[str]) -> dict[str, Style]:
    """The style of each name. A name that is not known takes a further one of its family by its
    checksum, and the next one where two names of `names` would be alike."""
    found: dict[str, Style] = {}
    taken: set[tuple[int, int]] = set()
    unknown: list[tuple[str, int]] = []
    for name in sorted(set(names)):
        side = name[len("lambda, ") :] if name.startswith("lambda, ") else name
        family = _family(side)
        variant = next((number for end, number in VARIANTS.items() if side.endswith(end)), None)
        if side in BASES or side == "native function":
            variant = 0
        if variant is None or family == OTHERS:
            unknown.append((name, family))
        else:
            taken.add((family, variant))
            found[name] = _style(family, variant)
    for name, family in unknown:
        first = zlib.crc32(name.encode()) % len(DASHES)
        order = [(first + step) % len(DASHES) for step in range(len(DASHES))]
        variant = next((one for one in order if (family, one) not in taken), first)
        taken.add((family, variant))
        found[name] = _style(family, variant)
    return found

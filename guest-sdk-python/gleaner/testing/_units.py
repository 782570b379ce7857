"""Parses sizes and durations of `lambda.toml`, such as ``"2 MiB"`` and ``"50ms"``."""

from __future__ import annotations

import re
from fractions import Fraction
from typing import Dict

SIZES: Dict[str, int] = {"": 1, "B": 1, "KiB": 1 << 10, "MiB": 1 << 20, "GiB": 1 << 30}
TIMES: Dict[str, int] = {
    "h": 3_600_000_000_000,
    "min": 60_000_000_000,
    "s": 1_000_000_000,
    "ms": 1_000_000,
    "us": 1_000,
    "ns": 1,
}
SIZE_RULE = 'write a whole number and its unit, B, KiB, MiB or GiB, for example "2 MiB"'
TIME_RULE = 'write a number and its unit, us, ms, s, min or h, for example "50ms" or "1.5s"'

SIZE = re.compile(r"\s*([0-9]{1,19}) ?([A-Za-z]*)\s*", re.ASCII)
TIME = re.compile(r"\s*([0-9]{1,19}(?:\.[0-9]{1,19})?) ?([a-z]+)\s*", re.ASCII)


def size(text: str) -> int:
    """Parses a size into bytes. Raises ValueError with the syntax of a size."""
    found = SIZE.fullmatch(text)
    if found is None or found.group(2) not in SIZES:
        raise ValueError(SIZE_RULE)
    return int(found.group(1)) * SIZES[found.group(2)]


def duration(text: str) -> int:
    """Parses a duration into nanoseconds. Raises ValueError with the syntax of a duration."""
    found = TIME.fullmatch(text)
    if found is None or found.group(2) not in TIMES:
        raise ValueError(TIME_RULE)
    exact = Fraction(found.group(1)) * TIMES[found.group(2)]
    if exact.denominator != 1:
        raise ValueError(TIME_RULE)
    return int(exact)

"""Novelty: an image unlike all kinds of image seen so far, by the distance of brightness
histograms.

At most 16 known histograms are kept, in `scratch`, so that they survive a fault.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from gleaner import Context, Sample

BINS = 32
KNOWN_MAX = 16
NAME = "known"


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.every_ns = int(ctx.config["every_s"] * 1e9)
        self.distance: float = ctx.config["distance"]
        self.next_ns = 0
        kept = any(entry.name == NAME for entry in ctx.scratch.entries())
        # Shape (n, BINS), the most recently seen kind last.
        known = ctx.scratch.get(NAME) if kept else b""
        self.known = np.frombuffer(known, np.float64).reshape(-1, BINS)

    def on_event(self, ctx: Context, event: Sample) -> None:
        # Decoding is expensive, and the scene does not change ten times a second.
        if ctx.now_ns() < self.next_ns:
            return
        self.next_ns = ctx.now_ns() + self.every_ns
        counts = event.as_frame().histogram()
        seen = counts.reshape(BINS, -1).sum(axis=1) / counts.sum()
        distances = hellinger(self.known, seen)
        nearest = int(distances.argmin()) if len(distances) else None
        if nearest is not None and distances[nearest] < self.distance:
            # A known image: move its histogram to the end, since the first one is forgotten first.
            self.known = np.vstack([np.delete(self.known, nearest, axis=0), self.known[nearest]])
            return
        if nearest is not None:
            ctx.event("novelty", float(distances[nearest]), known=len(self.known))
        self.known = np.vstack([self.known, seen])[-KNOWN_MAX:]
        ctx.scratch.put(NAME, self.known.tobytes())


def hellinger(known: Any, seen: Any) -> Any:
    """Returns the Hellinger distance of `seen`, shape (BINS,), to each row of `known`: 0 if equal,
    1 if disjoint."""
    return np.sqrt(np.clip(1.0 - np.sqrt(known * seen).sum(axis=1), 0.0, 1.0))

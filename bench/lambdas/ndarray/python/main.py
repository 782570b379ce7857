"""Measures the time to create an array over a frame, and reports it in ns as a score."""

import timeit

import gleaner

ROUNDS = 10_000


def on_event(ctx: gleaner.Context, sample: gleaner.Sample) -> None:
    frame = sample.as_frame()
    assert frame.array().shape == (1080, 1920, 3)
    seconds = min(timeit.repeat(frame.array, number=ROUNDS, repeat=5)) / ROUNDS
    ctx.event("array", seconds * 1e9)

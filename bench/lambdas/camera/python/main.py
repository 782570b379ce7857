"""Does nothing but view each frame as an array: measures the overhead of the host."""

import gleaner


def on_event(ctx: gleaner.Context, sample: gleaner.Sample) -> None:
    sample.as_frame().array()

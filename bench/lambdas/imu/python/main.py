"""Does nothing: measures the overhead of the host."""

import gleaner


def on_event(ctx: gleaner.Context, sample: gleaner.Sample) -> None:
    pass

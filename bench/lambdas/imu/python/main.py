"""Does nothing: what is left is what hosting costs."""

import gleaner


def on_event(ctx: gleaner.Context, sample: gleaner.Sample) -> None:
    pass

"""Is slower than its camera, or keeps all samples.

The host must not fall behind, and must count all losses."""

import time

import gleaner


class Lambda:
    def __init__(self, ctx: gleaner.Context) -> None:
        self.behaviour = ctx.config["behaviour"]
        self.seconds = float(ctx.config["seconds"])
        self.camera = ctx.input("camera")
        self.kept: list[gleaner.Sample] = []
        # Minimum of the number of received samples minus the number of the newest; lost samples
        # have a number, too.
        self.least: int | None = None

    def on_event(self, ctx: gleaner.Context, sample: gleaner.Sample) -> None:
        ahead = self.camera.counts().received - sample.identity.seq
        self.least = ahead if self.least is None else min(self.least, ahead)
        # One may arrive between selection and check.
        if ahead - self.least > 1:
            ctx.event("stale", float(ahead))
        if self.behaviour == "sleep":
            time.sleep(self.seconds)
        elif self.behaviour == "keep":
            self.kept.append(sample)
        else:
            raise ValueError(f"unknown behaviour `{self.behaviour}`")

"""Objects in front of the car: an event for each camera frame and class that a detector finds."""

from __future__ import annotations

from gleaner import Context, Model, Sample


class Lambda:
    def __init__(self, ctx: Context) -> None:
        self.classes = [name.strip() for name in ctx.config["classes"].split(",")]
        self.min_score: float = ctx.config["min_score"]
        self.detector = Model.open("detector")

    def on_event(self, ctx: Context, event: Sample) -> None:
        # The pixels stay in the host: highest score first.
        found = self.detector.detect(
            event.as_frame(), classes=self.classes, min_score=self.min_score
        )
        seen = set()
        for best in found:
            if best.class_ in seen:
                continue
            seen.add(best.class_)
            count = sum(other.class_ == best.class_ for other in found)
            ctx.event(
                best.label,
                best.score,
                count=count,
                x=best.x,
                y=best.y,
                width=best.width,
                height=best.height,
            )

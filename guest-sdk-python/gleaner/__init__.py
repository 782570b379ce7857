"""Gleaner's SDK for lambdas in Python.

A lambda is a class, or plain functions, in the file that ``entry`` of its ``lambda.toml`` names::

    from gleaner import Context, Sample

    class Lambda:
        def __init__(self, ctx: Context) -> None:
            self.limit: float = ctx.config["limit"]

        def on_event(self, ctx: Context, event: Sample) -> None:    # [schedule] event = "imu"
            if event.number("linear_acceleration.x") < self.limit:
                ctx.event("hard-brake", 1.0)

        # or, with [schedule] period = "100ms":  def on_tick(self, ctx: Context) -> None

    # without a class:  def on_event(ctx, event)  or  def on_tick(ctx),
    # and optionally  def init(ctx)

An exception that leaves a handler is a fault of that wake. Before the next wake the host creates a
fresh instance of the class, or calls ``init`` again; the globals of the module keep their values.

The classes here describe the objects that the host passes to a lambda; a lambda itself creates a
``Model`` or ``Tensor``. Importing them needs no host, so a lambda can be type-checked locally, and
run locally with `gleaner.testing`. The names are those of the WIT package ``gleaner:lambda``, with
``_`` in place of ``-``.
"""

from .context import Context
from .data import (
    Column,
    Counts,
    DataError,
    Encoding,
    Field,
    Frame,
    FrameInfo,
    Guid,
    Identity,
    Roi,
    Sample,
    Stamps,
    Topic,
    Value,
)
from .error import DeadlineExceeded, Error
from .inference import (
    Detection,
    DetectOptions,
    ElementType,
    InferenceError,
    Model,
    Placement,
    Preprocess,
    Tensor,
    TensorInfo,
)
from .log import Level
from .scratch import Entry, Scratch, ScratchError
from .trigger import AttributeValue, TriggerError

__version__ = "0.1.0"

__all__ = [
    "AttributeValue",
    "Column",
    "Context",
    "Counts",
    "DataError",
    "DetectOptions",
    "Detection",
    "Encoding",
    "DeadlineExceeded",
    "ElementType",
    "Entry",
    "Error",
    "Field",
    "Frame",
    "FrameInfo",
    "Guid",
    "Identity",
    "InferenceError",
    "Level",
    "Model",
    "Placement",
    "Preprocess",
    "Roi",
    "Sample",
    "Scratch",
    "ScratchError",
    "Stamps",
    "Tensor",
    "TensorInfo",
    "Topic",
    "TriggerError",
    "Value",
]

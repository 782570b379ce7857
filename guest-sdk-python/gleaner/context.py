"""What a lambda is given at each call."""

from __future__ import annotations

from typing import Any, Mapping, Protocol

from .data import Data
from .log import Log
from .scratch import Scratch
from .trigger import Trigger


class Context(Data, Trigger, Log, Protocol):
    """The functions of the interfaces ``data``, ``trigger`` and ``log``, and the lambda's configuration.

    One thread runs a lambda; its own threads may use the context, too, but a trigger belongs to the wake in which it
    is made.
    """

    @property
    def config(self) -> Mapping[str, Any]:
        """``[config]`` by key: bool, int, float or str, as the manifest's default has it. The deployment's values lie over
        the manifest's."""

    @property
    def scratch(self) -> Scratch:
        """What the host keeps for the lambda, by name, beyond its faults."""

    @property
    def missed(self) -> int:
        """Ticks that were due since the previous wake and did not happen; 0 where samples wake the lambda."""

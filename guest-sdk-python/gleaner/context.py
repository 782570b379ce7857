"""The context that a lambda gets at each call."""

from __future__ import annotations

from typing import Any, Mapping, Protocol

from .data import Data
from .log import Log
from .scratch import Scratch
from .trigger import Trigger


class Context(Data, Trigger, Log, Protocol):
    """The functions of the interfaces ``data``, ``trigger`` and ``log``, and the configuration.

    A lambda runs in one thread. Threads that it starts may use the context, too, but a trigger
    belongs to the wake in which it is called.
    """

    @property
    def config(self) -> Mapping[str, Any]:
        """Values of ``[config]`` by key: those that the deployment sets, or else the defaults in
        the manifest. Each value has the type of its default: bool, int, float or str."""

    @property
    def scratch(self) -> Scratch:
        """Named byte strings that the host keeps for the lambda, also across its faults."""

    @property
    def missed(self) -> int:
        """Number of ticks that were due since the previous wake and did not run; 0 if samples wake
        the lambda."""

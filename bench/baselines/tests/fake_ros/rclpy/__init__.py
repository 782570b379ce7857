"""A fake rclpy: its executor delivers three IMU messages, its publisher prints."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any, Callable

MESSAGES = [
    SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=number, nanosec=5)))
    for number in range(3)
]


class Publisher:
    def publish(self, answer: Any) -> None:
        stamp, time = answer.header.stamp, answer.time_ref
        time_ns = time.sec * 10**9 + time.nanosec
        values = {"stamp": [stamp.sec, stamp.nanosec], "source": answer.source, "time_ns": time_ns}
        print(json.dumps(values), flush=True)


class Node:
    def __init__(self) -> None:
        self.callbacks: list[Callable[[Any], None]] = []

    def create_publisher(self, kind: Any, topic: str, qos: Any) -> Publisher:
        return Publisher()

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[[Any], None], qos: Any
    ) -> None:
        self.callbacks.append(callback)

    def destroy_node(self) -> None:
        pass


def init(*, args: Any = None, signal_handler_options: Any = None) -> None:
    pass


def create_node(name: str) -> Node:
    return Node()


def try_shutdown() -> None:
    pass

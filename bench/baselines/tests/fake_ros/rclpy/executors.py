from typing import Any

from . import MESSAGES


class SingleThreadedExecutor:
    def add_node(self, node: Any) -> None:
        self.node = node

    def spin_until_future_complete(self, future: Any) -> None:
        for message in MESSAGES:
            for callback in self.node.callbacks:
                callback(message)
        future.done.wait()

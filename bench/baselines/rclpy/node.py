"""The baseline on ROS 2: a node as its author would write it with rclpy.

It runs where rclpy can be imported; elsewhere it prints `skipped` and ends with exit code 3."""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path
from typing import Any, Callable, Optional

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "lib"))

import program  # noqa: E402

try:
    import rclpy
    import workloads
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.task import Future
    from rclpy.utilities import get_rmw_implementation_identifier
    from sensor_msgs.msg import Image, Imu, TimeReference
except ImportError as error:
    program.skip(error)


class Node:
    """A node of ROS 2 in an executor of one thread."""

    def __init__(self, options: Any, workload: Any, tally: program.Tally) -> None:
        # `program` handles the signals.
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        distribution = os.environ.get("ROS_DISTRO", "of unknown distribution")
        self.stack = f"rclpy, ROS 2 {distribution}, {get_rmw_implementation_identifier()}"
        self.tally = tally
        self.stopped = Future()
        self.node = rclpy.create_node("gleaner_baseline")
        qos = QoSProfile(
            history=HistoryPolicy.KEEP_LAST,
            depth=options.depth,
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.VOLATILE,
        )
        self.publisher = self.node.create_publisher(TimeReference, options.answers, qos)
        imu = self.answering(workload.on_imu)
        self.node.create_subscription(Imu, options.input, imu, qos)
        if options.image is not None:
            image = self.answering(workload.on_image)
            self.node.create_subscription(Image, options.image, image, qos)
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)

    def answering(
        self, decide: Callable[[Any], Optional[workloads.Labels]]
    ) -> Callable[[Any], None]:
        """Returns the callback of a topic, which answers the messages that wake the workload."""

        def callback(message: Any) -> None:
            labels = decide(message)
            if labels is None:
                return
            self.tally.received += 1
            answer = TimeReference()
            answer.header.stamp = message.header.stamp
            answer.source = self.tally.source(labels)
            answer.time_ref.sec, answer.time_ref.nanosec = divmod(time.monotonic_ns(), 10**9)
            self.publisher.publish(answer)
            self.tally.answered += 1

        return callback

    def spin(self) -> None:
        # The same steps as those of `spin`, which another thread cannot end in every version.
        self.executor.spin_until_future_complete(self.stopped)

    def stop(self) -> None:
        self.stopped.set_result(None)

    def lost(self) -> Optional[int]:
        # An event for lost messages would be one more entity in every wait.
        return None

    def close(self) -> None:
        self.node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    program.run(workloads, Node, ("rclpy", "sensor_msgs", "numpy", "opencv-python", "onnxruntime"))

"""A stand-in for an rclpy node where there is no ROS 2: the same work on `cyclonedds` from PyPI.

It reads each message into Python objects and answers it, in one thread that waits for readers."""

from __future__ import annotations

import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any, List, Optional, Tuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "lib"))

import program  # noqa: E402

try:
    from cyclonedds.core import (
        DDSException,
        GuardCondition,
        InstanceState,
        Policy,
        Qos,
        ReadCondition,
        SampleState,
        ViewState,
        WaitSet,
    )
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from cyclonedds.util import duration
    from messages import Header, Image, Imu, Time, TimeReference, use_bytes

    import workloads
except ImportError as error:
    program.skip(error)


class Node:
    """One thread that waits for the readers of the inputs."""

    stack = f"cyclonedds {version('cyclonedds')} for Python (stand-in, not ROS 2)"

    def __init__(self, options: Any, workload: Any, tally: program.Tally) -> None:
        self.tally = tally
        self.depth = options.depth
        self.participant = DomainParticipant()
        # As of a publisher and a subscription of ROS 2 with this depth.
        self.qos = Qos(
            Policy.Reliability.Reliable(duration(milliseconds=100)),
            Policy.Durability.Volatile,
            Policy.History.KeepLast(options.depth),
        )
        self.writer = DataWriter(
            self.participant, self._topic(options.answers, TimeReference), qos=self.qos
        )
        self.readers: List[Tuple[DataReader, Any]] = []
        self.waitset = WaitSet(self.participant)
        self.stopped = GuardCondition(self.participant)
        self.waitset.attach(self.stopped)
        self._read(options.input, Imu, workload.on_imu)
        if options.image is not None:
            self._read(options.image, Image, workload.on_image)

    def _topic(self, name: str, message: Any) -> Topic:
        return Topic(self.participant, "rt" + name, message)

    def _read(self, name: str, message: Any, decide: Any) -> None:
        reader = DataReader(self.participant, self._topic(name, message), qos=self.qos)
        state = ViewState.Any | InstanceState.Any | SampleState.NotRead
        self.waitset.attach(ReadCondition(reader, state))
        self.readers.append((reader, decide))

    def spin(self) -> None:
        """Answers messages until `stop`."""
        forever = duration(infinite=True)
        while not self.stopped.read():
            self.waitset.wait(forever)
            for reader, decide in self.readers:
                for message in reader.take(N=self.depth):
                    # The end of a writer is a sample without a message.
                    if message.sample_info.valid_data:
                        self.receive(message, decide(message))

    def receive(self, message: Any, labels: Optional[workloads.Labels]) -> None:
        """Answers a message that woke the workload."""
        if labels is None:
            return
        self.tally.received += 1
        answer = TimeReference(
            Header(message.header.stamp, ""), Time(0, 0), self.tally.source(labels)
        )
        answer.time_ref.sec, answer.time_ref.nanosec = divmod(time.monotonic_ns(), 10**9)
        self.writer.write(answer)
        self.tally.answered += 1

    def stop(self) -> None:
        self.stopped.set(True)

    def lost(self) -> Optional[int]:
        return sum(reader.get_sample_lost_status().total_count for reader, _ in self.readers)

    def close(self) -> None:
        # The participant leaves when it is deleted, with the process.
        pass


if __name__ == "__main__":
    use_bytes(Image, "data")
    packages = ("cyclonedds", "numpy", "opencv-python-headless", "opencv-python", "onnxruntime")
    program.run(workloads, Node, packages, (DDSException,))

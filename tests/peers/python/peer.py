"""A peer on Cyclone DDS in Python: writes or reads one topic of Imu, and prints events as JSON.

    peer.py pub|sub Imu TOPIC [--count N] [--rate HZ] [--depth N] [--readers N]
            [--reliability reliable|best_effort] [--durability volatile|transient_local]

`pub` waits for N readers (1), writes N messages (0: without end) and stays; `sub` reads. Both end
with their standard input.
"""

import argparse
import json
import select
import struct
import sys
import time
import zlib
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, float64, int32, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

REALS = 37


@dataclass
@final
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
@final
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@dataclass
@final
class Quaternion(IdlStruct, typename="geometry_msgs.msg.dds_.Quaternion_"):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
@final
class Vector3(IdlStruct, typename="geometry_msgs.msg.dds_.Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
@final
class Imu(IdlStruct, typename="sensor_msgs.msg.dds_.Imu_"):
    header: Header
    orientation: Quaternion
    orientation_covariance: array[float64, 9]
    angular_velocity: Vector3
    angular_velocity_covariance: array[float64, 9]
    linear_acceleration: Vector3
    linear_acceleration_covariance: array[float64, 9]


def content(n: int) -> Imu:
    """Message `n`; its content follows from its number, see tests/src/peers/message.rs."""
    reals = [100.0 * n + k + 0.25 for k in range(REALS)]
    header = Header(Time(1000 + n, 7 * n + 3), f"frame_{n}")
    return Imu(
        header,
        Quaternion(*reals[:4]),
        reals[4:13],
        Vector3(*reals[13:16]),
        reals[16:25],
        Vector3(*reals[25:28]),
        reals[28:],
    )


def check(imu: Imu) -> int:
    """CRC-32 of the fields in wire order, little-endian, without padding: see tests/peers/sum.h."""
    frame = imu.header.frame_id.encode() + b"\0"
    q, w, a = imu.orientation, imu.angular_velocity, imu.linear_acceleration
    reals = [q.x, q.y, q.z, q.w, *imu.orientation_covariance]
    reals += [w.x, w.y, w.z, *imu.angular_velocity_covariance]
    reals += [a.x, a.y, a.z, *imu.linear_acceleration_covariance]
    stamp = struct.pack("<iII", imu.header.stamp.sec, imu.header.stamp.nanosec, len(frame))
    return zlib.crc32(stamp + frame + struct.pack(f"<{REALS}d", *reals))


def report(**what: object) -> None:
    print(json.dumps(what, separators=(",", ":")), flush=True)


def ended(seconds: float) -> bool:
    """Waits for at most `seconds`; returns whether standard input has ended."""
    ready, _, _ = select.select([sys.stdin.buffer], [], [], seconds)
    return bool(ready) and not sys.stdin.buffer.raw.read(64)


def publish(
    participant: DomainParticipant, topic: Topic, qos: Qos, options: argparse.Namespace
) -> None:
    writer = DataWriter(participant, topic, qos=qos)
    while (count := len(writer.get_matched_subscriptions())) < options.readers:
        if ended(0.002):
            return
    report(event="matched", count=count)
    due, n = time.monotonic(), 0
    while options.count == 0 or n < options.count:
        n += 1
        message = content(n)
        time.sleep(max(0.0, due - time.monotonic()))
        due += 1 / options.rate
        writer.write(message)
        if ended(0):
            return
    report(event="written", count=n)
    while not ended(1):
        pass


def subscribe(participant: DomainParticipant, topic: Topic, qos: Qos) -> None:
    reader, writers = DataReader(participant, topic, qos=qos), 0
    while not ended(0.001):
        matched = len(reader.get_matched_publications())
        if matched != writers:
            writers = matched
            report(event="matched", count=writers)
        for imu in reader.take(N=1000):
            if isinstance(imu, Imu):
                stamp = imu.header.stamp
                stamp_ns = stamp.sec * 10**9 + stamp.nanosec
                report(event="sample", seq=stamp.sec - 1000, stamp=stamp_ns, sum=check(imu))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("how", choices=["pub", "sub"])
    parser.add_argument("type", choices=["Imu"])
    parser.add_argument("topic")
    parser.add_argument("--count", type=int, default=0)
    parser.add_argument("--rate", type=float, default=10)
    parser.add_argument("--depth", type=int, default=10)
    parser.add_argument("--readers", type=int, default=1)
    parser.add_argument("--reliability", choices=["reliable", "best_effort"], default="reliable")
    parser.add_argument("--durability", choices=["volatile", "transient_local"], default="volatile")
    options = parser.parse_args()
    reliable = options.reliability == "reliable"
    history = Policy.History.KeepLast(options.depth) if options.depth else Policy.History.KeepAll
    is_volatile = options.durability == "volatile"
    best_effort = Policy.Reliability.BestEffort
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=10)) if reliable else best_effort,
        Policy.Durability.Volatile if is_volatile else Policy.Durability.TransientLocal,
        history,
        # The history for late readers is the same, as in rmw_cyclonedds.
        Policy.DurabilityService(0, history, -1, -1, -1),
    )
    participant = DomainParticipant()
    topic = Topic(participant, "rt" + options.topic, Imu)
    if options.how == "pub":
        publish(participant, topic, qos, options)
    else:
        subscribe(participant, topic, qos)


if __name__ == "__main__":
    main()

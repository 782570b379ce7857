"""The message types, as ROS 2 names and encodes them on DDS, and octets as `bytes`.

The binding decodes `sequence[uint8]` into a list of ints, which takes 60 ms for an image of 720p.
`use_bytes` replaces that decoder.
"""

from dataclasses import dataclass
from typing import Any

from cyclonedds.idl import IdlStruct
from cyclonedds.idl._machinery import BytesMachine
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32


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


@dataclass
@final
class Image(IdlStruct, typename="sensor_msgs.msg.dds_.Image_"):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@dataclass
@final
class TimeReference(IdlStruct, typename="sensor_msgs.msg.dds_.TimeReference_"):
    header: Header
    time_ref: Time
    source: str


class Octets(BytesMachine):
    """Decodes octets into `bytes` by one copy; that of the binding makes two."""

    def deserialize(self, buffer: Any, *_: Any) -> bytes:
        buffer.align(4)
        length = buffer.read("I", 4)
        begin = buffer.tell()
        buffer.seek(begin + length)
        with memoryview(buffer._bytes) as view:
            return bytes(view[begin : begin + length])


def use_bytes(message: Any, field: str) -> None:
    """Lets a field of type `sequence[uint8]` be decoded into `bytes`. Its type on the network stays
    the same, which it would not if the field were declared as `bytes`."""
    message.__idl__.populate()
    message.__idl__.v1_machine.members_machines[field] = Octets()

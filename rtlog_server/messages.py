"""The wire types: ROS 2 messages as CDR bytes, the same on zenoh and in MCAP. A leaf.

Messages are the dataclasses of rosbags' type store (numpy arrays inside); `encode` and `decode` are the only way from
and to bytes. Stamps are integers of nanoseconds, UTC, everywhere but inside a message.
"""

from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

OWN_DEFINITIONS = {
    "rtlog_msgs/msg/SensorState": """\
uint8 OK=0
uint8 STALE=1
uint8 MISSING=2
string name
uint8 state
float64 age
""",
    "rtlog_msgs/msg/Tick": """\
std_msgs/Header header
uint64 index
builtin_interfaces/Time scheduled
float64 lateness
rtlog_msgs/SensorState[] sensors
""",
    "rtlog_msgs/msg/TagRead": """\
builtin_interfaces/Time stamp
string epc
uint8 antenna
uint16 count
float32 rssi
""",
    "rtlog_msgs/msg/TagReads": """\
std_msgs/Header header
rtlog_msgs/TagRead[] reads
""",
}

typestore = get_typestore(Stores.ROS2_HUMBLE)
for _name, _text in OWN_DEFINITIONS.items():
    typestore.register(get_types_from_msg(_text, _name))

Time: Any = typestore.types["builtin_interfaces/msg/Time"]
Header: Any = typestore.types["std_msgs/msg/Header"]
LaserScan: Any = typestore.types["sensor_msgs/msg/LaserScan"]
JointState: Any = typestore.types["sensor_msgs/msg/JointState"]
Odometry: Any = typestore.types["nav_msgs/msg/Odometry"]
DiagnosticArray: Any = typestore.types["diagnostic_msgs/msg/DiagnosticArray"]
DiagnosticStatus: Any = typestore.types["diagnostic_msgs/msg/DiagnosticStatus"]
KeyValue: Any = typestore.types["diagnostic_msgs/msg/KeyValue"]
SensorState: Any = typestore.types["rtlog_msgs/msg/SensorState"]
Tick: Any = typestore.types["rtlog_msgs/msg/Tick"]
TagRead: Any = typestore.types["rtlog_msgs/msg/TagRead"]
TagReads: Any = typestore.types["rtlog_msgs/msg/TagReads"]

OK, STALE, MISSING = 0, 1, 2  # SensorState.state


def encode(message: Any) -> bytes:
    """A message as CDR: little endian, with its encapsulation header."""
    return bytes(typestore.serialize_cdr(message, message.__msgtype__))


def decode(data: bytes | memoryview, msgtype: str) -> Any:
    """The message in CDR bytes.

    Raises:
        ValueError: the bytes are no whole message of that type.
    """
    try:
        return typestore.deserialize_cdr(data, msgtype)
    except Exception as error:  # rosbags lets struct, index and assertion errors through for cut bytes
        raise ValueError(f"{len(data)} bytes are no {msgtype}: {error!r}") from error


def schema_text(msgtype: str) -> str:
    """The definition with all that it depends on, as MCAP's `ros2msg` schema wants it."""
    return str(typestore.generate_msgdef(msgtype, ros_version=2)[0])


def to_time(stamp_ns: int) -> Any:
    """A ROS time of UTC nanoseconds."""
    return Time(sec=stamp_ns // 1_000_000_000, nanosec=stamp_ns % 1_000_000_000)


def to_ns(time: Any) -> int:
    """UTC nanoseconds of a ROS time."""
    return int(time.sec) * 1_000_000_000 + int(time.nanosec)


def header(stamp_ns: int, frame_id: str) -> Any:
    return Header(stamp=to_time(stamp_ns), frame_id=frame_id)

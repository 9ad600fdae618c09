"""Every topic in one table: its name, its ROS 2 type, when it is sent and whether it is recorded. A leaf."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Topic:
    name: str
    msgtype: str
    when: str
    recorded: bool = True


TICK = Topic("/rtlog/tick", "rtlog_msgs/msg/Tick", "every tick")
PRIMARY_SCAN = Topic("/laser/primary/scan", "sensor_msgs/msg/LaserScan", "each tick with a new scan")
AUXILIARY_SCAN = Topic("/laser/auxiliary/scan", "sensor_msgs/msg/LaserScan", "each tick with a new scan")
JOINT_STATES = Topic("/encoders/joint_states", "sensor_msgs/msg/JointState", "each tick with a reading")
TAGS = Topic("/rfid/tags", "rtlog_msgs/msg/TagReads", "each tick while the reader answers")
IMU = Topic("/imu/data", "sensor_msgs/msg/Imu", "each tick, where fitted")
ODOMETRY = Topic("/odom", "nav_msgs/msg/Odometry", "only in recordings of other systems")
DIAGNOSTICS = Topic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray", "1 Hz and at each change of state")

TOPICS = (TICK, PRIMARY_SCAN, AUXILIARY_SCAN, JOINT_STATES, TAGS, IMU, ODOMETRY, DIAGNOSTICS)
BY_NAME = {topic.name: topic for topic in TOPICS}


def zenoh_key(vehicle: str, topic: str) -> str:
    """`rtlog/<vehicle>/<topic without the first slash>`."""
    return f"rtlog/{vehicle}/{topic.lstrip('/')}"

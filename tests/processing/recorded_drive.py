"""What our server and another system record, tick by tick, which tests write and read back."""

from collections.abc import Callable, Iterable

import numpy as np

from hw_profiles.profile import read_profile_text
from rtlog_server.messages import (
    JointState,
    LaserScan,
    Odometry,
    TagRead,
    TagReads,
    Tick,
    header,
    to_time,
    typestore,
)

START_NS = 1_767_592_800_000_000_000
TICKS = 20
LMS111 = (np.radians(-135), np.radians(0.5))  # angle_min, angle_increment
TRAILER = read_profile_text("canmet_trailer")
NOTHING = np.empty(0)
Message = tuple[str, int, object]  # topic, log time, message


def tick_ns(k: int) -> int:
    return START_NS + k * 100_000_000


def scan(stamp_ns: int, ranges: Iterable[float], angles: tuple[float, float] = LMS111) -> object:
    values = np.array(ranges, np.float32)
    return LaserScan(
        header=header(stamp_ns, "laser"),
        angle_min=angles[0],
        angle_max=angles[0] + angles[1] * (len(values) - 1),
        angle_increment=angles[1],
        time_increment=2e-5,
        scan_time=0.02,
        range_min=0.05,
        range_max=20.0,
        ranges=values,
        intensities=np.float32(NOTHING),
    )


def joints(stamp_ns: int, **angles: float) -> object:
    return JointState(header(stamp_ns, ""), list(angles), np.array(list(angles.values())), NOTHING, NOTHING)


def odom(stamp_ns: int, x: float, y: float, heading: float) -> object:
    types, zeros = typestore.types, np.zeros(36)
    still = types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=0.0)
    pose = types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](x=x, y=y, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=np.sin(heading / 2), w=np.cos(heading / 2)),
    )
    return Odometry(
        header=header(stamp_ns, "odom"),
        child_frame_id="base_link",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=zeros),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](
            twist=types["geometry_msgs/msg/Twist"](linear=still, angular=still), covariance=zeros
        ),
    )


def tags(stamp_ns: int, *reads: tuple[int, str]) -> object:
    return TagReads(header(stamp_ns, "rfid"), [TagRead(to_time(ns), epc, 0, 1, -40.0) for ns, epc in reads])


def ours(k: int) -> list[Message]:
    """What our server sends at tick k: the scan was taken 30 ms before it, the wheels latched 12 ms before it."""
    now = tick_ns(k)
    return [
        ("/rtlog/tick", now, Tick(header(now + 9_000, ""), k, to_time(now), 9e-6, [])),
        ("/laser/primary/scan", now, scan(now - 30_000_000, np.full(541, 4.0 + 0.1 * k))),
        ("/encoders/joint_states", now, joints(now - 12_000_000, left_wheel=0.5 * k, right_wheel=0.6 * k)),
        ("/rfid/tags", now, tags(now, (now - 40_000_000, "e2003412000000000000000a")) if k == 7 else tags(now)),
    ]


def theirs(k: int) -> list[Message]:
    """Another system: /scan of 181 beams over 180°, /odom at other moments, no ticks."""
    now, angles = tick_ns(k), (-np.pi / 2, np.pi / 180)
    return [
        ("/odom", now, odom(now - 5_000_000, 0.2 * k, 0.1 * k, 0.4 * k - 3.0)),
        ("/scan", now, scan(now, np.full(181, 3.0), angles)),
    ]


def drive(tick: Callable[[int], list[Message]], but: Callable[[str, int], bool] = lambda _topic, _k: False) -> list:
    """All ticks' messages, without those that `but` names."""
    return [m for k in range(TICKS) for m in tick(k) if not but(m[0], k)]

"""What the encoders showed in between their readings, and what they would have shown on a way that /odom tells."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hw_profiles.errors import BadInputError
from hw_profiles.profile import Encoder, Profile, Vehicle
from processing.odometry import dead_reckon, wheel_motions
from rtlog_client.encoder_track import encoder_angles, read_encoder_track
from rtlog_client.log_file import LogWriter
from rtlog_server.messages import JointState, Odometry, encode, header, typestore
from rtlog_server.topics import JOINT_STATES, ODOMETRY

S = 1_000_000_000
START = 1_700_000_000 * S
NOTHING = np.empty(0)
TRAILER = Profile(
    schema=1,
    name="trailer",
    vehicle=Vehicle(kinematics="differential", track_width_m=1.6),
    encoders=[
        Encoder(name="left", role="left_wheel", wheel_radius_m=0.35),
        Encoder(name="right", role="right_wheel", wheel_radius_m=0.30),
    ],
)


def tricycle(drive_axle: str) -> Profile:
    return Profile(
        schema=1,
        name="tricycle",
        vehicle=Vehicle(kinematics="tricycle", wheelbase_m=1.65, drive_axle=drive_axle),  # type: ignore[arg-type]
        encoders=[
            Encoder(name="drive", role="drive_wheel", wheel_radius_m=0.25),
            Encoder(name="steering", role="steering"),
        ],
    )


def joints(stamp_ns: int, **angles: float) -> bytes:
    return encode(JointState(header(stamp_ns, ""), list(angles), np.array(list(angles.values())), NOTHING, NOTHING))


def write_joints(path: Path, *rows: tuple[float, dict[str, float]]) -> Path:
    with LogWriter(path, {}, None) as log:
        for at_s, angles in rows:
            log.write(JOINT_STATES.name, JOINT_STATES.msgtype, joints(START + round(at_s * S), **angles), START, START)
    return path


def encoders(*names: str) -> Profile:
    return Profile(schema=1, name="p", encoders=[Encoder(name=name, role="left_wheel") for name in names])


def test_wheels_turn_evenly_between_readings(tmp_path: Path) -> None:
    rows = [(0, 10.0, 3.0), (2, 14.0, -3.1), (1, 11.0, 3.1)]  # one stamp runs backwards
    path = write_joints(tmp_path / "a.mcap", *((at_s, {"wheel": w, "steering": s}) for at_s, w, s in rows))
    track = read_encoder_track(path, encoders("steering", "wheel"))
    at_s = [-1, 0, 0.25, 1, 1.5, 2, 9]
    angles = [track.angle("wheel", START + round(t * S)) for t in at_s]
    assert angles == pytest.approx([10, 10, 10.25, 11, 12.5, 14, 14])
    assert track.angle("steering", START + 3 * S // 2) == pytest.approx((3.1 + math.tau - 3.1) / 2)  # through π
    with pytest.raises(BadInputError, match="lacks other; it has wheel, steering"):
        read_encoder_track(path, encoders("wheel", "other"))


def test_a_wheel_that_went_far_while_nobody_looked_has_gone_far(tmp_path: Path) -> None:
    path = write_joints(tmp_path / "a.mcap", (0, {"wheel": 10.0}), (1, {"wheel": 20.0}))
    assert read_encoder_track(path, encoders("wheel")).angle("wheel", START + S // 2) == pytest.approx(15.0)


def test_a_reading_without_one_of_the_encoders_is_passed_over(tmp_path: Path) -> None:
    rows = [(0, {"a": 0.0, "b": 9.0}), (1, {"a": 5.0}), (2, {"a": 4.0, "b": 9.0})]
    track = read_encoder_track(write_joints(tmp_path / "a.mcap", *rows), encoders("a", "b"))
    assert track.angle("a", START + S) == pytest.approx(2.0)


def weave(count: int = 400) -> Any:
    """(N, 3) poses on a road that bends both ways, and a stretch backwards."""
    speeds = np.where(np.arange(count) < 300, 0.1, -0.08)
    turns = speeds * 0.2 * np.sin(np.arange(count) / 40)  # the steering turns evenly, also where the drive turns back
    yaw = np.concatenate([[0.3], 0.3 + np.cumsum(turns)])
    chords = speeds * np.sinc(turns / (2 * np.pi))
    middle = yaw[:-1] + turns / 2
    steps = np.column_stack([chords * np.cos(middle), chords * np.sin(middle)])
    return np.column_stack([np.array([5.0, -2.0]) + np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)]), yaw])


def test_a_trailer_s_wheels_lead_back_to_the_way_that_they_came_from() -> None:
    poses = weave()
    angles = encoder_angles(TRAILER, poses)
    motions = wheel_motions(TRAILER, angles["left"], angles["right"])
    np.testing.assert_allclose(dead_reckon(motions, poses[0])[:, :2], poses[:, :2], atol=1e-9)


@pytest.mark.parametrize("drive_axle", ["rear", "front"])
def test_a_tricycle_s_wheels_lead_back_too(drive_axle: str) -> None:
    poses, profile = weave(), tricycle(drive_axle)
    angles = encoder_angles(profile, poses)
    assert np.abs(angles["steering"]).max() < math.radians(40)
    way = dead_reckon(wheel_motions(profile, angles["drive"], angles["steering"]), poses[0])
    np.testing.assert_allclose(way[:, :2], poses[:, :2], atol=0.02)  # of 38 m; steering is told between the steps


def test_a_vehicle_that_stands_keeps_its_wheel_where_it_was() -> None:
    poses = np.vstack([weave()[:100], np.repeat(weave()[99:100], 20, axis=0)])
    angles = encoder_angles(tricycle("rear"), poses)
    assert angles["steering"][-1] == angles["steering"][100] != 0.0
    assert angles["drive"][-1] == angles["drive"][99]


def test_odom_stands_in_for_encoders(tmp_path: Path) -> None:
    poses = weave(50)
    with LogWriter(tmp_path / "a.mcap", {}, None) as log:
        for k, (x, y, yaw) in enumerate(poses):
            stamp_ns = START + k * S // 10
            log.write(ODOMETRY.name, ODOMETRY.msgtype, encode(odometry(stamp_ns, x, y, yaw)), stamp_ns, stamp_ns)
    track = read_encoder_track(tmp_path / "a.mcap", TRAILER)
    assert track.angle("left", START + 5 * S) == pytest.approx(encoder_angles(TRAILER, poses)["left"][50])
    with LogWriter(tmp_path / "b.mcap", {}, None) as log:
        pass
    with pytest.raises(BadInputError, match="neither /encoders/joint_states nor /odom"):
        read_encoder_track(tmp_path / "b.mcap", TRAILER)


def odometry(stamp_ns: int, x: float, y: float, yaw: float) -> Any:
    types = {name: typestore.types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion", "Pose", "Vector3")}
    zero = types["Vector3"](x=0.0, y=0.0, z=0.0)
    quaternion = types["Quaternion"](x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    pose = types["Pose"](position=types["Point"](x=x, y=y, z=0.0), orientation=quaternion)
    with_covariance = typestore.types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
    twist = typestore.types["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    still = typestore.types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36))
    return Odometry(header(stamp_ns, "odom"), "base", with_covariance, still)

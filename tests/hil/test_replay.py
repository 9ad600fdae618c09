"""Drives go in at the wire and come out of a recording: what is the same, and what a fault took."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtlog_client.log_file import LogWriter, read_messages
from rtlog_server.messages import OK, STALE, LaserScan, Odometry, decode, encode, header, typestore
from rtlog_server.topics import ODOMETRY, TICK

SECONDS = 12.0
DEVICES = ("laser/primary", "encoders", "rfid")
KINDS = {
    "drop": "for_s = 0.3",
    "delay": "for_s = 1.0\nby_s = 0.25",
    "cut": "for_s = 1.5",
    "restart": "for_s = 1.0",
    "garble": "for_s = 1.0\nshare = 0.1",
}


def script(kind: str) -> str:
    """The fault at one device after the other."""
    return "".join(
        f'[[fault]]\ndevice = "{device}"\nkind = "{kind}"\nat_s = {2.0 + 4 * number}\n{KINDS[kind]}\n'
        for number, device in enumerate(DEVICES)
    )


def test_what_comes_out_is_what_went_in(rig: Any, make_drive: Any) -> None:
    played = rig.play(make_drive(SECONDS))
    assert played.unexplained() == []
    assert played.summary["lost"] == {}
    for name in ("laser/primary", "encoders"):
        assert played.device(name)["went_in"] in range(119, 123)
        assert played.device(name)["same"] > 100


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_fault_takes_is_accounted_for(rig: Any, make_drive: Any, kind: str) -> None:
    played = rig.play(make_drive(15.0), script(kind))
    assert played.unexplained() == []
    assert [fault["device"] for fault in played.report["faults"]] == list(DEVICES)
    for name in DEVICES if kind == "restart" else DEVICES[:2]:  # a reader makes up for what was short
        causes = [difference["cause"] for difference in played.device(name)["differences"]]
        assert [cause for cause in causes if cause.startswith(f"{kind} of {name}")], name


def test_two_scanners_whose_cables_are_swapped(make_rig: Any, make_drive: Any, two_lasers: Any) -> None:
    rig = make_rig(auxiliary=True)
    swap = '[[fault]]\ndevice = "laser/primary"\nkind = "swap"\nother = "laser/auxiliary"\nat_s = 4.0\nfor_s = 3.0\n'
    played = rig.play(make_drive(10.0, 10, two_lasers), swap)
    assert played.unexplained() == []
    for name in ("laser/primary", "laser/auxiliary"):
        changed = played.causes(name, "changed") + played.causes(name, "extra")
        assert len(changed) >= 10, name  # the other's scans, well for a second at least
        assert all(cause.startswith("swap of laser/primary with laser/auxiliary at 4.0") for cause in changed)


def test_five_times_as_fast_is_the_same_for_a_server_that_ticks_so(make_rig: Any, make_drive: Any) -> None:
    rig = make_rig(tick_period_s=0.02)
    played = rig.play(make_drive(60.0), "", "--rate", "max")
    assert played.report["rate"] == pytest.approx(5.0)
    assert played.comparison["missing_ticks"] == 0
    least = {"laser/primary": 0.95, "encoders": 0.7}  # a round of the encoders takes half of so short a tick
    for name, share in least.items():
        device = played.device(name)
        assert device["same"] >= share * device["went_in"], name


def test_a_gap_in_the_recording_is_no_loss(rig: Any, make_drive: Any) -> None:
    played = rig.play(make_drive(8.0, gap=(30, 40)))
    assert played.unexplained() == []
    assert played.device("laser/primary")["went_in"] == 70
    states = [sensor.state for tick in ticks_of(played.came_out) for sensor in tick.sensors[:1]]
    assert STALE in states[states.index(OK) :]  # it is told while it lasts


def ticks_of(recording: Path) -> list[Any]:
    return [decode(message.data, message.msgtype) for message in read_messages(recording, [TICK.name])]


def test_a_recording_of_another_system_goes_in_too(rig: Any, tmp_path: Path) -> None:
    """`/scan` and `/odom`: other beams and rates, no encoders and no tags in it."""
    path = tmp_path / "other.mcap"
    write_other(path)
    played = rig.play(path)
    assert played.unexplained() == []
    assert {device["device"] for device in played.comparison["devices"]} == {"laser/primary", "encoders"}
    encoders = played.device("encoders")["figures"]
    assert encoders["left_wheel_turned_in_rad"] > 5.0
    assert encoders["left_wheel_turned_out_rad"] == pytest.approx(encoders["left_wheel_turned_in_rad"], abs=0.05)


def test_captured_bytes_of_a_real_scanner_go_in_as_they_are(rig: Any) -> None:
    path = Path("../shared/data/lms111/colab_dev2host.bin")
    if not path.exists():
        pytest.skip("the capture of a real LMS111 is not beside the repository")
    played = rig.play(path.resolve(), "", "--device", "laser/primary")
    assert played.unexplained() == []
    assert (played.report["scans"], played.report["unheard_scans"]) == (80, 0)
    (scanner,) = played.comparison["devices"]
    assert scanner["went_in"] == 77
    assert scanner["same"] >= 14  # 1.5 s at ten ticks a second


def test_encoders_on_a_can_bus_lose_frames_and_come_back(make_rig: Any, make_drive: Any) -> None:
    rig = make_rig(can=True)
    faults = "".join(
        f'[[fault]]\ndevice = "encoders"\nkind = "{kind}"\nat_s = {at_s}\n{own}\n'
        for kind, at_s, own in (
            ("drop", 2.0, "for_s = 0.4"),
            ("cut", 5.0, "for_s = 1.0"),
            ("restart", 9.0, "for_s = 1.0"),
        )
    )
    played = rig.play(make_drive(14.0), faults)
    assert played.unexplained() == []
    for kind in ("drop", "cut", "restart"):
        assert [cause for cause in played.causes("encoders", "lost") if cause.startswith(f"{kind} of encoders")], kind


def write_other(path: Path) -> None:
    """A robot of somebody else's: 181 beams at 5 Hz, odometry at 20 Hz, driving an arc."""
    start_ns = 1_600_000_000_123_456_789
    types = {name: typestore.types[f"geometry_msgs/msg/{name}"] for name in ("Point", "Quaternion", "Pose", "Vector3")}
    zero = types["Vector3"](x=0.0, y=0.0, z=0.0)
    twist = typestore.types["geometry_msgs/msg/Twist"](linear=zero, angular=zero)
    still = typestore.types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=np.zeros(36))
    with LogWriter(path, {}, None) as log:
        for k in range(200):
            stamp_ns, yaw = start_ns + k * 50_000_000, 0.01 * k
            quaternion = types["Quaternion"](x=0.0, y=0.0, z=np.sin(yaw / 2), w=np.cos(yaw / 2))
            point = types["Point"](x=5 * np.sin(yaw), y=5 * (1 - np.cos(yaw)), z=0.0)
            pose = types["Pose"](position=point, orientation=quaternion)
            placed = typestore.types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=np.zeros(36))
            odometry = Odometry(header(stamp_ns, "odom"), "base", placed, still)
            log.write(ODOMETRY.name, ODOMETRY.msgtype, encode(odometry), stamp_ns, stamp_ns)
            if k % 4 == 0:
                ranges = np.float32(np.random.default_rng(k).uniform(0.5, 15.0, 181))
                angles = (-np.pi / 2, np.pi / 2, np.pi / 180)
                scan = LaserScan(header(stamp_ns, "laser"), *angles, 0.0, 0.2, 0.1, 80.0, ranges, np.float32([]))
                log.write("/scan", LaserScan.__msgtype__, encode(scan), stamp_ns + 20_000_000, stamp_ns)

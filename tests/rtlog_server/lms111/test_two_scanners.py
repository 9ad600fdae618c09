"""One server with a scanner ahead and one behind, of different dialect, rate, resolution and echo."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.messages import MISSING, OK, decode, to_ns
from rtlog_server.topics import AUXILIARY_SCAN, PRIMARY_SCAN, TICK

AUXILIARY = """
[lasers.auxiliary]
mount = {{ x_m = 0.8, yaw_deg = 180.0 }}
device = {{ host = "127.0.0.1", port = {port}, scan_frequency_hz = 25, echo = "last", remission_bits = 8 }}
"""
SECOND_M = 9.0
MSGTYPES = {topic.name: topic.msgtype for topic in (TICK, PRIMARY_SCAN, AUXILIARY_SCAN)}


@pytest.fixture
def scanners(feed: Callable[..., Any]) -> dict[str, Any]:
    """By topic."""
    ahead, behind = Lms111Emulator(dialect="B"), Lms111Emulator(dialect="A")
    second = np.full(1081, SECOND_M), np.full(1081, 40.0)
    return {
        PRIMARY_SCAN.name: feed(ahead),
        AUXILIARY_SCAN.name: feed(behind, rays=1081, step_deg=0.25, period_s=0.04, second_echo=lambda _: second),
    }


def test_each_comes_on_its_topic_and_goes_alone(
    scanners: dict[str, Any], start_server: Callable[..., Any], wait_until: Callable[..., None]
) -> None:
    primary, auxiliary = (feeder.emulator for feeder in scanners.values())
    extra = AUXILIARY.format(port=auxiliary.address[1])
    server = start_server(laser_port=primary.address[1], auxiliary_laser=extra)

    def messages(topic: str) -> list[Any]:
        return [decode(sample.payload, MSGTYPES[topic]) for sample in server.on(topic.removeprefix("/"))]

    def states() -> dict[str, int]:
        return {sensor.name: sensor.state for tick in messages(TICK.name)[-1:] for sensor in tick.sensors}

    def both(ahead: int, behind: int) -> bool:
        return {"laser/primary": ahead, "laser/auxiliary": behind}.items() <= states().items()

    wait_until(lambda: both(OK, OK), 15)
    wait_until(lambda: all(len(messages(topic)) >= 5 for topic in scanners), 15)
    utc_offset_ns = time.time_ns() - time.monotonic_ns()
    for topic, rays, frame_id in (
        (PRIMARY_SCAN.name, 541, "laser_primary"),
        (AUXILIARY_SCAN.name, 1081, "laser_auxiliary"),
    ):
        for scan in messages(topic)[:5]:
            assert scan.header.frame_id == frame_id
            assert len(scan.ranges) == len(scan.intensities) == rays
            assert scan.angle_max == pytest.approx(math.radians(135), abs=1e-5)
            stamp_ns = to_ns(scan.header.stamp) - utc_offset_ns
            assert min(abs(stamp_ns - first_ray_ns) for first_ray_ns in scanners[topic].first_rays_ns) < 10e6
    ahead, behind = messages(PRIMARY_SCAN.name)[-1], messages(AUXILIARY_SCAN.name)[-1]
    assert ahead.scan_time == pytest.approx(0.02, rel=0.02)
    assert behind.scan_time == pytest.approx(0.04, rel=0.02)
    assert ahead.intensities[100] == 1000.0
    assert set(behind.ranges) == {SECOND_M}
    assert set(behind.intensities) == {40.0}

    auxiliary.refuse()
    wait_until(lambda: both(OK, MISSING), 15)
    auxiliary.refuse(False)
    wait_until(lambda: both(OK, OK), 15)

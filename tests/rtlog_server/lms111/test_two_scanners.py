"""One server with a scanner ahead and one behind, of different dialect, rate, resolution and echo."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from patience import wait_until

from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.messages import MISSING, OK, decode, to_ns
from rtlog_server.ticker import utc_offset_ns
from rtlog_server.topics import AUXILIARY_SCAN, PRIMARY_SCAN, TICK

AUXILIARY = """
[lasers.auxiliary]
mount = {{ x_m = 0.8, yaw_deg = 180.0 }}
device = {{ host = "127.0.0.1", port = {port}, scan_frequency_hz = 25, echo = "last", remission_bits = 8 }}
"""
SECOND_M = 9.0
CLOCKS_NS = 1_000_000  # by which wall clock and monotonic clock part while the server runs, and stamps are cut
MSGTYPES = {topic.name: topic.msgtype for topic in (TICK, PRIMARY_SCAN, AUXILIARY_SCAN)}


@pytest.fixture
def scanners(feed: Callable[..., Any]) -> dict[str, Any]:
    """By topic; scan k of the one behind has all its second echoes k mm beyond `SECOND_M`."""
    ahead, behind = Lms111Emulator(dialect="B"), Lms111Emulator(dialect="A")

    def second(k: int) -> tuple[np.ndarray, np.ndarray]:
        return np.full(1081, SECOND_M + k * 1e-3), np.full(1081, 40.0)

    return {
        PRIMARY_SCAN.name: feed(ahead),
        AUXILIARY_SCAN.name: feed(behind, rays=1081, step_deg=0.25, period_s=0.04, second_echo=second),
    }


def test_each_comes_on_its_topic_and_goes_alone(scanners: dict[str, Any], start_server: Callable[..., Any]) -> None:
    primary, auxiliary = (feeder.emulator for feeder in scanners.values())
    extra = AUXILIARY.format(port=auxiliary.address[1])
    server = start_server(laser_port=primary.address[1], auxiliary_laser=extra)

    def messages(topic: str) -> list[Any]:
        return [decode(sample.payload, MSGTYPES[topic]) for sample in server.on(topic.removeprefix("/"))]

    def scheduled_ns() -> dict[int, int]:
        """When each tick was, on the monotonic clock."""
        return {tick.index: to_ns(tick.scheduled) - offset_ns for tick in messages(TICK.name)}

    def states() -> dict[str, int]:
        return {sensor.name: sensor.state for tick in messages(TICK.name)[-1:] for sensor in tick.sensors}

    def both(ahead: int, behind: int) -> bool:
        return {"laser/primary": ahead, "laser/auxiliary": behind}.items() <= states().items()

    wait_until(lambda: both(OK, OK))
    wait_until(lambda: all(len(messages(topic)) >= 5 for topic in scanners))
    offset_ns = utc_offset_ns()
    for topic, rays, frame_id, nearest_m in (
        (PRIMARY_SCAN.name, 541, "laser_primary", 1.0),
        (AUXILIARY_SCAN.name, 1081, "laser_auxiliary", SECOND_M),
    ):
        ticks = [sample.attachment.tick for sample in server.on(topic.removeprefix("/"))]
        wait_until(lambda: scheduled_ns().keys() >= set(ticks[:5]))  # noqa: B023
        late_ns = []
        for tick, scan in zip(ticks[:5], messages(topic), strict=False):
            assert scan.header.frame_id == frame_id
            assert len(scan.ranges) == len(scan.intensities) == rays
            assert scan.angle_max == pytest.approx(math.radians(135), abs=1e-5)
            first_ray_ns = scanners[topic].first_rays_ns[round((float(scan.ranges[0]) - nearest_m) * 1e3)]
            stamp_ns = to_ns(scan.header.stamp) - offset_ns
            last_ray_ns = stamp_ns + (rays - 1) * scan.time_increment * 1e9
            assert first_ray_ns - CLOCKS_NS < stamp_ns < last_ray_ns <= scheduled_ns()[tick] + CLOCKS_NS
            late_ns.append(stamp_ns - first_ray_ns)
        assert np.diff(late_ns).max() < CLOCKS_NS  # it is the fastest delivery so far, and no late one makes it grow
    ahead, behind = messages(PRIMARY_SCAN.name)[-1], messages(AUXILIARY_SCAN.name)[-1]
    assert ahead.scan_time == pytest.approx(0.02, rel=1e-3)
    assert behind.scan_time == pytest.approx(0.04, rel=1e-3)
    assert ahead.intensities[100] == 1000.0
    assert len(set(behind.ranges)) == 1
    assert behind.ranges[0] >= SECOND_M
    assert set(behind.intensities) == {40.0}

    auxiliary.refuse()
    wait_until(lambda: both(OK, MISSING))
    auxiliary.refuse(False)
    wait_until(lambda: both(OK, OK))

"""The server as a process, its encoders on a CAN bus of this machine (UDP multicast) with the emulator at its end."""

import math
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh

from hw_profiles.profile import CanBus, shipped_profiles
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.messages import OK, STALE, decode, to_ns
from rtlog_server.topics import JOINT_STATES, TICK

COUNTS = 4096
START_NS = time.monotonic_ns()
TURNS_PER_S = {0x10: 1.1, 0x11: -0.7}
FIRST_COUNTS = 2000 * COUNTS  # both stay within the encoders' turns
PROFILE = """\
schema = 1
name = "canbed"
[vehicle]
kinematics = "differential"
track_width_m = 1.6
[lasers.primary]
device = {{ host = "127.0.0.1", port = {laser_port} }}
[[encoders]]
name = "left_wheel"
role = "left_wheel"
wheel_radius_m = 0.35
address = 0x10
[[encoders]]
name = "right_wheel"
role = "right_wheel"
wheel_radius_m = 0.35
address = 0x11
[encoder_bus]
kind = "can"
interface = "udp_multicast"
channel = "239.74.163.2"
udp_port = {can_port}
[zenoh]
listen = ["tcp/127.0.0.1:{zenoh_port}"]
"""


def counts(node: int, at_ns: int) -> int:
    return FIRST_COUNTS + round(TURNS_PER_S[node] * COUNTS * (at_ns - START_NS) * 1e-9)


class Listener:
    """What the server publishes, by topic."""

    def __init__(self, session: zenoh.Session) -> None:
        self._samples: list[tuple[str, bytes]] = []
        session.declare_subscriber(
            "rtlog/canbed/**", lambda sample: self._samples.append((str(sample.key_expr), sample.payload.to_bytes()))
        )

    def on(self, topic: Any) -> list[Any]:
        key = f"rtlog/canbed{topic.name}"
        return [decode(payload, topic.msgtype) for name, payload in list(self._samples) if name == key]

    def wait_until(self, condition: Callable[[], bool], timeout_s: float = 15.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline
            time.sleep(0.02)


@pytest.fixture
def emulator(udp: CanBus) -> Iterator[CanBusEmulator]:
    with CanBusEmulator(udp, dict.fromkeys(TURNS_PER_S, COUNTS), counts) as emulator:
        yield emulator


@pytest.fixture
def listener(
    emulator: CanBusEmulator, tmp_path: Path, free_port: int, open_client: Callable[[int], zenoh.Session]
) -> Iterator[Listener]:
    """Of a server whose encoders are the emulator's."""
    with socket.socket() as laser:
        laser.bind(("127.0.0.1", 0))  # nobody listens
        laser_port = laser.getsockname()[1]
        profile = tmp_path / "canbed.toml"
        profile.write_text(PROFILE.format(laser_port=laser_port, can_port=emulator.bus.udp_port, zenoh_port=free_port))
        command = [sys.executable, "-m", "rtlog_server.cli", "run", "--profile", str(profile)]
        with subprocess.Popen(command, stderr=subprocess.PIPE, start_new_session=True) as process:
            with open_client(free_port) as session:
                yield Listener(session)
            process.terminate()
            _, errors = process.communicate(timeout=20)
            assert process.returncode == 0, errors.decode()


def encoder_states(listener: Listener) -> list[int]:
    return [sensor.state for tick in listener.on(TICK) for sensor in tick.sensors if sensor.name == "encoders"]


def test_joint_states_are_the_positions_at_the_tick(listener: Listener, emulator: CanBusEmulator) -> None:
    listener.wait_until(lambda: len(listener.on(JOINT_STATES)) >= 25)
    offset_ns = time.time_ns() - time.monotonic_ns()
    ticks_ns = np.array([to_ns(tick.scheduled) for tick in listener.on(TICK)])
    ages_s, errors_s = [], []
    for state in listener.on(JOINT_STATES)[2:]:
        assert list(state.name) == ["left_wheel", "right_wheel"]
        stamp_ns = to_ns(state.header.stamp)
        ages_s.append((ticks_ns[ticks_ns >= stamp_ns].min() - stamp_ns) * 1e-9)
        true_rad = [math.tau * counts(node, stamp_ns - offset_ns) / COUNTS for node in TURNS_PER_S]
        errors_s.append((np.array(state.position) - true_rad) / (math.tau * np.array(list(TURNS_PER_S.values()))))
    late_s = np.array(errors_s)  # by so much the emulator latched after the stamp
    assert np.median(ages_s) < 0.015
    assert np.median(np.abs(late_s)) < 0.002
    assert np.abs(late_s).max() < 0.03  # a busy machine may hold up a SYNC
    assert np.abs(late_s[:, 0] - late_s[:, 1]).max() < 0.002  # both at one instant

    emulator.nodes[0x10].written.clear()
    emulator.power_cycle(0x10)
    listener.wait_until(lambda: len(emulator.nodes[0x10].written) > 0)  # it is being configured again
    before = len(listener.on(JOINT_STATES))
    listener.wait_until(lambda: len(listener.on(JOINT_STATES)) >= before + 5)
    assert len(listener.on(JOINT_STATES)[-1].name) == 2
    indices = [tick.index for tick in listener.on(TICK)]
    assert indices == list(range(indices[0], indices[0] + len(indices)))
    states = encoder_states(listener)
    since = states[states.index(OK) :]
    assert set(since) <= {OK, STALE}
    assert since.count(STALE) <= len(since) // 5  # a busy machine may hold up three rounds of answers


def test_without_a_can_bus_in_the_profile_python_can_is_not_loaded() -> None:
    code = """
import sys
import rtlog_server.daemon
from hw_profiles.profile import load_profile
from rtlog_server.devices import open_devices
open_devices(load_profile("simulated"))
sys.exit(any(name in sys.modules for name in ("can", "canopen")))
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0


def test_both_vehicles_are_shipped_with_their_encoders_on_can() -> None:
    assert {"canmet_trailer_can", "cu_ss534_can"} <= set(shipped_profiles())

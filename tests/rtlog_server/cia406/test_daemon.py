"""The server as a process, its encoders on a CAN bus of this machine (UDP multicast) with the emulator at its end."""

import math
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from patience import PATIENCE_S, wait_until
from wheels import Wheels

from hw_profiles.profile import CanBus, shipped_profiles
from rtlog_server.attachment import unpack_attachment
from rtlog_server.devices.cia406.emulator import CanBusEmulator
from rtlog_server.messages import decode, to_ns
from rtlog_server.ticker import utc_offset_ns
from rtlog_server.topics import JOINT_STATES, TICK

COUNTS = 4096
TURNS_PER_S = {0x10: 1.1, 0x11: -0.7}
NODES = {"left_wheel": 0x10, "right_wheel": 0x11}
CLOCKS_NS = 1_000_000  # by which wall clock and monotonic clock part while the server runs, and stamps are cut
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


class Listener:
    """What the server publishes, by topic."""

    def __init__(self, session: zenoh.Session) -> None:
        self._samples: list[tuple[str, int, bytes]] = []
        session.declare_subscriber("rtlog/canbed/**", self._take)

    def _take(self, sample: zenoh.Sample) -> None:
        if sample.attachment is not None:
            tick = unpack_attachment(sample.attachment.to_bytes()).tick
            self._samples.append((str(sample.key_expr), tick, sample.payload.to_bytes()))

    def on(self, topic: Any) -> dict[int, Any]:
        """By their ticks."""
        key = f"rtlog/canbed{topic.name}"
        return {tick: decode(payload, topic.msgtype) for name, tick, payload in list(self._samples) if name == key}


@pytest.fixture
def wheels() -> Wheels:
    return Wheels(TURNS_PER_S, COUNTS)


@pytest.fixture
def emulator(udp: CanBus, wheels: Wheels) -> Iterator[CanBusEmulator]:
    with CanBusEmulator(udp, dict.fromkeys(TURNS_PER_S, COUNTS), wheels) as emulator:
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
            _, errors = process.communicate(timeout=PATIENCE_S)
            assert process.returncode == 0, errors.decode()


def test_joint_states_are_the_positions_at_the_tick(
    listener: Listener, emulator: CanBusEmulator, wheels: Wheels
) -> None:
    wait_until(lambda: len(listener.on(JOINT_STATES)) >= 25)
    states, offset_ns = listener.on(JOINT_STATES), utc_offset_ns()
    wait_until(lambda: listener.on(TICK).keys() >= states.keys())
    ticks = listener.on(TICK)
    for tick, state in states.items():
        stamp_ns, scheduled_ns = to_ns(state.header.stamp) - offset_ns, to_ns(ticks[tick].scheduled) - offset_ns
        looked_ns = set()
        for name, position_rad in zip(state.name, state.position, strict=True):
            counts = round(position_rad / math.tau * COUNTS)
            looked_ns.add(wheels.look(NODES[name], counts, scheduled_ns)[1])
        assert len(looked_ns) == 1  # all at one moment, before the tick that tells of it
        assert stamp_ns - CLOCKS_NS < looked_ns.pop()
    assert sum(len(state.name) == 2 for state in states.values()) > len(states) // 2

    emulator.nodes[0x10].written.clear()
    emulator.power_cycle(0x10)
    wait_until(lambda: len(emulator.nodes[0x10].written) > 0)  # it is being configured again
    before = max(listener.on(JOINT_STATES))
    wait_until(lambda: any(tick > before and len(state.name) == 2 for tick, state in listener.on(JOINT_STATES).items()))
    indices = list(listener.on(TICK))
    assert indices == list(range(indices[0], indices[0] + len(indices)))


def test_without_a_can_bus_in_the_profile_python_can_is_not_loaded() -> None:
    code = """
import sys
import rtlog_server.daemon
from hw_profiles.profile import load_profile
from rtlog_server.devices import open_devices
open_devices(load_profile("simulated"))
sys.exit(any(name in sys.modules for name in ("can", "canopen")))
"""
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_both_vehicles_are_shipped_with_their_encoders_on_can() -> None:
    assert {"canmet_trailer_can", "cu_ss534_can"} <= set(shipped_profiles())

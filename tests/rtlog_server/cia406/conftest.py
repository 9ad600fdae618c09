"""Emulated encoders on a CAN bus, and their driver, collected at each tick."""

import socket
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from wheels import Wheels

from hw_profiles.profile import CanBus, Encoder
from rtlog_server.devices.cia406 import nodes
from rtlog_server.devices.cia406.driver import Cia406Encoders
from rtlog_server.devices.cia406.emulator import CanBusEmulator

COUNTS = 4096
PERIOD_NS = 40_000_000
ENCODERS = (
    Encoder(name="left_wheel", role="left_wheel", address=5, wheel_radius_m=0.35),
    Encoder(name="right_wheel", role="right_wheel", address=9, wheel_radius_m=0.35, reversed=True),
)
TURNS_PER_S = {5: 2.3, 9: -1.7}


@pytest.fixture
def virtual() -> CanBus:
    return CanBus(interface="virtual", channel=uuid.uuid4().hex)


@pytest.fixture
def slcan(tmp_path: Path) -> CanBus:
    return CanBus(interface="slcan", channel=str(tmp_path / "slcan"))


@pytest.fixture
def udp() -> CanBus:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return CanBus(interface="udp_multicast", channel="239.74.163.2", udp_port=probe.getsockname()[1])


@pytest.fixture
def two_wheels() -> tuple[Encoder, ...]:
    return ENCODERS


@pytest.fixture
def turning() -> Wheels:
    """Two wheels at a steady speed."""
    return Wheels(TURNS_PER_S, COUNTS)


@pytest.fixture
def emulate(turning: Callable[[int, int], int]) -> Callable[..., CanBusEmulator]:
    """emulate(bus, position, counts): the wheels that turn, unless it is told otherwise."""

    def emulator(
        bus: CanBus, position: Callable[[int, int], int] = turning, counts: Mapping[int, int] | None = None
    ) -> CanBusEmulator:
        return CanBusEmulator(bus, dict.fromkeys((5, 9), COUNTS) if counts is None else counts, position)

    return emulator


@pytest.fixture
def start(start_encoders: Callable[..., Any], monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """Starts a driver of the bus; on a busy machine heartbeats may come late, and no node is to be lost by that."""
    monkeypatch.setattr(nodes, "LOST_NS", 1_500_000_000)

    def start_bus(bus: CanBus, encoders: tuple[Encoder, ...] = ENCODERS) -> Any:
        return start_encoders(Cia406Encoders("encoders", bus, encoders), PERIOD_NS)

    return start_bus

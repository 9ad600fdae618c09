"""A fault that cannot be played is told, and no replay waits for it."""

import socket
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from patience import wait_until

from hw_profiles.errors import BadInputError, RTLogError
from rtlog_client.fault_player import FaultPlayer
from rtlog_client.faults import Fault, FaultScript
from rtlog_client.serial_wire import SerialWire
from rtlog_client.stage import Line
from rtlog_client.tcp_wire import TcpWire
from rtlog_server.devices.pty_link import PtyLink


@pytest.fixture
def wire() -> Iterator[TcpWire]:
    with TcpWire("laser/primary", ("127.0.0.1", 0)) as wire:
        yield wire


def play(lines: dict[str, Line], *faults: Fault) -> FaultPlayer:
    return FaultPlayer(FaultScript(fault=list(faults)), lines, time.monotonic_ns(), 0)


def test_an_address_that_is_taken_during_a_restart_is_told(wire: TcpWire) -> None:
    with ExitStack() as stack:
        line = Line(wire, lambda: stack.enter_context(socket.create_server(wire.address)) and None)
        player = play({"laser/primary": line}, Fault(device="laser/primary", kind="restart", at_s=0.0, for_s=60.0))
        wait_until(lambda: wire.fault is not None)
        with pytest.raises(RTLogError, match=r"restart of laser/primary: .*in use"):
            player.close()
    assert player.played == []


def test_what_is_under_way_ends_with_the_drive(wire: TcpWire) -> None:
    faults = [Fault(device="laser/primary", kind="drop", at_s=at_s, for_s=60.0) for at_s in (0.0, 70.0)]
    player = play({"laser/primary": Line(wire, lambda: None)}, *faults)
    wait_until(lambda: wire.fault is not None)
    player.close()
    assert wire.fault is None
    assert [(fault.device, fault.kind) for fault in player.played] == [("laser/primary", "drop")]


def test_a_cable_of_another_kind_fits_no_socket(wire: TcpWire, tmp_path: Path) -> None:
    swap = Fault(device="laser/primary", kind="swap", other="encoders", at_s=0.0, for_s=1.0)
    device = PtyLink(tmp_path / "device")
    with SerialWire("encoders", tmp_path / "port", tmp_path / "device") as serial:
        lines = {"laser/primary": Line(wire, lambda: None), "encoders": Line(serial, lambda: None)}
        with pytest.raises(BadInputError, match="swap of laser/primary with encoders: only devices on TCP"):
            play(lines, swap)
    device.unplug()

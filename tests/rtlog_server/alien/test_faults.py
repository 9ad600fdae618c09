"""Everything that can go wrong between the driver and an ALR-9650, on both wires, and how it is read again."""

import os
import socket
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from patience import in_use, left_behind

from hw_profiles.profile import RfidDevice
from rtlog_server.devices import device
from rtlog_server.devices.alien import driver
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.messages import MISSING, STALE

Start = Callable[..., Any]


def wait_until_back(reader: Any, connects: int) -> None:
    reader.wait_for(lambda: reader.device.connected and reader.device.connects > connects)


def test_a_reader_that_lost_its_power_is_read_again(
    emulator: Alr9650Emulator, start_on_wire: Start, epcs: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "SILENT_S", 0.5)
    reader = start_on_wire(emulator.port)
    reader.wait_for(lambda: reader.device.connected)
    emulator.read_tag(epcs[0], count=7)
    reader.wait_for_epc(epcs[0])
    emulator.power_off()
    reader.wait_for(lambda: reader.collect() == MISSING)
    time.sleep(0.5)
    emulator.power_on()
    wait_until_back(reader, 1)
    emulator.read_tag(epcs[0], count=9)  # its list began anew
    reader.wait_for(lambda: sum(sample.count for sample in reader.samples) == 16)


def test_the_driver_may_start_before_the_reader_is_there(start: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as reserved:
        port = reserved.getsockname()[1]
    reader = start(port)
    reader.wait_for_message(f"127.0.0.1:{port}: no connection: Connection refused")
    time.sleep(0.5)
    with Alr9650Emulator(port=port):
        wait_until_back(reader, 0)


def take_terminal(name: Path) -> list[int]:
    """Open terminals until the one of that name is taken, by us or another process."""
    ends: list[int] = []
    while not name.exists():
        ends += os.openpty()
    return ends


def test_an_adapter_that_is_pulled_comes_back_as_another_terminal(
    emulator: Alr9650Emulator, start_with: Callable[[RfidDevice], Any], link: Path, epcs: list[str]
) -> None:
    reader = start_with(RfidDevice(serial_port=str(link)))
    reader.wait_for(lambda: reader.device.connected)
    first = link.readlink()
    emulator.unplug()
    reader.wait_for_message("cannot open the port: No such file")
    decoys = take_terminal(first)
    assert reader.collect() == MISSING
    emulator.replug()
    wait_until_back(reader, 1)
    assert link.readlink() != first
    emulator.read_tag(epcs[0])
    reader.wait_for_epc(epcs[0])
    for end in decoys:
        os.close(end)


def test_a_console_that_fell_silent_is_stale_and_then_left(
    emulator: Alr9650Emulator, start_on_wire: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "ALIVE_S", 0.1)
    monkeypatch.setattr(driver, "SILENT_S", 600.0)
    reader = start_on_wire(emulator.port)
    reader.wait_for(lambda: reader.device.connected)
    emulator.silent = True
    reader.wait_for(lambda: reader.collect() == STALE)
    monkeypatch.setattr(driver, "SILENT_S", 0.6)
    reader.wait_for_message("has been silent for")
    reader.wait_for(lambda: reader.collect() == MISSING)
    emulator.silent = False
    wait_until_back(reader, 1)


def test_a_reader_that_was_off_for_a_moment_or_set_by_another_is_set_up_anew(
    emulator: Alr9650Emulator, start_on_wire: Start, epcs: list[str]
) -> None:
    reader = start_on_wire(emulator.port)
    reader.wait_for(lambda: reader.device.connected)
    emulator.power_off()
    emulator.power_on()
    wait_until_back(reader, 1)
    emulator.configure("set AutoMode = OFF")
    reader.wait_for_message("no longer reads by itself")
    wait_until_back(reader, 2)
    emulator.read_tag(epcs[0])
    reader.wait_for_epc(epcs[0])


def test_a_connection_that_is_reset_is_made_anew(emulator: Alr9650Emulator, start: Start, epcs: list[str]) -> None:
    reader = start(emulator.port)
    for number in range(5):
        reader.wait_for(lambda: reader.device.connects > number and reader.device.connected)  # noqa: B023
        emulator.read_tag(epcs[number])
        reader.wait_for_epc(epcs[number])
        emulator.reset_connections()
    assert len(reader.samples) == 5


@pytest.mark.parametrize("garbage", [b"\0\0Alien>\0garbage;;\0", b"\xff" * 5000 + b"\0", b"Error 1: no.\r\n\0" * 20])
def test_garbage_on_the_console_harms_nothing(
    emulator: Alr9650Emulator, start_on_wire: Start, epcs: list[str], garbage: bytes
) -> None:
    reader = start_on_wire(emulator.port)
    reader.wait_for(lambda: reader.device.connected)
    emulator.babble(garbage)
    for epc in epcs:
        emulator.read_tag(epc)
        reader.wait_for_epc(epc)
    assert len(reader.samples) == 5


def test_an_answer_without_an_end_is_left(emulator: Alr9650Emulator, start: Start, epcs: list[str]) -> None:
    reader = start(emulator.port)
    reader.wait_for(lambda: reader.device.connected)
    flood = threading.Thread(target=emulator.babble, args=(b"x" * 3_000_000,))
    flood.start()
    reader.wait_for_message("bytes without an end")
    flood.join()
    emulator.reset_connections()
    wait_until_back(reader, 1)


@pytest.mark.parametrize("garbage", [b"", b"\0" * 1000, b"Username>\0Password>\0" * 50, b"\xff" * 70_000])
def test_a_peer_that_is_no_reader_gives_one_line(start: Start, garbage: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        reader = start(server.getsockname()[1])
        peer, _ = server.accept()
        peer.sendall(garbage)
        peer.close()
        reader.wait_for(lambda: reader.device.message != "not connected yet")
        assert reader.device.message.startswith("127.0.0.1:")
        assert "\n" not in reader.device.message
        assert not reader.device.connected


def test_reconnects_leak_neither_threads_nor_descriptors(
    emulator: Alr9650Emulator, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device, "RETRY_FIRST_S", 0.001)
    reader = start(emulator.port)
    reader.wait_until_reading()
    before = in_use()
    for _ in range(25):
        connects = reader.device.connects
        emulator.reset_connections()
        wait_until_back(reader, connects)
    reader.wait_until_reading()
    reader.wait_for(lambda: not left_behind(before))

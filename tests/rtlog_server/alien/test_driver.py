"""The reader's driver against an emulated ALR-9650 that does as it should."""

import math
import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien import driver
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.messages import MISSING, OK

Start = Callable[..., Any]


def test_reads_arrive_whole_and_in_order(emulator: Alr9650Emulator, start: Start, epcs: list[str]) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    sent = [(epcs[number % 5], number % 2, -40.0 - number / 10, 1 + number % 3) for number in range(200)]
    before_ns = time.monotonic_ns()
    for epc, antenna, rssi, count in sent:
        emulator.read_tag(epc, antenna, rssi, count)
    reader.wait_for(lambda: len(reader.samples) == len(sent))
    assert [(s.epc, s.antenna, s.rssi, s.count) for s in reader.samples] == [
        (epc, antenna, pytest.approx(rssi), count) for epc, antenna, rssi, count in sent
    ]
    for sample in reader.samples:
        assert before_ns - 2_000_000 < sample.measured_ns <= sample.complete_ns < time.monotonic_ns()
    reader.wait_for(lambda: reader.collect() == OK)
    assert reader.device.message == "connected"
    assert reader.device.diagnostics["push"] == "tag stream"
    assert reader.device.identity["ReaderType"].startswith("Alien RFID Tag Reader, Model: ALR-9650")
    assert reader.device.identity["MACAddress"] == "00:1B:5F:00:00:00"


def test_a_serial_console_is_polled_and_loses_nothing(
    emulator: Alr9650Emulator, start_on_wire: Start, epcs: list[str]
) -> None:
    reader = start_on_wire(emulator.port)
    reader.wait_for(lambda: reader.device.connected)
    for number in range(40):
        emulator.read_tag(epcs[number % 5], count=2)
        time.sleep(0.01)
    reader.wait_for(lambda: sum(sample.count for sample in reader.samples) >= 80)
    time.sleep(0.3)  # three polls more
    reader.collect()
    assert {epc: sum(s.count for s in reader.samples if s.epc == epc) for epc in epcs} == dict.fromkeys(epcs, 16)
    assert reader.device.message == "connected"


def test_a_reader_on_a_serial_line_and_the_network_pushes_too(
    emulator: Alr9650Emulator, start_with: Callable[[RfidDevice], Any], link: Path, epcs: list[str]
) -> None:
    reader = start_with(RfidDevice(serial_port=str(link), stream_host="127.0.0.1"))
    reader.wait_until_reading(stream="open")
    emulator.read_tag(epcs[0])
    reader.wait_for_epc(epcs[0])
    assert reader.device.diagnostics["push"] == "tag stream"


def test_a_read_is_told_by_the_push_and_waits_for_no_question(
    emulator: Alr9650Emulator, start: Start, epcs: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    monkeypatch.setattr(driver, "ALIVE_S", 600.0)  # so long is nothing asked for
    for number in range(5):
        emulator.read_tag(epcs[number])
        reader.wait_for_epc(epcs[number])


def test_a_reader_without_rssi_gives_nan(emulator: Alr9650Emulator, start: Start, epcs: list[str]) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    emulator.read_tag(epcs[0], rssi=math.nan)
    reader.wait_for(lambda: len(reader.samples) == 1)
    assert math.isnan(reader.samples[0].rssi)


def test_a_driver_that_ends_leaves_the_console_free(emulator: Alr9650Emulator, start: Start) -> None:
    for _ in range(3):
        reader = start(emulator.port)
        reader.wait_until_reading()
        reader.device.close()
        assert reader.device.connects == 1


def test_the_console_is_left_with_a_goodbye(start: Start) -> None:
    heard = bytearray()
    with socket.create_server(("127.0.0.1", 0)) as server:
        reader = start(server.getsockname()[1])
        client, _ = server.accept()
        with client:
            client.sendall(b"Username>\0")
            while not heard.endswith(b"set AutoMode = ON\r\n"):
                heard += client.recv(4096)
                client.sendall(b"Password>\0" if heard == b"alien\r\n" else b"Alien>\0\r\n\0" * (heard[-2:] == b"\r\n"))
            reader.wait_for(lambda: reader.device.connected)
            reader.device.close()
            while received := client.recv(4096):
                heard += received
    assert heard.endswith(b"\x01Quit\r\n")


def test_a_busy_console_is_told_and_tried_again(emulator: Alr9650Emulator, start: Start) -> None:
    with socket.create_connection(("127.0.0.1", emulator.port)) as other:
        other.recv(1)  # another client is greeted first
        reader = start(emulator.port)
        reader.wait_for_message("busy with another client")
        assert reader.collect() == MISSING
    reader.wait_until_reading()


def test_a_wrong_password_is_told(emulator: Alr9650Emulator, start: Start) -> None:
    reader = start(emulator.port, password="wrong")
    reader.wait_for_message("refuses user name 'alien'")
    sly = start(emulator.port, username="alien\r\nset AutoMode = OFF")
    sly.wait_for_message("printable ASCII")


def test_a_stream_port_that_is_taken_is_told(emulator: Alr9650Emulator, start: Start) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        reader = start(emulator.port, stream_port=port)
        reader.wait_for_message(f"stream_port {port}: cannot listen: Address already in use")
    reader.wait_until_reading()
    assert reader.device.diagnostics["stream address"] == f"127.0.0.1:{port}"

"""The CAN interface: which frames come through, and what the controller's own reports become."""

import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import can
import pytest
from patience import PATIENCE_S

from hw_profiles.profile import CanBus
from rtlog_server.devices.cia406.port import CanPort
from rtlog_server.devices.cia406.protocol import Frame
from rtlog_server.devices.cia406.slcan_adapter import SlcanAdapter
from rtlog_server.devices.device import DeviceError

BUS = CanBus(interface="virtual", channel=uuid.uuid4().hex)


@pytest.fixture
def line() -> Iterator[can.BusABC]:
    """The other end of the bus."""
    with can.Bus(interface="virtual", channel=BUS.channel) as line:
        yield line


@pytest.fixture
def port(line: can.BusABC) -> Iterator[CanPort]:
    port = CanPort(BUS)
    yield port
    port.close()


def test_frames_go_out_and_come_in_with_the_time_of_their_arrival(port: CanPort, line: can.BusABC) -> None:
    before_ns = time.monotonic_ns()
    assert before_ns <= port.send(Frame(0x605, b"\x40\x00")) <= time.monotonic_ns()
    sent = line.recv(PATIENCE_S)
    assert sent is not None
    assert (sent.arbitration_id, bytes(sent.data), sent.is_extended_id) == (0x605, b"\x40\x00", False)
    line.send(can.Message(arbitration_id=0x285, data=b"\x01\x02", is_extended_id=False))
    received = port.receive(PATIENCE_S)
    assert received is not None
    frame, arrived_ns = received
    assert frame == Frame(0x285, b"\x01\x02")
    assert before_ns <= arrived_ns <= time.monotonic_ns()
    assert port.receive(0.0) is None


@pytest.mark.parametrize(
    "message",
    [
        can.Message(arbitration_id=0x285, data=b"\x01", is_extended_id=True),
        can.Message(arbitration_id=0x285, is_extended_id=False, is_remote_frame=True),
        can.Message(arbitration_id=0x285, data=bytes(64), is_extended_id=False, is_fd=True),
    ],
    ids=["extended", "remote", "fd"],
)
def test_other_kinds_of_frames_are_none_of_ours(message: can.Message, port: CanPort, line: can.BusABC) -> None:
    line.send(message)
    line.send(can.Message(arbitration_id=0x705, data=b"\x05", is_extended_id=False))
    assert port.receive(PATIENCE_S) is None
    received = port.receive(PATIENCE_S)
    assert received is not None
    assert received[0].can_id == 0x705


def error_frame(classes: int, data: bytes = bytes(8)) -> can.Message:
    return can.Message(arbitration_id=classes, data=data, is_extended_id=False, is_error_frame=True)


def test_the_controllers_reports_are_kept_and_bus_off_is_a_failure(port: CanPort, line: can.BusABC) -> None:
    assert port.controller == "ok"
    line.send(error_frame(0x04, b"\x00\x20" + bytes(6)))
    assert port.receive(PATIENCE_S) is None
    assert port.controller == "error passive"
    line.send(error_frame(0x04, b"\x00\x40" + bytes(6)))
    assert port.receive(PATIENCE_S) is None
    assert port.controller == "ok"
    line.send(error_frame(0x40))
    with pytest.raises(DeviceError, match=r"virtual:\w+: bus-off: cable, terminators, bit rate"):
        port.receive(PATIENCE_S)


def test_a_closed_bus_is_lost(port: CanPort) -> None:
    port.close()
    with pytest.raises(DeviceError, match="cannot send"):
        port.send(Frame(0, b""))


def receive_for_ever(port: CanPort) -> None:
    while True:
        port.receive(0.05)


def test_an_slcan_adapter_passes_nothing_on_until_it_is_opened(tmp_path: Path) -> None:
    adapter = SlcanAdapter(tmp_path / "slcan")
    adapter.send(Frame(0x705, b"\x05"))
    port = CanPort(CanBus(interface="slcan", channel=str(tmp_path / "slcan")))
    while adapter.receive(0.05) is not None:
        pass
    adapter.send(Frame(0x285, b"\xab\xcd"))
    received = None
    while received is None:
        adapter.receive(0.0)  # the commands that open it
        adapter.send(Frame(0x285, b"\xab\xcd"))
        received = port.receive(0.05)
    assert received[0] == Frame(0x285, b"\xab\xcd")
    adapter.close()
    assert not (tmp_path / "slcan").is_symlink()
    with pytest.raises(DeviceError, match="lost the CAN interface"):
        receive_for_ever(port)
    port.close()

"""Wires carry every byte, whatever it is; and each fault does what it says, to real sockets and terminals."""

import os
import select
import socket
import termios
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from msgspec.structs import replace
from patience import PATIENCE_S, wait_until

from hw_profiles.profile import CanBus
from rtlog_client.can_wire import CanWire
from rtlog_client.faults import Fault
from rtlog_client.serial_wire import SerialWire
from rtlog_client.tcp_wire import TcpWire
from rtlog_client.wire import Wire
from rtlog_server.devices.cia406.port import CanPort
from rtlog_server.devices.cia406.protocol import Frame


def fault(kind: str, **more: float | str) -> Fault:
    return Fault(device="rfid", kind=kind, at_s=0.0, for_s=1.0, **more)  # type: ignore[arg-type]


class EchoDevice:
    """Sends back what it is sent, with its name before it."""

    def __init__(self, name: bytes = b"") -> None:
        self._name = name
        self.sent = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = self._listener.getsockname()
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._echo, args=(client,), daemon=True).start()

    def _echo(self, client: socket.socket) -> None:
        with client:
            try:
                while data := client.recv(65536):
                    client.sendall(self._name + data)
                    self.sent += len(data)
            except OSError:
                return

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()


@pytest.fixture
def device() -> Iterator[EchoDevice]:
    echo = EchoDevice()
    yield echo
    echo.close()


@pytest.fixture
def wire(device: EchoDevice) -> Iterator[TcpWire]:
    with TcpWire("rfid", ("127.0.0.1", 0)) as wire:
        wire.device = device.address
        yield wire


def call(wire: TcpWire) -> socket.socket:
    return socket.create_connection(wire.address, PATIENCE_S)


def receive(end: socket.socket, count: int) -> bytes:
    data = b""
    while len(data) < count and (more := end.recv(65536)):
        data += more
    return data


def hears(end: socket.socket, within_s: float) -> bool:
    return bool(select.select([end], [], [], within_s)[0])


def is_reset(end: socket.socket) -> bool:
    try:
        return end.recv(1) == b""
    except ConnectionResetError:
        return True


def test_every_byte_passes_in_order(wire: TcpWire) -> None:
    data = bytes(range(256)) * 8000
    with call(wire) as host:
        sender = threading.Thread(target=host.sendall, args=(data,))
        sender.start()
        assert receive(host, len(data)) == data
        sender.join()


def test_an_end_that_hangs_up_is_heard_at_the_other(wire: TcpWire) -> None:
    with call(wire) as host:
        host.sendall(b"last words")
        host.shutdown(socket.SHUT_WR)
        assert receive(host, 100) == b"last words"  # and then the end


def settle(wire: Wire) -> None:
    """Until what has come to the wire is dealt with: its thread does in turn what is there."""
    for _ in range(2):
        wire._call(lambda: None)


def test_what_is_dropped_never_comes(device: EchoDevice, wire: TcpWire) -> None:
    with call(wire) as host:
        wire.begin(fault("drop"))
        host.sendall(b"lost")
        wait_until(lambda: device.sent == 4)
        settle(wire)
        assert not hears(host, 0.2)
        wire.end()
        host.sendall(b"heard")
        assert receive(host, 5) == b"heard"


def test_what_is_delayed_comes_later_in_order(device: EchoDevice, wire: TcpWire) -> None:
    with call(wire) as host:
        wire.begin(fault("delay", by_s=0.3))
        began = time.monotonic()
        host.sendall(b"late")
        wait_until(lambda: device.sent == 4)
        settle(wire)
        wire.end()
        host.sendall(b"after")
        assert receive(host, 9) == b"lateafter"
        assert time.monotonic() - began >= 0.3


def test_noise_changes_its_share_of_the_bytes_the_same_each_time(device: EchoDevice) -> None:
    data = bytes(10_000)
    heard = []
    for _ in range(2):
        with TcpWire("rfid", ("127.0.0.1", 0), seed=3) as wire:
            wire.device = device.address
            with call(wire) as host:
                wire.begin(fault("garble", share=0.1))
                host.sendall(data)
                heard.append(receive(host, len(data)))
    assert len(heard[0]) == len(data)
    assert 800 < sum(byte != 0 for byte in heard[0]) < 1200
    assert heard[0] == heard[1]


def test_a_cut_holds_what_is_under_way_and_kills_what_was_tried(wire: TcpWire) -> None:
    with call(wire) as host:
        host.sendall(b"1")
        assert receive(host, 1) == b"1"
        wire.begin(fault("cut"))
        host.sendall(b"2")
        with call(wire) as tried:
            assert not hears(host, 0.2)
            wire.end()
            assert is_reset(tried)
        assert receive(host, 1) == b"2"
        with call(wire) as anew:
            anew.sendall(b"3")
            assert receive(anew, 1) == b"3"


def test_a_restart_resets_and_refuses_until_it_is_over(wire: TcpWire) -> None:
    with call(wire) as host:
        host.sendall(b"1")
        assert receive(host, 1) == b"1"
        wire.begin(fault("restart"))
        assert is_reset(host)
        with pytest.raises(ConnectionRefusedError):
            call(wire)
        wire.end()
        with call(wire) as anew:
            anew.sendall(b"2")
            assert receive(anew, 1) == b"2"


def test_a_swap_leads_to_the_other_device_and_back(wire: TcpWire) -> None:
    other_device = EchoDevice(b"other ")
    swapped = Fault(device="laser/primary", kind="swap", other="laser/auxiliary", at_s=0.0, for_s=1.0)
    with TcpWire("laser/auxiliary", ("127.0.0.1", 0)) as other:
        other.device = other_device.address
        with call(wire) as host:
            host.sendall(b"1")
            assert receive(host, 1) == b"1"
            wire.begin(swapped)
            wire.cross(other)
            assert is_reset(host)
        with call(wire) as host:
            host.sendall(b"2")
            assert receive(host, 7) == b"other 2"
            wire.end()
            assert is_reset(host)
        with call(wire) as host:
            host.sendall(b"3")
            assert receive(host, 1) == b"3"
    other_device.close()


def test_a_device_calls_its_host_back_through_the_wire(wire: TcpWire) -> None:
    with ExitStack() as stack:
        listener = stack.enter_context(socket.create_server(("127.0.0.1", 0)))
        device = stack.enter_context(wire.dial(listener.getsockname(), PATIENCE_S))
        host, peer = listener.accept()
        stack.enter_context(host)
        host.settimeout(PATIENCE_S)
        assert peer[0] == wire.address[0]
        device.sendall(b"read")
        assert receive(host, 4) == b"read"
        wire.begin(fault("drop"))
        device.sendall(b"lost")
        assert not hears(host, 0.2)


def test_an_address_that_is_taken_is_an_error(wire: TcpWire) -> None:
    with pytest.raises(OSError, match="in use"), TcpWire("laser/primary", wire.address):
        pass


# Serial


@pytest.fixture
def terminal(tmp_path: Path) -> Iterator[int]:
    """The emulator's end; its terminal is linked as `device`."""
    master, slave = os.openpty()
    tty.setraw(slave)
    (tmp_path / "device").symlink_to(os.ttyname(slave))
    yield master
    os.close(master)
    os.close(slave)


@pytest.fixture
def serial(tmp_path: Path, terminal: int) -> Iterator[SerialWire]:
    with SerialWire("encoders", tmp_path / "port", tmp_path / "device") as wire:
        yield wire


def open_port(tmp_path: Path) -> int:
    return os.open(tmp_path / "port", os.O_RDWR | os.O_NOCTTY)


def test_a_serial_wire_carries_both_ways_and_tells_the_speed(tmp_path: Path, terminal: int, serial: SerialWire) -> None:
    port = open_port(tmp_path)
    attributes = termios.tcgetattr(port)
    attributes[4] = attributes[5] = termios.B115200
    termios.tcsetattr(port, termios.TCSANOW, attributes)
    os.write(port, b"\x10\x00\xff")
    assert os.read(terminal, 3) == b"\x10\x00\xff"
    assert termios.tcgetattr(terminal)[4:6] == [termios.B115200] * 2
    os.write(terminal, b"\x0a\x0d")
    assert os.read(port, 2) == b"\x0a\x0d"
    os.close(port)


def test_a_pulled_adapter_hangs_up_and_comes_back_under_its_name(
    tmp_path: Path, terminal: int, serial: SerialWire
) -> None:
    port = open_port(tmp_path)
    serial.begin(fault("cut"))
    assert not (tmp_path / "port").exists()
    with pytest.raises(OSError, match="Input/output error"):
        os.write(port, b"x")
    os.close(port)
    serial.end()
    port = open_port(tmp_path)
    os.write(port, b"y")
    assert os.read(terminal, 1) == b"y"
    os.close(port)


def test_an_encoder_without_power_is_silent_behind_its_adapter(
    tmp_path: Path, terminal: int, serial: SerialWire
) -> None:
    port = open_port(tmp_path)
    serial.begin(fault("restart"))
    os.write(port, b"x")
    assert not select.select([terminal], [], [], 0.2)[0]
    settle(serial)
    serial.end()
    os.write(port, b"y")
    assert os.read(terminal, 8) == b"y"
    os.close(port)


def test_what_is_no_link_is_left_alone(tmp_path: Path, terminal: int) -> None:
    (tmp_path / "port").write_text("somebody's")
    with pytest.raises(FileExistsError, match="in the way"), SerialWire("e", tmp_path / "port", tmp_path / "device"):
        pass
    assert (tmp_path / "port").read_text() == "somebody's"


# CAN


def free_udp_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        return int(probe.getsockname()[1])


def test_frames_pass_both_ways_on_can_and_none_in_a_cut() -> None:
    bus = CanBus(channel="239.74.163.2", interface="udp_multicast", udp_port=free_udp_port())
    beyond = replace(bus, udp_port=free_udp_port())
    with CanWire("encoders", bus, beyond.udp_port) as wire, ExitStack() as stack:
        host, device = CanPort(bus), CanPort(beyond)
        stack.callback(host.close)
        stack.callback(device.close)

        def passes(sender: CanPort, receiver: CanPort, frame: Frame, within_s: float) -> bool:
            sender.send(frame)
            deadline = time.monotonic() + within_s
            while (received := receiver.receive(max(0.0, deadline - time.monotonic()))) is not None:
                if (received[0].can_id, received[0].data) == (frame.can_id, frame.data):  # it hears its own as well
                    return True
            return False

        assert passes(host, device, Frame(0x605, b"\x40\x00\x10"), PATIENCE_S)
        assert passes(device, host, Frame(0x185, bytes(8)), PATIENCE_S)
        assert (
            sum(device.receive(0.1) is not None for _ in range(20)) <= 2
        )  # its own, and none that goes round for ever
        wire.begin(fault("cut"))
        assert not passes(device, host, Frame(0x185, b"\x01"), 0.2)
        wire.end()
        assert passes(device, host, Frame(0x185, b"\x02"), PATIENCE_S)

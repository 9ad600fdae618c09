"""The reader's driver against an emulated ALR-9650, over real sockets."""

import math
import socket
import time
from collections.abc import Callable, Iterator

import pytest

from hw_profiles.profile import RfidDevice
from rtlog_server.devices.alien import driver, protocol
from rtlog_server.devices.alien.driver import Alr9650
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.device import TickGrid
from rtlog_server.devices.rfid import TagSample
from rtlog_server.messages import MISSING, OK, STALE

EPCS = [f"E2000016591900781840{number:04X}" for number in range(5)]


@pytest.fixture
def emulator() -> Iterator[Alr9650Emulator]:
    with Alr9650Emulator() as emulated:
        yield emulated


class Reader:
    """A running driver and what it has handed over so far."""

    def __init__(self, port: int, **settings: object) -> None:
        self.device = Alr9650("rfid", RfidDevice(host="127.0.0.1", port=port, **settings))  # type: ignore[arg-type]
        self.samples: list[TagSample] = []
        self.device.start(TickGrid(time.monotonic_ns(), 100_000_000))

    def wait_for(self, condition: Callable[[], bool], timeout_s: float = 6.0) -> None:
        deadline_s = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline_s, f"{self.device.message}; {self.device.diagnostics}; {self.samples}"
            time.sleep(0.005)
            self.collect()

    def collect(self) -> int:
        collected = self.device.collect(time.monotonic_ns())
        self.samples += collected.samples
        return collected.state

    def wait_until_reading(self, stream: str = "open") -> None:
        self.wait_for(lambda: self.device.connected and self.device.diagnostics.get("stream") == stream)


@pytest.fixture
def start() -> Iterator[Callable[..., Reader]]:
    readers: list[Reader] = []

    def start_reader(port: int, **settings: object) -> Reader:
        readers.append(Reader(port, **settings))
        return readers[-1]

    yield start_reader
    for reader in readers:
        reader.device.close()


def talk(client: socket.socket, line: str) -> str:
    """Send a line to the console, read on to the NUL of its reply."""
    client.sendall(line.encode() + b"\r\n")
    return read_piece(client)


def read_piece(client: socket.socket) -> str:
    data = b""
    while not data.endswith(b"\0"):
        received = client.recv(1)
        assert received, data
        data += received
    return data.decode()


def test_reads_arrive_whole_and_in_order(emulator: Alr9650Emulator, start: Callable[..., Reader]) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    sent = [(EPCS[number % 5], number % 2, -40.0 - number / 10, 1 + number % 3) for number in range(200)]
    before_ns = time.monotonic_ns()
    for epc, antenna, rssi, count in sent:
        emulator.read_tag(epc, antenna, rssi, count)
    reader.wait_for(lambda: len(reader.samples) == len(sent))
    assert [(s.epc, s.antenna, s.rssi, s.count) for s in reader.samples] == [
        (epc, antenna, pytest.approx(rssi), count) for epc, antenna, rssi, count in sent
    ]
    for sample in reader.samples:
        assert before_ns < sample.measured_ns == sample.complete_ns < time.monotonic_ns()
        assert sample.reader_ms is not None
        assert sample.reader_ms < 3600_000  # the reader's clock starts in 1970; ours does not
    assert reader.collect() == OK
    assert reader.device.message == "connected"
    assert reader.device.identity["ReaderType"].startswith("Alien RFID Tag Reader, Model: ALR-9650")


def test_a_read_is_told_within_milliseconds(emulator: Alr9650Emulator, start: Callable[..., Reader]) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    latencies_ns = []
    for number in range(21):
        read_ns = time.monotonic_ns()
        emulator.read_tag(EPCS[0])
        reader.wait_for(lambda: len(reader.samples) > number)  # noqa: B023
        latencies_ns.append(reader.samples[-1].measured_ns - read_ns)
    assert sorted(latencies_ns)[10] < 10_000_000


def test_a_reader_without_rssi_gives_nan(emulator: Alr9650Emulator, start: Callable[..., Reader]) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    emulator.read_tag(EPCS[0], rssi=math.nan)
    reader.wait_for(lambda: len(reader.samples) == 1)
    assert math.isnan(reader.samples[0].rssi)


def test_whatever_state_the_reader_was_left_in_is_taken_over(
    emulator: Alr9650Emulator, start: Callable[..., Reader]
) -> None:
    for command in (
        "set NotifyMode = ON",
        "set TagListFormat = XML",
        "set TagStreamFormat = Terse",
        "set TagStreamCustomFormat = %i",
        "set TagStreamAddress = 127.0.0.1:9",
        "set TagStreamMode = ON",
        "set AutoMode = ON",
        "set AutoStopTimer = 5000",
        "set PersistTime = -1",
    ):
        assert not protocol.is_error(emulator.configure(command))
    emulator.read_tag("0BAD")  # long ago, still on its list
    reader = start(emulator.port)
    reader.wait_until_reading()
    emulator.read_tag(EPCS[1])
    reader.wait_for(lambda: any(sample.epc == EPCS[1] for sample in reader.samples))
    assert [sample.epc for sample in reader.samples] == [EPCS[1]]
    assert emulator.configure("get NotifyMode") == "NotifyMode = OFF"
    assert emulator.configure("get AutoStopTimer") == "AutoStopTimer = 0"


def test_a_setting_that_the_reader_lacks_is_told_and_survived(
    emulator: Alr9650Emulator, start: Callable[..., Reader], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "SETTINGS", (("AcqG2AntennaCombine", "OFF"), *driver.SETTINGS))
    reader = start(emulator.port)
    reader.wait_until_reading()
    assert reader.device.diagnostics["refused settings"] == "AcqG2AntennaCombine"
    emulator.read_tag(EPCS[0])
    reader.wait_for(lambda: len(reader.samples) == 1)


def test_a_reader_that_lost_its_power_is_read_again_within_two_seconds(
    emulator: Alr9650Emulator, start: Callable[..., Reader]
) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    emulator.read_tag(EPCS[0], count=7)
    reader.wait_for(lambda: len(reader.samples) == 1)
    emulator.power_off()
    reader.wait_for(lambda: reader.collect() == MISSING)
    reader.wait_for(lambda: "Connection refused" in reader.device.message)
    emulator.power_on()
    back_s = time.monotonic()
    reader.wait_until_reading()
    assert time.monotonic() - back_s < 2.0
    emulator.read_tag(EPCS[0], count=9)
    reader.wait_for(lambda: len(reader.samples) == 2)
    assert [sample.count for sample in reader.samples] == [7, 9]
    assert reader.device.connects == 2


def test_the_driver_may_start_before_the_reader_is_there(start: Callable[..., Reader]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as reserved:
        port = reserved.getsockname()[1]
    reader = start(port)
    reader.wait_for(lambda: reader.device.message == f"127.0.0.1:{port}: no connection: Connection refused")
    with Alr9650Emulator(port=port):
        reader.wait_until_reading()


def test_a_busy_console_is_told_and_tried_again(emulator: Alr9650Emulator, start: Callable[..., Reader]) -> None:
    with socket.create_connection(("127.0.0.1", emulator.port)) as other:
        read_piece(other)  # another client is greeted first
        reader = start(emulator.port)
        reader.wait_for(lambda: "busy with another client" in reader.device.message)
        assert reader.collect() == MISSING
    reader.wait_until_reading()


def test_a_driver_that_ends_leaves_the_console_free(emulator: Alr9650Emulator, start: Callable[..., Reader]) -> None:
    for _ in range(3):
        reader = start(emulator.port)
        reader.wait_until_reading()
        reader.device.close()
        assert reader.device.connects == 1


def test_the_console_is_left_with_a_goodbye(start: Callable[..., Reader]) -> None:
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


def test_without_a_stream_the_tag_list_is_polled_until_there_is_one(
    emulator: Alr9650Emulator, start: Callable[..., Reader], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "STREAM_WAIT_S", 0.3)
    emulator.refuse_stream = True
    emulator.configure("set AutoMode = ON")
    emulator.read_tag("0BAD")  # is on the list already, and nowhere near when we come
    reader = start(emulator.port)
    reader.wait_until_reading(stream="polling")
    assert "opens no tag stream to 127.0.0.1:" in reader.device.message
    for count in (2, 3):
        emulator.read_tag(EPCS[0], count=count)
        emulator.read_tag(EPCS[1], antenna=1)
        wanted = len(reader.samples) + 2
        reader.wait_for(lambda: len(reader.samples) == wanted)  # noqa: B023
    time_ns = time.monotonic_ns()
    reader.wait_for(lambda: time.monotonic_ns() - time_ns > 300_000_000)  # three polls more
    assert [(sample.epc, sample.count) for sample in reader.samples] == [
        (EPCS[0], 2),
        (EPCS[1], 1),
        (EPCS[0], 3),
        (EPCS[1], 1),
    ]
    assert reader.collect() == OK
    emulator.refuse_stream = False
    reader.wait_until_reading(stream="open")
    emulator.read_tag(EPCS[2])
    reader.wait_for(lambda: any(sample.epc == EPCS[2] for sample in reader.samples))
    assert len(reader.samples) == 5  # what both tell of a tag counts once
    reader.wait_for(lambda: reader.device.message == "connected")


def test_a_stream_that_idles_out_and_comes_back_loses_nothing(
    emulator: Alr9650Emulator, start: Callable[..., Reader], monkeypatch: pytest.MonkeyPatch
) -> None:
    idle = tuple((name, "0" if name == "TagStreamKeepAliveTime" else value) for name, value in driver.SETTINGS)
    monkeypatch.setattr(driver, "SETTINGS", idle)
    reader = start(emulator.port)
    reader.wait_until_reading(stream="waiting")
    for epc in EPCS:
        emulator.read_tag(epc)
        reader.wait_for(lambda: reader.samples != [] and reader.samples[-1].epc == epc)  # noqa: B023
        reader.wait_until_reading(stream="waiting")
    assert len(reader.samples) == len(EPCS)


def test_a_console_that_fell_silent_is_stale_and_then_left(
    emulator: Alr9650Emulator, start: Callable[..., Reader], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "ALIVE_S", 0.2)
    monkeypatch.setattr(driver, "REPLY_S", 1.0)
    reader = start(emulator.port)
    reader.wait_until_reading()
    emulator.silent = True
    reader.wait_for(lambda: reader.collect() == STALE)
    reader.wait_for(lambda: "silent for 1 s" in reader.device.message)
    assert not reader.device.connected
    emulator.silent = False
    reader.wait_until_reading()


def test_a_wrong_password_is_told(emulator: Alr9650Emulator, start: Callable[..., Reader]) -> None:
    reader = start(emulator.port, password="wrong")
    reader.wait_for(lambda: "refuses user name 'alien'" in reader.device.message)
    sly = start(emulator.port, username="alien\r\nset AutoMode = OFF")
    sly.wait_for(lambda: "printable ASCII" in sly.device.message)


def test_a_stream_of_garbage_is_counted_and_harms_nothing(
    emulator: Alr9650Emulator, start: Callable[..., Reader]
) -> None:
    reader = start(emulator.port)
    reader.wait_until_reading()
    host, port = reader.device.diagnostics["stream address"].split(":")
    with socket.create_connection((host, int(port))) as sly:
        sly.sendall(b"\xff\xfe\0garbage;;;\r\nE2001;1;2;0;-1;3\r\n")
        reader.wait_for(lambda: len(reader.samples) == 1)
        sly.sendall(b"x" * 10_000)
        reader.wait_for(lambda: reader.device.diagnostics["last garbled"].startswith("more than 4096 bytes"))
    assert [sample.epc for sample in reader.samples] == ["E2001"]
    assert reader.device.diagnostics["garbled"] == "2"
    emulator.read_tag(EPCS[0])
    reader.wait_for(lambda: reader.samples[-1].epc == EPCS[0])
    assert reader.device.connects == 1


def test_a_stream_port_that_is_taken_is_told(emulator: Alr9650Emulator, start: Callable[..., Reader]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        reader = start(emulator.port, stream_port=port)
        reader.wait_for(lambda: f"stream_port {port}: cannot listen: Address already in use" in reader.device.message)
    reader.wait_until_reading()
    assert reader.device.diagnostics["stream address"] == f"127.0.0.1:{port}"


@pytest.mark.parametrize("garbage", [b"", b"\0" * 1000, b"Username>\0Password>\0" * 50, b"\xff" * 70_000])
def test_a_peer_that_is_no_reader_gives_one_line(start: Callable[..., Reader], garbage: bytes) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        reader = start(server.getsockname()[1])
        peer, _ = server.accept()
        peer.sendall(garbage)
        peer.close()
        reader.wait_for(lambda: reader.device.message != "not connected yet")
        assert reader.device.message.startswith("127.0.0.1:")
        assert "\n" not in reader.device.message
        assert not reader.device.connected


def test_the_emulators_console_talks_as_the_manual_says(emulator: Alr9650Emulator) -> None:
    with socket.create_connection(("127.0.0.1", emulator.port)) as client:
        greeting = read_piece(client)
        assert "* Alien Technology : RFID Reader" in greeting
        assert greeting.endswith("\r\nUsername>\0")
        assert talk(client, "Alien").endswith("Password>\0")  # the user name is case sensitive
        assert "Error: Invalid Username and/or Password" in talk(client, "password")
        assert talk(client, "alien").endswith("Password>\0")
        assert talk(client, "password").endswith("Alien>\0")
        assert talk(client, "\x01get ReaderName") == "ReaderName = Alien RFID Reader\r\n\0"
        assert talk(client, "\x01GET readername") == "ReaderName = Alien RFID Reader\r\n\0"
        assert talk(client, "\x01ReaderName?") == "ReaderName = Alien RFID Reader\r\n\0"
        assert talk(client, "\x01") == "\r\n\0"
        assert talk(client, "\x01set AcqG2AntennaCombine = OFF") == "Error 1: Command not understood.\r\n\0"
        assert talk(client, "\x01set AutoMode = MAYBE") == "Error 4: Invalid use of command.\r\n\0"
        assert talk(client, "\x01set ReaderType = mine") == "Error 4: Invalid use of command.\r\n\0"
        assert talk(client, "\x01t") == "(No Tags)\r\n\0"
        assert talk(client, "\x01AutoMode=ON") == "AutoMode = ON\r\n\0"
        emulator.read_tag("1115F26881C3C012", count=4)
        assert talk(client, "\x01get TagList").startswith("Tag:1115 F268 81C3 C012, Disc:1970/01/01 00:00:0")
        assert talk(client, "get AutoMode") == "get AutoMode\r\nAutoMode = ON\r\n\0"  # with echo
        assert read_piece(client) == "\r\nAlien>\0"  # and prompt
        assert talk(client, "\x01Quit") == "Goodbye!\r\n\0"
        assert client.recv(1) == b""

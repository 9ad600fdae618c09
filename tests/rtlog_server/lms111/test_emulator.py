"""The emulated scanner as a client of its port sees it."""

import random
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from patience import PATIENCE_S

from rtlog_server.devices.lms111.cola import Dialect, Receiver, frame
from rtlog_server.devices.lms111.emulated_sweep import quantise_ranges
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.devices.lms111.protocol import AUTHORISED_CLIENT, Command, decode, encode_command
from rtlog_server.devices.lms111.scan_data import ScanData

MS = 1_000_000
STEP_RAD = np.radians(0.5)


class Client:
    """Asks and waits for the next telegram."""

    def __init__(self, emulator: Lms111Emulator, dialect: Dialect = Dialect.B) -> None:
        self.socket = socket.create_connection(emulator.address, PATIENCE_S)
        self.dialect = dialect
        self._receiver = Receiver(dialect)
        self._payloads: list[bytes] = []

    def next(self) -> Command | ScanData:
        while not self._payloads:
            data = self.socket.recv(65536)
            assert data, "the emulator hung up"
            self._payloads += self._receiver.feed(data)
        return decode(self.dialect, self._payloads.pop(0))

    def ask(self, command: str, *values: int) -> tuple[str, tuple]:
        self.socket.sendall(encode_command(self.dialect, command, *values))
        reply = self.next()
        assert isinstance(reply, Command)
        return reply.name, reply.values


Connect = Callable[..., Client]


@pytest.fixture
def connect() -> Iterator[Connect]:
    clients: list[Client] = []

    def connect(*arguments: Any) -> Client:
        clients.append(Client(*arguments))
        return clients[-1]

    yield connect
    for client in clients:
        client.socket.close()


@pytest.fixture
def emulator() -> Iterator[Lms111Emulator]:
    with Lms111Emulator() as emulator:
        yield emulator


@pytest.mark.parametrize("dialect", list(Dialect))
def test_nothing_is_changed_without_a_login(dialect: Dialect, connect: Connect) -> None:
    with Lms111Emulator(dialect=dialect.name) as emulator:
        client = connect(emulator, dialect)
        assert client.ask("sRN SCdevicestate") == ("sRA SCdevicestate", (1,))
        assert client.ask("sWN LMPoutputRange", 1, 5000, 0, 1800000) == ("sFA", (10,))
        assert client.ask("sMN mLMPsetscancfg", 5000, 1, 5000, -450000, 2250000) == ("sFA", (1,))
        assert client.ask("sMN SetAccessMode", 3, 0x12345678) == ("sAN SetAccessMode", (0,))
        assert client.ask("sMN SetAccessMode", *AUTHORISED_CLIENT) == ("sAN SetAccessMode", (1,))
        assert client.ask("sRN SCdevicestate") == ("sRA SCdevicestate", (0,))
        assert client.ask("sWN LMPoutputRange", 1, 5000, 0, 1800000) == ("sWA LMPoutputRange", ())
        assert client.ask("sRN LMPoutputRange") == ("sRA LMPoutputRange", (1, 5000, 0, 1800000))
        assert client.ask("sMN Run") == ("sAN Run", (1,))
        assert client.ask("sWN LMPoutputRange", 1, 5000, 0, 1800000) == ("sFA", (10,))


def test_measuring_stops_for_a_new_frequency_and_starts_on_command(emulator: Lms111Emulator, connect: Connect) -> None:
    client = connect(emulator)
    client.ask("sMN SetAccessMode", *AUTHORISED_CLIENT)
    assert client.ask("sRN STlms") == ("sRA STlms", (7, 0))
    assert client.ask("sMN mLMPsetscancfg", 5000, 1, 2500, -450000, 2250000)[1][0] == 3  # no such pair
    assert client.ask("sRN STlms") == ("sRA STlms", (7, 0))
    assert client.ask("sMN mLMPsetscancfg", 5000, 1, 5000, -450000, 2250000)[1][0] == 0
    assert client.ask("sRN STlms") == ("sRA STlms", (3, 0))
    assert client.ask("sMN LMCstartmeas") == ("sAN LMCstartmeas", (0,))
    assert client.ask("sRN STlms") == ("sRA STlms", (7, 0))
    assert client.ask("sMN LMCstopmeas") == ("sAN LMCstopmeas", (0,))
    assert client.ask("sRN STlms") == ("sRA STlms", (3, 0))


def test_what_it_does_not_know_is_an_error(emulator: Lms111Emulator, connect: Connect) -> None:
    client = connect(emulator)
    assert client.ask("sRN field000") == ("sFA", (3,))
    assert client.ask("sMN mSCloadfacdef") == ("sFA", (2,))
    assert client.ask("sRN LMDscandata") == ("sFA", (4,))  # no scan yet
    client.socket.sendall(frame(Dialect.B, b"sMN SetAccessMode \x03"))
    assert client.next() == Command("sFA", (5,))
    client.socket.sendall(frame(Dialect.B, b"sRA STlms \x07"))
    assert client.next() == Command("sFA", (5,))


def test_one_client_at_a_time(emulator: Lms111Emulator, connect: Connect) -> None:
    first = connect(emulator)
    first.ask("sRN STlms")
    with pytest.raises((ConnectionError, AssertionError)):
        connect(emulator).ask("sRN STlms")
    first.ask("sRN STlms")
    first.socket.close()
    connect(emulator).ask("sRN STlms")


def test_a_scan_goes_to_who_asked_for_it_after_its_last_ray(emulator: Lms111Emulator, connect: Connect) -> None:
    client = connect(emulator)
    emulator.send_scan(np.full(541, 3.0), time.monotonic_ns() - 100 * MS, -2.356, STEP_RAD)  # nobody asked
    client.ask("sRN STlms")
    assert not emulator.wait_streaming(0)
    assert client.ask("sEN LMDscandata", 1) == ("sEA LMDscandata", (1,))
    assert emulator.wait_streaming(PATIENCE_S)
    first_ray_ns = time.monotonic_ns() + 20 * MS
    emulator.send_scan(np.full(541, 3.0), first_ray_ns, np.radians(-135), STEP_RAD, np.full(541, 7.0))
    scan = client.next()
    assert isinstance(scan, ScanData)
    assert time.monotonic_ns() >= first_ray_ns + 30 * MS  # 270° of 360° in the factory's 40 ms
    assert scan.telegram_counter == 1
    assert scan.scan_frequency_centihz == 2500
    assert [channel.content for channel in scan.channels16] == ["DIST1"]  # remission was not asked for
    (distances,) = scan.channels16
    assert (distances.start_angle_1e4deg, distances.angular_step_1e4deg) == (-450_000, 5000)
    assert distances.data.tolist() == 541 * [3000]
    assert scan.time_of_transmission_us - scan.time_since_startup_us > 30_000
    client.socket.sendall(encode_command(Dialect.B, "sRN LMDscandata"))
    newest = client.next()
    assert isinstance(newest, ScanData)
    assert newest.telegram_counter == 1
    assert client.ask("sEN LMDscandata", 0) == ("sEA LMDscandata", (0,))
    assert not emulator.wait_streaming(0)


def test_a_sweep_may_be_written_over_once_it_is_given(emulator: Lms111Emulator, connect: Connect) -> None:
    client = connect(emulator)
    client.ask("sEN LMDscandata", 1)
    ranges = np.full(3, 2.0)
    emulator.send_scan(ranges, time.monotonic_ns() + 20 * MS, 0.0, STEP_RAD)
    ranges[:] = 5.0
    scan = client.next()
    assert isinstance(scan, ScanData)
    assert scan.channels16[0].data.tolist() == [2000, 2000, 2000]


def test_remission_as_it_was_asked_for(emulator: Lms111Emulator, connect: Connect) -> None:
    client = connect(emulator)
    client.ask("sMN SetAccessMode", *AUTHORISED_CLIENT)
    client.ask("sEN LMDscandata", 1)
    for in_16_bit, expected in ((1, [0, 300, 65535]), (0, [0, 255, 255])):
        client.ask("sWN LMDscandatacfg", 1, 0, 1, in_16_bit, 0, 0, 0, 0, 0, 0, 0, 1)
        emulator.send_scan([1.0, 1.0, 1.0], time.monotonic_ns(), 0.0, STEP_RAD, [-1.0, 300.0, 1e6])
        scan = client.next()
        assert isinstance(scan, ScanData)
        remission = scan.channel("RSSI1")
        assert remission is not None
        assert remission.data.tolist() == expected
        assert remission.data.dtype == (np.uint16 if in_16_bit else np.uint8)


def test_the_clock_drifts_and_wraps(connect: Connect) -> None:
    with Lms111Emulator(clock_offset_us=2**32 - 1000, clock_drift_ppm=1000.0) as emulator:
        client = connect(emulator)
        client.ask("sEN LMDscandata", 1)
        first_ray_ns = time.monotonic_ns()
        emulator.send_scan([1.0], first_ray_ns, np.radians(-135), STEP_RAD)
        emulator.send_scan([1.0], first_ray_ns + 100 * MS, np.radians(-135), STEP_RAD)
        a, b = client.next(), client.next()
        assert isinstance(a, ScanData)
        assert isinstance(b, ScanData)
        assert (b.time_since_startup_us - a.time_since_startup_us) % 2**32 == pytest.approx(100_100, abs=1)
        assert b.time_since_startup_us < 2**31


def test_the_dialect_changes_with_the_next_connection(emulator: Lms111Emulator, connect: Connect) -> None:
    client = connect(emulator)
    client.ask("sMN SetAccessMode", *AUTHORISED_CLIENT)
    assert client.ask("sWN EIHstCola", 0) == ("sWA EIHstCola", ())
    assert client.ask("sRN EIHstCola") == ("sRA EIHstCola", (0,))
    client.socket.close()
    assert connect(emulator, Dialect.A).ask("sRN STlms") == ("sRA STlms", (7, 0))


def test_quantised_ranges() -> None:
    ranges = [np.inf, np.nan, -np.inf, -1.0, 0.0, 0.015, 0.0156, 1.2345, 65.535, 65.6, 1e30]
    assert quantise_ranges(np.array(ranges)).tolist() == [0, 3, 3, 3, 3, 3, 16, 1234, 65535, 0, 0]


@pytest.mark.parametrize(
    ("ranges", "start", "step", "intensities"),
    [
        ([[1.0]], 0.0, 0.1, None),
        ([1.0], 0.0, 0.0, None),
        ([1.0], 0.0, -0.1, None),
        ([1.0], 0.0, 1.0, None),
        ([1.0], np.nan, 0.1, None),
        ([1.0], 0.0, 0.1, [1.0, 2.0]),
        (np.ones(20_000), 0.0, 0.1, None),
    ],
)
def test_impossible_sweeps(
    ranges: list[float], start: float, step: float, intensities: list[float] | None, emulator: Lms111Emulator
) -> None:
    with pytest.raises(ValueError, match=r"sweep|rays"):
        emulator.send_scan(ranges, 0, start, step, intensities)


def test_no_bytes_from_a_client_disturb_it(emulator: Lms111Emulator, connect: Connect) -> None:
    noise = random.Random(1)
    commands = [
        b"sRN ",
        b"sWN LMDscandatacfg",
        b"sEN LMDscandata",
        b"sMN x",
        b"sSN LMDscandata ",
        b"sFA",
        b"sAN Run",
        b"",
    ]
    client = connect(emulator)
    for _ in range(300):
        payload = noise.choice(commands) + noise.randbytes(noise.randrange(1, 20))
        client.socket.sendall(frame(Dialect.B, payload) if noise.random() < 0.7 else payload)
    client.socket.close()
    assert connect(emulator).ask("sRN STlms") == ("sRA STlms", (7, 0))

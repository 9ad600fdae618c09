"""What tests of the whole server share: profiles, emulated devices, the server as a process, a zenoh client of it."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import zenoh
from patience import PATIENCE_S, Told, wait_until

from rtlog_server.attachment import Attachment, unpack_attachment
from rtlog_server.devices.alien.emulator import Alr9650Emulator
from rtlog_server.devices.device import Device, TickGrid
from rtlog_server.devices.encoders import EncoderReading
from rtlog_server.devices.lms111.emulator import Lms111Emulator
from rtlog_server.devices.sei.emulator import SeiBusEmulator

sys.path.insert(0, str(Path(__file__).parent))  # wheels.py

PROFILE = """\
schema = 1
name = "{name}"
tick_period_s = {tick_period_s}
[vehicle]
kinematics = "differential"
track_width_m = 1.6
[lasers.primary]
device = {{ host = "127.0.0.1", port = {laser_port} }}
{auxiliary_laser}
[[encoders]]
name = "left_wheel"
role = "left_wheel"
wheel_radius_m = 0.35
address = 0
[[encoders]]
name = "right_wheel"
role = "right_wheel"
wheel_radius_m = 0.35
address = 1
[encoder_bus]
kind = "sei"
port = "{encoder_port}"
[rfid]
device = {{ host = "127.0.0.1", port = {rfid_port} }}
[zenoh]
listen = ["tcp/127.0.0.1:{zenoh_port}"]
"""


def find_free_port() -> int:
    """A TCP port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Received:
    key: str
    attachment: Attachment | None
    payload: bytes
    encoding: str


@dataclass
class Server:
    """A server process and a zenoh client of it."""

    process: subprocess.Popen[bytes]
    started_ns: int  # UTC
    stderr: Path
    name: str
    session: zenoh.Session
    received: list[Received] = field(default_factory=list)

    @staticmethod
    def wait_until(condition: Callable[[], bool]) -> None:
        wait_until(condition)

    def get(self, name: str) -> zenoh.Sample:
        """The one reply to a query."""
        replies = [reply.ok for reply in self.session.get(f"rtlog/{self.name}/{name}", timeout=PATIENCE_S)]
        assert len(replies) == 1
        assert replies[0] is not None
        return replies[0]

    def status(self) -> dict:
        return json.loads(self.get("@status").payload.to_string())

    def on(self, topic: str) -> list[Received]:
        return [sample for sample in list(self.received) if sample.key == f"rtlog/{self.name}/{topic}"]

    def terminate(self) -> int:
        """The exit status."""
        self.process.terminate()
        return self.process.wait(timeout=PATIENCE_S)

    def children(self) -> list[int]:
        """The ids of the processes that the server started."""
        path = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        return [int(child) for child in path.read_text().split()]

    def publisher_id(self) -> int:
        """The id of the publishing process."""
        (child,) = self.children()
        return child


def connect_client(zenoh_port: int) -> zenoh.Session:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["tcp/127.0.0.1:{zenoh_port}"]')
    config.insert_json5("connect/retry", "{ period_init_ms: 50, period_max_ms: 50 }")
    config.insert_json5("connect/timeout_ms", f"{PATIENCE_S * 1e3:.0f}")
    for switch in ("scouting/multicast", "scouting/gossip", "transport/shared_memory"):
        config.insert_json5(f"{switch}/enabled", "false")
    return zenoh.open(config)


def run_server(folder: Path, toml: str, name: str, zenoh_port: int) -> Generator[Server]:
    profile, stderr = folder / "profile.toml", folder / "stderr.txt"
    profile.write_text(toml, encoding="utf-8")
    command = [sys.executable, "-m", "rtlog_server.cli", "run", "--profile", str(profile)]
    started_ns = time.time_ns()
    with stderr.open("wb") as sink:
        # a session of its own, as under systemd: the signals of this test process's terminal do not reach it
        process = subprocess.Popen(command, stderr=sink, start_new_session=True)
    session = None
    try:
        session = connect_client(zenoh_port)
        server = Server(process, started_ns, stderr, name, session)
        for key in (f"rtlog/{name}/**", f"rtlog/{name}/@heartbeat"):
            session.declare_subscriber(key, lambda sample: server.received.append(_received(sample)))
        yield server
    finally:
        if session is not None:
            session.close()
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _received(sample: zenoh.Sample) -> Received:
    attachment = unpack_attachment(sample.attachment.to_bytes()) if sample.attachment else None
    return Received(str(sample.key_expr), attachment, sample.payload.to_bytes(), str(sample.encoding))


class Drive:
    """Three emulators, and a thread that lets scanner and reader measure: scan k has all ranges 1 m + k mm."""

    RAYS, STEP_RAD = 541, math.radians(0.5)
    COUNTS_PER_TURN = 4096
    TURNS_PER_S: ClassVar = {0: 0.8, 1: -0.3}  # by encoder address

    def __init__(self, folder: Path) -> None:
        self.laser = Lms111Emulator()
        encoders = dict.fromkeys(self.TURNS_PER_S, self.COUNTS_PER_TURN)
        self.encoders = SeiBusEmulator(folder / "sei", encoders, self._counts)
        self.rfid = Alr9650Emulator()
        self.places = {
            "laser_port": self.laser.address[1],
            "encoder_port": folder / "sei",
            "rfid_port": self.rfid.port,
        }
        self.first_rays_ns: list[int] = []
        self.scan_s = 0.02
        self.tag_reads = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._measure)
        self._thread.start()

    def _counts(self, address: int, now_ns: int) -> int:
        return round(self.TURNS_PER_S[address] * self.COUNTS_PER_TURN * now_ns * 1e-9)

    def _measure(self) -> None:
        due_ns = time.monotonic_ns()
        while not self._stopping.wait(max(0.0, (due_ns - time.monotonic_ns()) * 1e-9)):
            ranges_m = np.full(self.RAYS, 1.0 + len(self.first_rays_ns) * 1e-3)
            self.first_rays_ns.append(due_ns)  # a motor keeps its pace, whenever this thread wakes up
            due_ns += int(self.scan_s * 1e9)
            start_rad, remission = math.radians(-135), np.full(self.RAYS, 100.0)
            self.laser.send_scan(ranges_m, self.first_rays_ns[-1], start_rad, self.STEP_RAD, remission)

    def late_ns(self, positions_rad: np.ndarray, stamp_ns: int) -> np.ndarray:
        """(W,) after the stamp, each wheel was at its position; in less than half a turn's time."""
        turns_per_ns = np.array(list(self.TURNS_PER_S.values())) * 1e-9
        turns = positions_rad / (2 * math.pi) - turns_per_ns * stamp_ns
        return (turns - np.round(turns)) / turns_per_ns

    def read_tag(self, epc: str) -> None:
        self.rfid.read_tag(epc)
        self.tag_reads += 1

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        for emulator in (self.laser, self.encoders, self.rfid):
            emulator.close()


class EncoderHost:
    """A running driver of encoders, collected at each tick."""

    def __init__(self, device: Device[EncoderReading], period_ns: int) -> None:
        self.grid = TickGrid(time.monotonic_ns(), period_ns)
        self.device = device
        self.told = Told(device)
        self.device.start(self.grid)
        self.readings: list[EncoderReading] = []

    def wait_for(self, condition: Callable[[], bool]) -> None:
        """Collect at each tick until the condition holds."""
        deadline_ns = time.monotonic_ns() + int(PATIENCE_S * 1e9)
        while not condition():
            tick_ns = self.grid.next_after(time.monotonic_ns())
            assert tick_ns < deadline_ns, f"{self.device.message}; {self.device.diagnostics}"
            time.sleep(max(0, tick_ns - time.monotonic_ns()) * 1e-9)
            self.readings += self.device.collect(tick_ns).samples

    def wait_for_readings(self, number: int) -> list[EncoderReading]:
        """The next so many."""
        first = len(self.readings)
        self.wait_for(lambda: len(self.readings) >= first + number)
        return self.readings[first:]

    def assert_one_a_tick(self) -> None:
        """At most: a round that comes late delays none of the others, and none is asked twice for a tick."""
        ticks = (self.readings[-1].complete_ns - self.grid.start_ns) // self.grid.period_ns + 2
        assert len(self.readings) <= ticks

    def wait_for_all(self) -> EncoderReading:
        """The next reading that no encoder is missing in; on a busy machine an answer may come too late for one."""
        first = len(self.readings)
        self.wait_for(lambda: any(len(reading.names) == 2 for reading in self.readings[first:]))
        return next(reading for reading in self.readings[first:] if len(reading.names) == 2)

    def wait_for_message(self, part: str) -> None:
        """It may be over by then."""
        self.wait_for(lambda: self.told(part))


@pytest.fixture
def start_encoders() -> Iterator[Callable[[Device[EncoderReading], int], EncoderHost]]:
    """Starts drivers, with the period of their ticks in ns, and closes them at the end."""
    hosts: list[EncoderHost] = []

    def start(device: Device[EncoderReading], period_ns: int) -> EncoderHost:
        hosts.append(EncoderHost(device, period_ns))
        return hosts[-1]

    yield start
    for host in hosts:
        host.device.close()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Drive]:
    drive = Drive(tmp_path_factory.mktemp("drive"))
    yield drive
    drive.close()


def values_of_absent_devices(folder: Path) -> dict[str, object]:
    return {
        "name": "testbed",
        "tick_period_s": 0.1,
        "laser_port": find_free_port(),
        "auxiliary_laser": "",
        "encoder_port": folder / "absent",
        "rfid_port": find_free_port(),
        "zenoh_port": find_free_port(),
    }


@pytest.fixture
def free_port() -> int:
    return find_free_port()


@pytest.fixture
def open_client() -> Callable[[int], zenoh.Session]:
    """Opens a client session to a server on a port of this host."""
    return connect_client


@pytest.fixture
def absent_profile(tmp_path: Path) -> Path:
    """A profile whose devices are all away."""
    path = tmp_path / "absent.toml"
    path.write_text(PROFILE.format(**values_of_absent_devices(tmp_path)), encoding="utf-8")
    return path


@pytest.fixture
def drive_profile(tmp_path: Path, drive: Drive) -> Path:
    """A profile of the emulated devices."""
    path = tmp_path / "drive.toml"
    path.write_text(PROFILE.format(**values_of_absent_devices(tmp_path) | drive.places), encoding="utf-8")
    return path


StartServer = Callable[..., Server]


@pytest.fixture(scope="module")
def start_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StartServer]:
    """Starts servers with the given values in the profile; what is not given leads to a device that is away."""
    running: list[Generator[Server]] = []

    def start(**values: object) -> Server:
        folder = tmp_path_factory.mktemp("server")
        filled = values_of_absent_devices(folder) | values
        server = run_server(folder, PROFILE.format(**filled), str(filled["name"]), int(str(filled["zenoh_port"])))
        running.append(server)
        return next(server)

    yield start
    for server in running:
        server.close()

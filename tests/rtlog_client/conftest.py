"""A server that a test has in its hand: it speaks the contract on zenoh, tick by tick, and loses what it is told to."""

import contextlib
import json
import socket
import sys
import threading
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any
from uuid import UUID, uuid4

import numpy as np
import pytest
import zenoh
from patience import wait_until

from rtlog_client.compare import Comparison, compare_recordings
from rtlog_client.replay_report import ReplayReport
from rtlog_server.attachment import pack_attachment
from rtlog_server.messages import (
    OK,
    DiagnosticArray,
    JointState,
    LaserScan,
    SensorState,
    TagRead,
    TagReads,
    Tick,
    encode,
    header,
    to_time,
)
from rtlog_server.topics import DIAGNOSTICS, JOINT_STATES, PRIMARY_SCAN, TAGS, TICK

sys.path.insert(0, str(Path(__file__).parent))
from compared_drive import OFFSET, Rows, report, rows, write

START_NS = 1_770_000_000_000_000_000
PERIOD_NS = 100_000_000
PROFILE = 'schema = 1\nname = "bench"\ntick_period_s = 0.1\n'
TOPICS = (TICK, PRIMARY_SCAN, JOINT_STATES, TAGS, DIAGNOSTICS)


def tick_ns(k: int) -> int:
    return START_NS + k * PERIOD_NS


def tick_messages(k: int) -> dict[str, bytes]:
    """What tick k publishes: all but diagnostics each tick, those once in ten."""
    nothing = np.empty(0)
    ranges = np.random.default_rng(k).uniform(1, 9, 41).astype(np.float32)
    reads = [TagRead(to_time(tick_ns(k) - 5_000_000), f"E200{k:020X}", 1, 2, -40.0)] if k % 7 == 0 else []
    positions = np.array([0.1 * k, 0.2 * k])
    messages = {
        TICK.name: Tick(
            header(tick_ns(k) + 1_000, ""), k, to_time(tick_ns(k)), 1e-6, [SensorState("laser/primary", OK, 0.03)]
        ),
        PRIMARY_SCAN.name: LaserScan(
            header(tick_ns(k) - 30_000_000, "laser_primary"), -1, 1, 0.05, 0, 0.02, 0.1, 20, ranges, np.float32(nothing)
        ),
        JOINT_STATES.name: JointState(
            header(tick_ns(k) - 2_000_000, ""), ["left_wheel", "right_wheel"], positions, nothing, nothing
        ),
        TAGS.name: TagReads(header(tick_ns(k), "rfid"), reads),
    }
    if k % 10 == 0:
        messages[DIAGNOSTICS.name] = DiagnosticArray(header(tick_ns(k), ""), [])
    return {topic: encode(message) for topic, message in messages.items()}


class BenchServer:
    """One run of a server of `vehicle` on a port of this machine."""

    tick_ns = staticmethod(tick_ns)
    messages = staticmethod(tick_messages)

    def __init__(self, port: int, vehicle: str = "bench") -> None:
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self.boot_id: UUID = uuid4()
        self.published: dict[str, int] = {}
        self._prefix = f"rtlog/{vehicle}"
        config = zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("listen/endpoints", json.dumps([self.endpoint]))
        for switch in ("scouting/multicast", "scouting/gossip", "transport/shared_memory"):
            config.insert_json5(f"{switch}/enabled", "false")
        self._session = zenoh.open(config)
        self._publishers = {t.name: self._session.declare_publisher(self._prefix + t.name) for t in TOPICS}
        self._beat = self._session.declare_publisher(f"{self._prefix}/@heartbeat")
        for name, answer in (("@profile", PROFILE), ("@status", '{"software": "bench 1"}')):
            key = f"{self._prefix}/{name}"
            self._session.declare_queryable(key, lambda query, key=key, answer=answer: query.reply(key, answer))
        self._tokens: list[zenoh.LivelinessToken] = []
        self.declare_presence(vehicle)

    def declare_presence(self, vehicle: str) -> None:
        """The liveliness token of a server; several vehicles behind one endpoint are a router's case."""
        self._tokens.append(self._session.liveliness().declare_token(f"rtlog/{vehicle}/@server/{self.boot_id}"))

    def wait_for_subscriber(self) -> None:
        wait_until(lambda: all(p.matching_status.matching for p in [self._beat, *self._publishers.values()]))

    def tick(self, k: int, lose: Collection[str] = (), twice: bool = False) -> None:
        """Publish tick k; topics in `lose` use up their sequence number and are not sent."""
        for topic, data in tick_messages(k).items():
            sequence = self.published.get(topic, 0)
            self.published[topic] = sequence + 1
            for _ in range(0 if topic in lose else 1 + twice):
                attachment = pack_attachment(self.boot_id, k, sequence)
                self._publishers[topic].put(data, attachment=attachment)

    def heartbeat(self) -> None:
        last = {topic: count - 1 for topic, count in self.published.items()}
        self._beat.put(json.dumps({"boot_id": str(self.boot_id), "last_tick": 0, "last_sequence": last}))

    def close(self) -> None:
        self._session.close()


class Link:
    """A cable between two ports of this machine, which can be cut and mended."""

    def __init__(self, to_port: int) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._to = ("127.0.0.1", to_port)
        self._ends: list[socket.socket] = []
        self._is_cut = False
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        self._is_cut = True
        for end in self._ends:
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def mend(self) -> None:
        self._is_cut = False

    def close(self) -> None:
        self.cut()
        self._listener.shutdown(socket.SHUT_RDWR)  # wakes accept()
        self._listener.close()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._listener.accept()
                if self._is_cut:
                    near.close()
                    continue
                far = socket.create_connection(self._to)
                self._ends += [near, far]
                for source, sink in ((near, far), (far, near)):
                    threading.Thread(target=self._pump, args=(source, sink), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)
            sink.shutdown(socket.SHUT_RDWR)
        source.close()


def find_free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def start_server() -> Iterator[Callable[..., BenchServer]]:
    """start_server(port=None, vehicle="bench"): closed at the end of the test."""
    servers = []

    def start(port: int | None = None, vehicle: str = "bench") -> BenchServer:
        servers.append(BenchServer(port or find_free_port(), vehicle))
        return servers[-1]

    yield start
    for server in servers:
        server.close()


@pytest.fixture
def open_link() -> Iterator[Callable[[BenchServer], Link]]:
    """open_link(server): a cable to it."""
    links = []

    def open_to(server: BenchServer) -> Link:
        links.append(Link(int(server.endpoint.rsplit(":", 1)[1])))
        return links[-1]

    yield open_to
    for link in links:
        link.close()


@pytest.fixture
def bench() -> type[BenchServer]:
    """What ticks hold, without a server: `bench.messages(k)`, `bench.tick_ns(k)`."""
    return BenchServer


@pytest.fixture
def free_port() -> int:
    return find_free_port()


@pytest.fixture
def compare(tmp_path: Path) -> Callable[..., Comparison]:
    """compare(change, told): changes what came out and compares."""
    write(tmp_path / "in.mcap", rows(), 0)

    def run(change: Callable[[Rows], object], told: ReplayReport | None = None, **more: Any) -> Comparison:
        came_out = rows(OFFSET, turns=3)  # of the right wheel, which stands elsewhere in its turn when it is found
        change(came_out)
        write(tmp_path / "out.mcap", came_out, OFFSET, **more)
        return compare_recordings(tmp_path / "in.mcap", tmp_path / "out.mcap", told or report())

    return run

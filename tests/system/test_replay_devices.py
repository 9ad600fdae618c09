"""The whole way round, with the real commands: recording → emulators → server → zenoh → recording. What comes out is
what went in."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rtlog_client.log_file import LogWriter, read_info, read_messages
from rtlog_server.messages import (
    OK,
    JointState,
    LaserScan,
    SensorState,
    TagRead,
    TagReads,
    Tick,
    decode,
    encode,
    header,
    to_ns,
    to_time,
)
from rtlog_server.topics import JOINT_STATES, PRIMARY_SCAN, TAGS, TICK

START_NS = 1_700_000_000_000_000_000 + 37_000_000  # its ticks are not on whole tenths of a second
PERIOD_NS = 100_000_000
TICKS = 35
FIRST_RAY_NS = 30_000_000  # before the tick
LATCHED_NS = 12_000_000
READ_NS = 20_000_000
LATE_SAMPLES = 2  # that a busy machine may hand over a tick late, whose place the next one then takes
BEAMS = 541
WHEELS = {"left_wheel": 2.0, "right_wheel": -1.7}  # rad/s
EPC = "E2003411B802011526370494"


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated trailer at addresses of its own."""
    folder = tmp_path_factory.mktemp("profile")
    probes = [socket.create_server(("127.0.0.1", 0)) for _ in range(3)]
    laser, rfid, zenoh = (probe.getsockname()[1] for probe in probes)
    for probe in probes:
        probe.close()
    path = folder / "bench.toml"
    path.write_text(f"""
        schema = 1
        name = "bench"
        tick_period_s = 0.1
        vehicle = {{ kinematics = "differential", track_width_m = 1.6 }}
        encoder_bus = {{ kind = "sei", port = "{folder}/sei" }}
        rfid = {{ model = "ALR-9650", device = {{ host = "127.0.0.1", port = {rfid} }} }}
        zenoh = {{ listen = ["tcp/127.0.0.1:{zenoh}"] }}
        [lasers.primary]
        device = {{ host = "127.0.0.1", port = {laser} }}
        [[encoders]]
        name = "left_wheel"
        role = "left_wheel"
        wheel_radius_m = 0.35
        address = 0
        [[encoders]]
        name = "right_wheel"
        role = "right_wheel"
        wheel_radius_m = 0.35
        reversed = true
        address = 1
        """)
    return path


def tick_ns(k: int) -> int:
    return START_NS + k * PERIOD_NS


def ranges_m(k: int) -> np.ndarray[Any, np.dtype[np.float32]]:
    millimetres = np.random.default_rng(k).integers(500, 15_000, BEAMS)
    ranges = (millimetres / 1000).astype(np.float32)
    ranges[k % BEAMS] = np.inf
    return ranges


def write_drive(path: Path, profile: Path) -> None:
    nothing = np.empty(0)
    with LogWriter(path, {"vehicle": "bench"}, profile.read_text()) as log:
        for k in range(TICKS):
            latched_ns = tick_ns(k) - LATCHED_NS
            angles = np.array([speed * (latched_ns - START_NS) * 1e-9 for speed in WHEELS.values()])
            reads = [TagRead(to_time(tick_ns(k) - READ_NS), EPC, 0, 3, -41.5)] if 20 <= k < 30 else []
            sensors = [SensorState(name, OK, 0.02) for name in ("laser/primary", "encoders", "rfid")]
            messages = {
                TICK: Tick(header(tick_ns(k), ""), k, to_time(tick_ns(k)), 0.0, sensors),
                PRIMARY_SCAN: LaserScan(
                    header(tick_ns(k) - FIRST_RAY_NS, "laser_primary"),
                    *(np.radians(-135.0), np.radians(135.0), np.radians(0.5), 0.02 / 720, 0.02, 0.016, 20.0),
                    *(ranges_m(k), np.float32(nothing)),
                ),
                JOINT_STATES: JointState(header(latched_ns, ""), list(WHEELS), angles, nothing, nothing),
                TAGS: TagReads(header(tick_ns(k), "rfid"), reads),
            }
            for topic, message in messages.items():
                stamp_ns = to_ns(message.header.stamp)
                log.write(topic.name, topic.msgtype, encode(message), tick_ns(k), stamp_ns)


@contextmanager
def command(module: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A command of ours, ended with SIGTERM if it has not ended."""
    pipe = subprocess.PIPE
    process = subprocess.Popen([sys.executable, "-m", module, *arguments], stdout=pipe, stderr=pipe, text=True)
    with process:
        try:
            yield process
        finally:
            process.terminate()


def wait_for_line(process: subprocess.Popen[str], word: str) -> None:
    assert process.stderr is not None
    lines = []
    for line in process.stderr:
        lines.append(line)
        if word in line:
            return
    pytest.fail(f"no {word!r} in {''.join(lines)}")


RoundTrip = tuple[dict[str, Any], dict[str, Any], Path]


@pytest.fixture(scope="module")
def round_trip(tmp_path_factory: pytest.TempPathFactory, profile: Path) -> RoundTrip:
    """The replay's report, the recorder's summary, the recording."""
    folder = tmp_path_factory.mktemp("round_trip")
    write_drive(folder / "drive.mcap", profile)
    endpoint = profile.read_text().split('listen = ["')[1].split('"')[0]
    with ExitStack() as stack:
        server = stack.enter_context(command("rtlog_server.cli", "run", "--profile", str(profile)))
        recorder = stack.enter_context(
            command("rtlog_client.cli", "record", "-o", str(folder), "--name", "out", "--connect", endpoint, "--json")
        )
        wait_for_line(recorder, "writing")
        replay = stack.enter_context(
            command(
                "rtlog_client.cli", "replay", str(folder / "drive.mcap"), "--to", "devices", "--profile", str(profile)
            )
        )
        report, errors = replay.communicate(timeout=30)
        assert replay.returncode == 0, errors
        recorder.send_signal(signal.SIGINT)
        summary, errors = recorder.communicate(timeout=10)
        assert recorder.returncode == 0, errors
        server.terminate()
        _, errors = server.communicate(timeout=10)
        assert server.returncode == 0, errors
    return json.loads(report), json.loads(summary)[0], folder / "out.mcap"


def messages_of(path: Path, topic: str, offset_ns: int) -> dict[int, Any]:
    """Of the drive, by the tick of the drive at which they were logged."""
    found = {}
    for message in read_messages(path, [topic]):
        ticks = (message.log_time_ns - offset_ns - START_NS) / PERIOD_NS
        if -0.5 < ticks < TICKS - 0.5:
            assert abs(ticks - round(ticks)) < 1e-3  # server ticks lie on the recorded ones
            found[round(ticks)] = decode(message.data, message.msgtype)
    assert len(found) >= TICKS - LATE_SAMPLES
    return found


def test_nothing_is_lost(round_trip: RoundTrip) -> None:
    report, summary, path = round_trip
    assert (report["scans"], report["unheard_scans"], report["tag_reads"]) == (TICKS, 0, 10)
    assert summary["lost"] == {}
    assert read_info(path).metadata["vehicle"] == "bench"
    indices = [decode(m.data, m.msgtype).index for m in read_messages(path, [TICK.name])]
    assert indices == list(range(indices[0], indices[0] + len(indices)))
    ticks = messages_of(path, TICK.name, report["offset_ns"])
    assert list(ticks) == list(range(TICKS))
    for name in ("laser/primary", "encoders", "rfid"):
        states = [sensor.state for tick in ticks.values() for sensor in tick.sensors if sensor.name == name]
        assert states.count(OK) >= TICKS - LATE_SAMPLES, name


def test_scans_come_back_to_the_millimetre_in_their_ticks(round_trip: RoundTrip) -> None:
    report, _, path = round_trip
    scans = messages_of(path, PRIMARY_SCAN.name, report["offset_ns"])
    recorded_ns = {k: to_ns(scan.header.stamp) - report["offset_ns"] + FIRST_RAY_NS for k, scan in scans.items()}
    measured = {k: round((ns - START_NS) / PERIOD_NS) for k, ns in recorded_ns.items()}  # tick: tick in the drive
    assert sum(k == tick for tick, k in measured.items()) >= TICKS - LATE_SAMPLES
    for tick, k in measured.items():
        np.testing.assert_allclose(scans[tick].ranges, ranges_m(k), atol=1e-6)
        assert scans[tick].angle_min == pytest.approx(np.radians(-135.0), abs=1e-6)
        assert scans[tick].angle_increment == pytest.approx(np.radians(0.5), abs=1e-6)
    errors_ns = [recorded_ns[tick] - tick_ns(k) for tick, k in measured.items()]
    assert np.abs(errors_ns).max() < 5e6
    assert np.abs(np.median(errors_ns)) < 1e6


def test_the_wheels_turn_as_they_did(round_trip: RoundTrip) -> None:
    report, _, path = round_trip
    states = messages_of(path, JOINT_STATES.name, report["offset_ns"])
    recorded_s = np.array([to_ns(s.header.stamp) - report["offset_ns"] - START_NS for s in states.values()]) * 1e-9
    for wheel, speed in WHEELS.items():
        angles = np.array([s.position[list(s.name).index(wheel)] for s in states.values()])
        expected = speed * np.clip(recorded_s, -LATCHED_NS * 1e-9, None)
        turned = angles - angles[10] - (expected - expected[10])
        assert np.abs(turned).max() < abs(speed) * 0.005 + 2 * np.pi / 4096, wheel  # 4 ms between looks, one count
        assert angles[-1] - angles[0] == pytest.approx(expected[-1] - expected[0], abs=0.02)


def test_tags_are_read_when_they_were(round_trip: RoundTrip) -> None:
    report, _, path = round_trip
    reads = [read for m in messages_of(path, TAGS.name, report["offset_ns"]).values() for read in m.reads]
    assert {(read.epc, read.rssi) for read in reads} == {(EPC, -41.5)}
    assert sum(read.count for read in reads) == 30
    errors_ns = [(to_ns(read.stamp) - report["offset_ns"] + READ_NS - START_NS) % PERIOD_NS for read in reads]
    assert np.max(np.minimum(errors_ns, PERIOD_NS - np.array(errors_ns))) < 15e6
    assert len(reads) >= 10 - LATE_SAMPLES

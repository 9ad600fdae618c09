"""A rig of the real server process, the real recorder, and the replay that stands in for the devices.

    recording ── rtlog-client replay --to devices ══ wires ══ rtlog-server run ── zenoh ── rtlog-client record

In: a drive as a recording, and faults. Out: a `Played`: what came out, and what `rtlog-client compare` says of it.
"""

import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from hw_profiles.profile import load_profile


@dataclass
class Played:
    """A drive that went through the rig."""

    report: dict[str, Any]  # of the replay
    summary: dict[str, Any]  # of the recorder
    came_out: Path
    comparison: dict[str, Any]
    status: int  # of rtlog-client compare
    log: str = ""  # of the server

    def device(self, name: str) -> dict[str, Any]:
        return next(device for device in self.comparison["devices"] if device["device"] == name)

    def causes(self, name: str, what: str) -> list[str]:
        return [d["cause"] for d in self.device(name)["differences"] if d["what"] == what]

    def unexplained(self) -> list[dict[str, Any]]:
        """Differences without a cause; but for a few, as many as the machine was seen to stand still elsewhere.

        A terminal's worker in the kernel and our threads are held up apart from each other: not every such moment is
        seen where it hurts.
        """
        stood_ns = sum(stall["to_ns"] - stall["from_ns"] for stall in self.report["stalls"])
        share = stood_ns / (self.report["end_ns"] - self.report["start_ns"])
        found = []
        for device in self.comparison["devices"]:
            own = [difference for difference in device["differences"] if not difference["cause"]]
            forgiven = 2 + 2 * share * self.comparison["ticks"] if stood_ns else 0
            found += own if len(own) > forgiven else []
        return found


@dataclass
class Process:
    """A command of ours, its words on stderr kept."""

    popen: subprocess.Popen[str]
    lines: list[str] = field(default_factory=list)
    _news: threading.Condition = field(default_factory=threading.Condition)

    def listen(self) -> None:
        assert self.popen.stderr is not None
        for line in self.popen.stderr:
            with self._news:
                self.lines.append(line)
                self._news.notify_all()
        with self._news:
            self._news.notify_all()

    def wait_for(self, word: str, timeout_s: float = 60.0) -> None:
        with self._news:
            if not self._news.wait_for(lambda: any(word in line for line in self.lines), timeout_s):
                pytest.fail(f"no {word!r} in {''.join(self.lines)}")

    def child(self) -> int:
        """The id of the one process that it has started."""
        (child,) = Path(f"/proc/{self.popen.pid}/task/{self.popen.pid}/children").read_text().split()
        return int(child)

    def finish(self, timeout_s: float) -> str:
        """Its answer on stdout, once it has ended by itself."""
        assert self.popen.stdout is not None
        answer = self.popen.stdout.read()
        assert self.popen.wait(timeout_s) == 0, "".join(self.lines)
        return answer


@contextmanager
def command(module: str, *arguments: object) -> Iterator[Process]:
    pipe = subprocess.PIPE
    line = [sys.executable, "-m", module, *map(str, arguments)]
    with subprocess.Popen(line, stdout=pipe, stderr=pipe, text=True, cwd=Path(__file__).parents[2]) as popen:
        process = Process(popen)
        listener = threading.Thread(target=process.listen)
        listener.start()
        try:
            yield process
        finally:
            popen.terminate()
            listener.join()


def free_ports(count: int) -> list[int]:
    probes = [socket.create_server(("127.0.0.1", 0)) for _ in range(count)]
    ports = [probe.getsockname()[1] for probe in probes]
    for probe in probes:
        probe.close()
    return ports


def write_profile(folder: Path, tick_period_s: float = 0.1, auxiliary: bool = False, can: bool = False) -> Path:
    """A vehicle at addresses of its own."""
    primary, second, rfid, zenoh = free_ports(4)
    bus = f'{{ kind = "sei", port = "{folder}/sei" }}'
    if can:
        bus = f'{{ kind = "can", interface = "udp_multicast", channel = "239.74.163.2", udp_port = {rfid} }}'
    other = f'[lasers.auxiliary]\ndevice = {{ host = "127.0.0.1", port = {second} }}' if auxiliary else ""
    path = folder / "bench.toml"
    path.write_text(f"""
        schema = 1
        name = "bench"
        tick_period_s = {tick_period_s}
        vehicle = {{ kinematics = "differential", track_width_m = 1.6 }}
        encoder_bus = {bus}
        rfid = {{ model = "ALR-9650", device = {{ host = "127.0.0.1", port = {rfid} }} }}
        zenoh = {{ listen = ["tcp/127.0.0.1:{zenoh}"] }}
        [lasers.primary]
        device = {{ host = "127.0.0.1", port = {primary} }}
        {other}
        [[encoders]]
        name = "left_wheel"
        role = "left_wheel"
        wheel_radius_m = 0.35
        address = 5
        [[encoders]]
        name = "right_wheel"
        role = "right_wheel"
        wheel_radius_m = 0.35
        reversed = true
        address = 6
        """)
    return path


class Rig:
    """A folder, a profile, and the commands."""

    def __init__(self, folder: Path, profile: Path) -> None:
        self.folder = folder
        self.profile = profile
        self.endpoint = load_profile(profile).zenoh.listen[0].replace("0.0.0.0", "127.0.0.1")

    @contextmanager
    def running(self, *options: object) -> Iterator[tuple[Process, Process]]:
        """The server and the recorder, which has begun to write; `options` are the recorder's."""
        with (
            command("rtlog_server.cli", "run", "--profile", self.profile) as server,
            command(
                "rtlog_client.cli",
                *("record", "-o", self.folder, "--name", "out", "--connect", self.endpoint, "--json", *options),
            ) as recorder,
        ):
            recorder.wait_for("writing")
            yield server, recorder

    def play(self, recording: Path, faults: str = "", *options: object) -> Played:
        """Replay, record and compare."""
        with ExitStack() as stack:
            server, recorder = stack.enter_context(self.running())
            replay = stack.enter_context(self.replay(recording, faults, *options))
            report = replay.finish(timeout_s=60)
            recorder.popen.send_signal(signal.SIGINT)
            summary = recorder.finish(timeout_s=60)
            server.popen.terminate()
            server.finish(timeout_s=60)
        return self.compare(recording, report, summary, "".join(server.lines))

    def replay(self, recording: Path, faults: str, *options: object) -> Any:
        script: list[object] = []
        if faults:
            (self.folder / "faults.toml").write_text(faults)
            script = ["--faults", self.folder / "faults.toml"]
        to_devices = ("--to", "devices", "--profile", self.profile)
        return command("rtlog_client.cli", "replay", recording, *to_devices, *script, *options)

    def compare(self, recording: Path, report: str, summary: str, log: str) -> Played:
        (self.folder / "replay.json").write_text(report)
        out = self.folder / "out.mcap"
        line = ["compare", recording, out, "--replay", self.folder / "replay.json", "--json"]
        compared = subprocess.run(
            [sys.executable, "-m", "rtlog_client.cli", *map(str, line)],
            capture_output=True,
            text=True,
            check=False,
            cwd=Path(__file__).parents[2],
        )
        assert compared.returncode in (0, 1), compared.stderr
        told = json.loads(report), json.loads(summary)[0]
        return Played(*told, out, json.loads(compared.stdout), compared.returncode, log)

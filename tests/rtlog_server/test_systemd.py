"""The server as a unit: what it tells systemd's socket, and that a hung tick loop falls silent; and the unit itself.

Here the test holds the socket; under a systemd that was booted: tests/hil/test_systemd.py.
"""

import ctypes
import os
import re
import select
import shutil
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from patience import PATIENCE_S

UNIT = Path(__file__).parents[2] / "systemd/rtlog-server.service"
PTRACE_DETACH, PTRACE_SEIZE, PTRACE_INTERRUPT = 17, 0x4206, 0x4207  # sys/ptrace.h


class Systemd:
    """The socket that a unit's process notifies."""

    def __init__(self, path: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))

    def next(self, word: str, timeout_s: float = PATIENCE_S) -> list[str]:
        """The lines of the next datagram with a line that begins with `word`."""
        self._socket.settimeout(timeout_s)
        while True:
            lines = self._socket.recv(4096).decode().splitlines()
            if any(line.startswith(word) for line in lines):
                return lines

    def drain(self) -> None:
        while select.select([self._socket], [], [], 0)[0]:
            self._socket.recv(4096)

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Systemd]:
    """Heard by the servers that the test starts."""
    path = tmp_path / "notify"
    systemd = Systemd(path)
    monkeypatch.setenv("NOTIFY_SOCKET", str(path))
    monkeypatch.setenv("WATCHDOG_USEC", "3000000")
    yield systemd
    systemd.close()


@contextmanager
def hung(thread: int) -> Iterator[None]:
    """Stop one thread of a child process as a debugger does; its other threads run on."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
    libc.ptrace.restype = ctypes.c_long
    if libc.ptrace(PTRACE_SEIZE, thread, None, None) != 0:
        pytest.skip(f"a thread cannot be stopped here: ptrace: {os.strerror(ctypes.get_errno())}")
    libc.ptrace(PTRACE_INTERRUPT, thread, None, None)
    _, status = os.waitpid(thread, 0)
    assert os.WIFSTOPPED(status)
    yield
    libc.ptrace(PTRACE_DETACH, thread, None, None)


def switches_of_other_threads(process: int) -> int:
    """How often they went to sleep."""
    tasks = [task for task in Path(f"/proc/{process}/task").iterdir() if task.name != str(process)]
    texts = [(task / "status").read_text() for task in tasks]
    return sum(int(re.findall(r"^voluntary_ctxt_switches:\s*(\d+)", text, re.MULTILINE)[0]) for text in texts)


def test_it_says_ready_when_it_publishes_and_how_it_is_and_that_it_stops(
    start_server: Callable[..., Any], systemd: Systemd
) -> None:
    server = start_server()
    assert systemd.next("READY=1") == ["READY=1"]
    assert "publishing" in server.stderr.read_text()
    watchdog, status = systemd.next("WATCHDOG=1")
    assert watchdog == "WATCHDOG=1"
    devices = "laser/primary MISSING, encoders MISSING, rfid MISSING"
    late = r"late by \d+\.\d\d ms \(p99\), \d+\.\d\d ms \(worst\)"
    assert re.fullmatch(rf"STATUS=\d+ ticks, 0 dropped, \d+ overruns; {late}; {devices}", status), status
    server.process.terminate()
    assert systemd.next("STOPPING=1") == ["STOPPING=1"]
    assert server.process.wait(timeout=PATIENCE_S) == 0


def test_a_hung_tick_loop_falls_silent_while_all_else_runs(start_server: Callable[..., Any], systemd: Systemd) -> None:
    server = start_server()
    systemd.next("READY=1")
    systemd.next("WATCHDOG=1")
    with hung(server.process.pid):  # the main thread is the tick loop
        systemd.drain()
        before, beats = switches_of_other_threads(server.process.pid), len(server.on("@heartbeat"))
        with pytest.raises(TimeoutError):
            systemd.next("WATCHDOG=1", timeout_s=2.5)
        assert switches_of_other_threads(server.process.pid) > before  # the drivers try again and again
        server.wait_until(lambda: len(server.on("@heartbeat")) > beats)
    overruns = 0
    while overruns < 20:  # the missed ticks are made up for, with a report a second of them
        overruns = int(re.findall(r"(\d+) overruns", systemd.next("WATCHDOG=1")[1])[0])


def test_ticks_far_apart_ask_for_a_longer_watchdog(start_server: Callable[..., Any], systemd: Systemd) -> None:
    start_server(tick_period_s=1.5)
    assert systemd.next("READY=1") == ["READY=1", "WATCHDOG_USEC=4500000"]


def test_an_abort_tells_where_every_thread_stood(start_server: Callable[..., Any]) -> None:
    """Systemd's watchdog ends a hung server with SIGABRT."""
    server = start_server()
    server.wait_until(lambda: len(server.on("rtlog/tick")) >= 2)
    server.process.send_signal(6)
    assert server.process.wait(timeout=PATIENCE_S) == -6
    told = server.stderr.read_text()
    assert "Fatal Python error: Aborted" in told
    assert "in ticks" in told  # the loop
    assert "in _run" in told  # a driver


def systemd_analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze: apt-get install systemd")
    command = ["systemd-analyze", *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_the_unit_is_valid(tmp_path: Path) -> None:
    """As it is, but for where the program is on this machine."""
    text, count = re.subn("/opt/rtlog/bin/rtlog-server", f"{sys.prefix}/bin/rtlog-server", UNIT.read_text())
    assert count == 1
    unit = tmp_path / UNIT.name
    unit.write_text(text)
    result = systemd_analyze("verify", str(unit))
    assert (result.returncode, result.stdout, result.stderr) == (0, "", "")


def test_the_unit_is_as_closed_as_it_can_be() -> None:
    """Its score is 2.2 of 10: what is open is what it needs (network, SCHED_FIFO, serial ports)."""
    result = systemd_analyze("security", "--offline=true", "--threshold=25", str(UNIT))
    assert result.returncode == 0, result.stdout[-200:]

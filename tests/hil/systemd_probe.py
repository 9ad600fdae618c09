"""Runs as root inside the container that test_systemd.py boots: puts the unit through its life and writes what it saw.

Out: /report/report.json, a dict; what goes wrong on the way is in /report/journal.txt. It takes nothing but the
standard library.
"""

import ctypes
import json
import os
import re
import subprocess
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

UNIT = "rtlog-server.service"
REPORT = Path("/report")
__WALL = 0x40000000  # sys/wait.h: of a process that is no child too
PTRACE_SEIZE, PTRACE_INTERRUPT = 0x4206, 0x4207  # sys/ptrace.h
DEADLINE_S = 20.0


def run(*command: str) -> str:
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
    return done.stdout.strip()


def show(name: str) -> str:
    """A property of the unit."""
    return run("systemctl", "show", "--value", "-p", name, UNIT)


def wait_until(condition: Callable[[], bool]) -> float:
    """How long it took; after the deadline the report shows the rest."""
    began = time.monotonic()
    while not condition() and time.monotonic() < began + DEADLINE_S:
        time.sleep(0.02)
    return time.monotonic() - began


def journal() -> str:
    return run("journalctl", "--no-pager", "-o", "cat", "-u", UNIT)


def status_of(process: int) -> dict[str, str]:
    """/proc/…/status, and the scheduling of each thread."""
    lines = Path(f"/proc/{process}/status").read_text().splitlines()
    fields = {key: value.strip() for key, value in (line.split(":", 1) for line in lines)}
    threads = [int(task.name) for task in Path(f"/proc/{process}/task").iterdir()]
    fifo = [os.sched_getscheduler(t) == os.SCHED_FIFO and os.sched_getparam(t).sched_priority == 80 for t in threads]
    return fields | {"fifo 80": str(all(fifo)), "threads": str(len(threads))}


def ticking() -> bool:
    ticks = re.match(r"(\d+) ticks", show("StatusText"))
    return ticks is not None and int(ticks[1]) >= 5


def hang_tick_loop(process: int) -> None:
    """Stop the main thread for good, as a debugger does; the others run on."""
    libc = ctypes.CDLL(None, use_errno=True)
    libc.ptrace.argtypes = [ctypes.c_long, ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p]
    for request in (PTRACE_SEIZE, PTRACE_INTERRUPT):
        if libc.ptrace(request, process, None, None) != 0:
            raise OSError(ctypes.get_errno(), f"ptrace {request:#x}")


def gone(process: int) -> bool:
    """Whether it has ended; its debugger must have heard of that before systemd does."""
    with suppress(ChildProcessError):
        os.waitpid(process, os.WNOHANG | __WALL)
    return not Path(f"/proc/{process}").exists()


def probe() -> dict[str, object]:
    report: dict[str, object] = {}
    report["start"] = run("systemctl", "start", UNIT)
    wait_until(ticking)
    report["status_text"] = show("StatusText")
    report["process"] = status_of(int(show("MainPID")))
    report["user"] = run("id", "rtlog")

    hung = int(show("MainPID"))
    hang_tick_loop(hung)
    report["watchdog_s"] = wait_until(
        lambda: gone(hung) and show("NRestarts") == "1" and show("ActiveState") == "active"
    )
    report["after_hang"] = {name: show(name) for name in ("NRestarts", "ActiveState")}
    report["journal_of_hang"] = journal()

    wait_until(ticking)
    os.kill(int(show("MainPID")), 9)
    report["kill_s"] = wait_until(lambda: show("NRestarts") == "2" and show("ActiveState") == "active")
    report["after_kill"] = {name: show(name) for name in ("NRestarts", "ActiveState")}

    wait_until(ticking)
    began = time.monotonic()
    run("systemctl", "stop", UNIT)
    report["stop_s"] = time.monotonic() - began
    report["after_stop"] = {name: show(name) for name in ("ActiveState", "Result", "ExecMainStatus")}

    Path("/etc/default/rtlog-server").write_text("RTLOG_PROFILE=/no/such/profile.toml\n")
    run("systemctl", "start", UNIT)
    time.sleep(3)  # longer than RestartSec
    report["wrong_profile"] = {name: show(name) for name in ("ActiveState", "ExecMainStatus", "NRestarts")}
    report["udev"] = [line for line in run("udevadm", "test", "/sys/class/net/lo").splitlines() if "70-rtlog" in line]
    return report


if __name__ == "__main__":
    try:
        answer = json.dumps(probe(), indent=1)
        (REPORT / "report.json").write_text(answer)
    finally:
        (REPORT / "journal.txt").write_text(run("journalctl", "--no-pager"))

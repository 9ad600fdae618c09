"""The server's main path: open the devices, then tick, collect, queue; and to the end what was sampled goes out.

    this process, SCHED_FIFO                                    │ publishing process
    driver threads ──samples──> tick loop ──bundles──> outbox ──┼──> zenoh, diagnostics, status
                                                                │
The law: neither a device nor the network can delay a tick. A device that is away is MISSING; a publishing process that
does not keep up costs counted ticks, and one that died or hangs for a minute ends the server (systemd starts it anew).
"""

import faulthandler
import gc
import logging
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Sequence
from importlib.metadata import version
from multiprocessing.connection import Pipe
from typing import Any

from hw_profiles.errors import RTLogError
from hw_profiles.profile import Profile
from rtlog_server.bundle import Bundle, Report, ServerInfo
from rtlog_server.devices import open_devices
from rtlog_server.devices.device import Device
from rtlog_server.health import ReportTimer, notify, ready_message, status_line
from rtlog_server.outbox import Outbox
from rtlog_server.realtime import freeze_garbage, give_up_realtime
from rtlog_server.sampler import Sampler
from rtlog_server.ticker import Lateness, aligned_grid, ticks, utc_offset_ns

log = logging.getLogger(__name__)

QUEUE_TICKS = 300  # 30 s, some 2 MB
MOST_REFUSED_TICKS = 300  # in a row, with the queue full: it will not come back
COLLECT_TICKS = 100  # a garbage collection after every so many ticks; below a millisecond once all is frozen
CLOSE_DEVICES_S = 0.5
CLOSE_PUBLISHER_S = 5.0
END_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def run(profile: Profile, profile_toml: str, realtime: dict[str, str]) -> None:
    """Sample and publish until SIGINT or SIGTERM.

    Args:
        profile: of the vehicle.
        profile_toml: the same as it was written, for `@profile`.
        realtime: what `become_realtime` was granted.

    Raises:
        BadInputError: the profile lacks a device section.
        RTLogError: the publishing process failed: one line that says why.
    """
    devices = open_devices(profile)
    faulthandler.enable()  # systemd's watchdog sends SIGABRT: the journal then tells where every thread stood
    stop_requests: list[int] = []
    for number in END_SIGNALS:
        signal.signal(number, lambda number, _: stop_requests.append(number))
    info = ServerInfo(
        boot_id=uuid.uuid4(),
        vehicle=profile.name,
        software=f"rtlog {version('rtlog')}",
        profile_toml=profile_toml,
        listen=profile.zenoh.listen,
        started_ns=time.monotonic_ns(),
    )
    log.info("boot %s of %s: %s", info.boot_id, info.vehicle, ", ".join(device.name for device in devices))
    granted = not any("not " in answer for answer in realtime.values())
    answers = "; ".join(f"{key} {answer}" for key, answer in realtime.items())
    log.log(logging.INFO if granted else logging.WARNING, "real time: %s", answers)
    publisher = PublishingProcess(info)
    publisher.outbox.start()
    try:
        sample_for_ever(profile.tick_period_s, devices, publisher, realtime, stopped=lambda: bool(stop_requests))
    finally:
        notify("STOPPING=1")
        close_devices(devices)
        publisher.close()


def sample_for_ever(
    period_s: float,
    devices: Sequence[Device[Any]],
    publisher: "PublishingProcess",
    realtime: dict[str, str],
    stopped: Callable[[], bool],
) -> None:
    """The tick loop."""
    period_ns, offset_ns = round(period_s * 1e9), utc_offset_ns()
    sampler, lateness, reporter = Sampler(devices, offset_ns), Lateness(period_ns), ReportTimer()
    grid = aligned_grid(period_ns, offset_ns, time.monotonic_ns())
    for device in devices:
        device.start(grid)
    freeze_garbage()
    for tick in ticks(grid, stopped):
        if publisher.came_up():
            log.info("publishing")
            notify(ready_message(period_s))
        samples, device_reports = sampler.sample(tick)
        lateness.add(tick)
        report = None
        if reporter.due(tick, device_reports):
            stamp_ns, dropped = tick.began_ns + offset_ns, publisher.outbox.dropped
            report = Report(stamp_ns, device_reports, lateness.summary(), dropped, realtime)
            notify(f"WATCHDOG=1\nSTATUS={status_line(report)}")
        publisher.put(Bundle(tick.index, samples, report))
        if tick.index % COLLECT_TICKS == 0:
            gc.collect()


def close_devices(devices: Sequence[Device[Any]]) -> None:
    """Tell all of them to stop, then wait for all at once; one that hangs in a system call ends with the process."""
    deadline = time.monotonic() + CLOSE_DEVICES_S
    for device in devices:
        device.close(timeout_s=0.0)
    for device in devices:
        device.close(timeout_s=max(0.0, deadline - time.monotonic()))


class PublishingProcess:
    """The other process, and the outbox to it."""

    def __init__(self, info: ServerInfo) -> None:
        self._connection, theirs = Pipe()
        command = [sys.executable, "-m", "rtlog_server.publish", str(theirs.fileno())]
        # Ctrl-C and systemd signal both processes, but the publisher must outlive the last tick: it inherits a mask
        # that blocks them for good, and ends when the pipe does.
        previous = signal.pthread_sigmask(signal.SIG_BLOCK, END_SIGNALS)
        # It must not inherit real time, and there is no other thread yet that `preexec_fn` could trip over.
        self._process = subprocess.Popen(command, pass_fds=[theirs.fileno()], preexec_fn=give_up_realtime)
        signal.pthread_sigmask(signal.SIG_SETMASK, previous)
        theirs.close()
        self._connection.send(info)
        self.outbox = Outbox(self._connection, QUEUE_TICKS)
        self._refused = 0  # ticks in a row

    def put(self, bundle: Bundle) -> None:
        """Queue a tick, or drop it. Raises: RTLogError: for too many ticks the process has taken nothing."""
        self._refused = 0 if self.outbox.put(bundle) else self._refused + 1
        if self._refused > MOST_REFUSED_TICKS:
            raise RTLogError(f"the publishing process hangs: it has taken none of {QUEUE_TICKS + self._refused} ticks")

    def came_up(self) -> bool:
        """Hear what the process has to say: True once, when it has begun to publish.

        Raises:
            RTLogError: it failed, or it is gone.
        """
        if not self._connection.poll():
            return False
        try:
            failure = self._connection.recv()
        except (EOFError, ConnectionResetError):
            failure = f"the publishing process ended (exit status {self._process.wait()})"
        if failure:
            raise RTLogError(failure)
        return True

    def close(self) -> None:
        """Let everything that was queued go out. Raises: RTLogError: it would not."""
        drained = self.outbox.close(CLOSE_PUBLISHER_S)
        try:
            self._process.wait(CLOSE_PUBLISHER_S if drained else 0.0)
        except subprocess.TimeoutExpired as error:
            self._process.kill()
            self._process.wait()
            message = f"the publishing process did not take the last ticks within {CLOSE_PUBLISHER_S:.0f} s"
            raise RTLogError(message) from error

"""The writer thread of a recording: from the inbox into one file for each run of the server.

In: `Arrived`, `Heartbeat` and `Presence`. Out: finished recordings, their summaries, and once a second a `Progress`.
"""

import json
import logging
import queue
import shutil
import threading
import time
import tomllib
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from itertools import count
from pathlib import Path
from uuid import UUID

from hw_profiles.errors import RTLogError
from rtlog_client.log_file import LogWriter
from rtlog_client.run_log import LastTag, RunLog, RunSummary
from rtlog_client.session import Arrived, Heartbeat, Inbox, Link, Presence
from rtlog_server.attachment import unpack_attachment
from rtlog_server.topics import BY_NAME, PRIMARY_SCAN, TICK

log = logging.getLogger(__name__)

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7447"
SYNC_S = 1.0
POLL_S = 0.1


@dataclass(frozen=True, slots=True)
class RecordConfig:
    folder: Path
    connect: str = DEFAULT_ENDPOINT
    vehicle: str | None = None  # None: the only one there
    name: str | None = None  # of the recording; None: UTC date and vehicle
    duration_s: float | None = None  # from the first tick on
    reserve_bytes: int = 200_000_000  # of the disk are left free


@dataclass(frozen=True, slots=True)
class Progress:
    """Once a second, for the operator."""

    there: bool  # is a server there?
    ticks: int
    lost: int  # samples of all topics
    scan_hz: float
    sensors: dict[str, int]  # name: OK, STALE or MISSING
    last_tag: LastTag | None
    newest_tick_ns: int
    size_bytes: int
    free_bytes: int


def check_disk(config: RecordConfig) -> int:
    """Free bytes of the disk. Raises: RTLogError: they have come down to the reserve."""
    free = shutil.disk_usage(config.folder).free
    if free < config.reserve_bytes:
        least = config.reserve_bytes / 1e6
        raise RTLogError(f"{config.folder}: the disk is full: {free / 1e6:.0f} MB free, {least:.0f} MB are kept")
    return free


def recording_paths(folder: Path, stem: str) -> tuple[Path, Path]:
    """The names that a recording has: when it is done, and in the making."""
    return folder / f"{stem}.mcap", folder / f"{stem}.mcap.part"


class Recorder:
    """The writer thread: `run`. The main thread reads `progress` and sets `ending`."""

    def __init__(self, config: RecordConfig, vehicle: str, link: Link, inbox: Inbox) -> None:
        self.ending = threading.Event()
        self.progress: Progress | None = None
        self.summaries: list[RunSummary] = []
        self._config = config
        self._vehicle = vehicle
        self._link = link
        self._inbox = inbox
        self._run: RunLog | None = None
        self._finished_boots: set[UUID] = set()
        self._present: set[UUID] = set()
        self._complaints: set[str] = set()
        self._began_s: float | None = None
        self._scans = 0  # since the last progress

    def run(self) -> None:
        """Until `ending` is set and the inbox is empty. Raises: RTLogError: the disk is full or fails."""
        next_sync_s = time.monotonic() + SYNC_S
        try:
            while not (self.ending.is_set() and self._inbox.empty()):
                with suppress(queue.Empty):
                    self._take(self._inbox.get(timeout=POLL_S))
                if time.monotonic() >= next_sync_s:
                    self._tend()
                    next_sync_s = max(next_sync_s + SYNC_S, time.monotonic())
            self._finish_run()
        except OSError as error:
            part = self._run.log.part if self._run is not None and self._run.log is not None else self._config.folder
            hint = f"rtlog-client recover {part} gives back what was synced"
            raise RTLogError(f"{part}: {error.strerror or error}; {hint}") from error

    def time_is_up(self) -> bool:
        began_s, duration_s = self._began_s, self._config.duration_s
        return began_s is not None and duration_s is not None and time.monotonic() >= began_s + duration_s

    def _take(self, item: Arrived | Heartbeat | Presence) -> None:
        match item:
            case Arrived():
                self._take_sample(item)
            case Heartbeat(boot_id, last_sequence):
                run = self._run_of(boot_id)
                if run is not None:
                    run.heartbeat(last_sequence)
            case Presence(boot_id, there):
                was_there = bool(self._present)
                (self._present.add if there else self._present.discard)(boot_id)
                if was_there and not self._present:
                    log.warning("the server is gone; waiting for it")
                elif self._present and not was_there and self._run is not None:
                    log.info("the server is back")

    def _take_sample(self, item: Arrived) -> None:
        topic = BY_NAME.get(item.topic)
        if topic is None or not topic.recorded:
            self._complain(f"{item.topic} is no topic to record")
            return
        try:
            attachment = unpack_attachment(item.attachment)
            run = self._run_of(attachment.boot_id)
            if run is not None:
                run.add(topic, item.data, attachment)
                self._scans += topic is PRIMARY_SCAN
        except ValueError as error:
            self._complain(f"{item.topic}: {error}")

    def _complain(self, line: str) -> None:
        if line not in self._complaints:
            self._complaints.add(line)
            log.warning("%s; such messages are not recorded", line)

    def _run_of(self, boot_id: UUID) -> RunLog | None:
        """The run with this boot id; another one than before ends that one. None for a run that is over."""
        if self._run is not None and self._run.boot_id == boot_id:
            return self._run
        if boot_id in self._finished_boots:
            return None
        if self._run is not None:
            log.warning("the server was started anew: the recording goes on in another file")
            self._finish_run()
        self._run = self._start_run(boot_id)
        return self._run

    def _start_run(self, boot_id: UUID) -> RunLog:
        profile_toml = self._link.ask(self._vehicle, "@profile")
        if profile_toml is None:
            log.warning("%s does not answer to @profile: the recording will have no profile", self._vehicle)
        profile = tomllib.loads(profile_toml or "")
        status = json.loads(self._link.ask(self._vehicle, "@status") or "{}")
        metadata = {
            "vehicle": self._vehicle,
            "profile": str(profile.get("name", "")),
            "boot_id": str(boot_id),
            "software": f"rtlog-client {version('rtlog')}",
            "server": str(status.get("software", "")),
        }

        def open_log() -> LogWriter:
            stem = self._config.name or f"{datetime.now(UTC):%Y%m%dT%H%M%SZ}_{self._vehicle}"
            names = (stem if k == 1 else f"{stem}_{k}" for k in count(1))
            free = next(n for n in names if not any(path.exists() for path in recording_paths(self._config.folder, n)))
            writer = LogWriter(self._config.folder / f"{free}.mcap", metadata, profile_toml)
            self._began_s = self._began_s or time.monotonic()
            log.info("writing %s", writer.part)
            return writer

        return RunLog(boot_id, open_log, int(float(profile.get("tick_period_s", 0.1)) * 1e9))

    def _tend(self) -> None:
        """Once a second: make safe what came, look at the disk, tell how things are."""
        run = self._run
        if run is None:
            return
        run.tell_losses()
        if run.log is not None:
            run.log.sync()
        try:
            free_bytes = check_disk(self._config)
        except RTLogError:
            self._finish_run()
            raise
        scan_hz, self._scans = self._scans / SYNC_S, 0
        self.progress = Progress(
            there=bool(self._present),
            ticks=run.received.get(TICK.name, 0),
            lost=sum(run.lost.values()),
            scan_hz=scan_hz,
            sensors=run.sensors,
            last_tag=run.last_tag,
            newest_tick_ns=run.newest_tick_ns,
            size_bytes=run.log.size_bytes if run.log is not None else 0,
            free_bytes=free_bytes,
        )

    def _finish_run(self) -> None:
        if self._run is None:
            return
        run, self._run = self._run, None
        self._finished_boots.add(run.boot_id)
        summary = run.finish()
        if summary is not None:
            self.summaries.append(summary)
            log.info("finished %s: %d ticks, %d lost", summary.path, summary.ticks, sum(summary.lost.values()))

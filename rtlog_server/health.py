"""How the server is: for ROS tools (`/diagnostics`), for scripts (`@status`) and for systemd.

In: the sampling process's reports. Out: a DiagnosticArray, a dict ready for JSON, a datagram.
"""

import logging
import math
import os
import socket
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from rtlog_server.bundle import DeviceReport, Report, ServerInfo
from rtlog_server.messages import MISSING, OK, STALE, DiagnosticArray, DiagnosticStatus, KeyValue, header
from rtlog_server.ticker import TickTime
from rtlog_server.topics import TICK

log = logging.getLogger(__name__)

REPORT_NS = 1_000_000_000
WATCHDOG_REPORTS = 3  # that the watchdog waits for one
STATE_NAMES = {OK: "OK", STALE: "STALE", MISSING: "MISSING"}
LEVELS = {OK: DiagnosticStatus.OK, STALE: DiagnosticStatus.WARN, MISSING: DiagnosticStatus.ERROR}


class ReportTimer:
    """Says when a report is due: once a second, and when a device's state changes."""

    def __init__(self) -> None:
        self._states: list[int] | None = None
        self._next_ns = 0

    def due(self, tick: TickTime, devices: Sequence[DeviceReport]) -> bool:
        states = [device.state for device in devices]
        if states != self._states:
            log.info("tick %d: %s", tick.index, ", ".join(f"{d.name} {STATE_NAMES[d.state]}" for d in devices))
        elif tick.scheduled_ns < self._next_ns:
            return False
        self._states, self._next_ns = states, tick.scheduled_ns + REPORT_NS
        return True


def diagnostics(report: Report, before: Report | None) -> Any:
    """A DiagnosticArray: a status for each device, and one for the ticks, which warns of losses since `before`."""
    return DiagnosticArray(
        header(report.stamp_ns, ""), [*map(_device_status, report.devices), _server_status(report, before)]
    )


def _device_status(device: DeviceReport) -> Any:
    values = {
        "state": STATE_NAMES[device.state],
        "age_s": f"{device.age_s:.3f}",
        "connects": str(device.connects),
        **device.identity,
        **device.diagnostics,
    }
    serial = device.identity.get("serial_number", "")
    level = LEVELS[device.state]
    if device.state == OK and device.message != "connected":  # it delivers, and yet: a dirty window, a silent encoder
        level = DiagnosticStatus.WARN
    return _status(level, device.name, device.message, serial, values)


def _server_status(report: Report, before: Report | None) -> Any:
    lateness = report.lateness
    dropped = report.dropped_ticks - (before.dropped_ticks if before else 0)
    overruns = lateness.overruns - (before.lateness.overruns if before else 0)
    level, message = DiagnosticStatus.OK, "sampling"
    if dropped or overruns:
        level, message = DiagnosticStatus.WARN, f"{dropped} ticks dropped, {overruns} late by a period or more"
    values = {
        "ticks": str(lateness.count),
        "dropped_ticks": str(report.dropped_ticks),
        "overruns": str(lateness.overruns),
        "lateness_p50_ms": f"{lateness.p50_s * 1e3:.3f}",
        "lateness_p99_ms": f"{lateness.p99_s * 1e3:.3f}",
        "lateness_max_ms": f"{lateness.max_s * 1e3:.3f}",
        "lateness_up_to_ms": " ".join(f"{edge * 1e3:.3f}:{count}" for edge, count in lateness.histogram),
        **report.realtime,
    }
    return _status(level, "server", message, "", values)


def _status(level: int, name: str, message: str, hardware_id: str, values: dict[str, str]) -> Any:
    return DiagnosticStatus(level, name, message, hardware_id, [KeyValue(key, text) for key, text in values.items()])


def status(info: ServerInfo, report: Report | None, published: dict[str, int]) -> dict[str, Any]:
    """What `@status` answers; `published` counts the samples put on zenoh, by topic. Without a report yet, less."""
    answer: dict[str, Any] = {
        "boot_id": str(info.boot_id),
        "vehicle": info.vehicle,
        "software": info.software,
        "uptime_s": round((time.monotonic_ns() - info.started_ns) * 1e-9, 3),
        "published": published,
    }
    if report is not None:
        lateness = report.lateness
        answer["ticks"] = {
            # a report is up to a second old; what went out or was dropped since was sampled too
            "sampled": max(lateness.count, published.get(TICK.name, 0) + report.dropped_ticks),
            "dropped": report.dropped_ticks,
            "overruns": lateness.overruns,
            "lateness_s": {"p50": lateness.p50_s, "p99": lateness.p99_s, "max": lateness.max_s},
            "histogram": [{"up_to_s": edge, "count": count} for edge, count in lateness.histogram],
        }
        answer["realtime"] = report.realtime
        answer["devices"] = {device.name: _device_answer(device) for device in report.devices}
    return answer


def _device_answer(device: DeviceReport) -> dict[str, Any]:
    return {
        "state": STATE_NAMES[device.state],
        "age_s": round(device.age_s, 6) if math.isfinite(device.age_s) else None,  # JSON has no infinity
        "message": device.message,
        "connects": device.connects,
        "identity": device.identity,
        "diagnostics": device.diagnostics,
    }


def status_line(report: Report) -> str:
    """One line for `systemctl status`."""
    late = report.lateness
    states = ", ".join(f"{device.name} {STATE_NAMES[device.state]}" for device in report.devices)
    return (
        f"{late.count} ticks, {report.dropped_ticks} dropped, {late.overruns} overruns; "
        f"late by {late.p99_s * 1e3:.2f} ms (p99), {late.max_s * 1e3:.2f} ms (worst); {states}"
    )


def ready_message(tick_period_s: float) -> str:
    """What to `notify` when the start is done; it asks for a longer watchdog if the unit's is too short for the ticks.

    The tick loop feeds the watchdog with each report: once a second, or at every tick where these are further apart.
    """
    wanted_us = round(max(1.0, tick_period_s) * WATCHDOG_REPORTS * 1e6)
    granted_us = int(os.environ.get("WATCHDOG_USEC", "0"))
    return f"READY=1\nWATCHDOG_USEC={wanted_us}" if 0 < granted_us < wanted_us else "READY=1"


def notify(message: str) -> None:
    """Tell systemd (sd_notify(3)): READY=1, STATUS=…, WATCHDOG=1, STOPPING=1. Does nothing outside a unit."""
    path = os.environ.get("NOTIFY_SOCKET", "")
    if not path:
        return
    address = "\0" + path[1:] if path.startswith("@") else path
    # never wait, never fail: a word that systemd misses is said again, and its watchdog restarts us if none arrive
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sender, suppress(OSError):
        sender.sendto(message.encode(), address)

"""Diagnostics, status and systemd's notifications."""

import json
import logging
import math
import socket
import time
from dataclasses import replace
from pathlib import Path
from uuid import UUID

import pytest
from patience import PATIENCE_S

from rtlog_server.bundle import DeviceReport, LatenessSummary, Report, ServerInfo
from rtlog_server.health import ReportTimer, diagnostics, notify, status, status_line
from rtlog_server.messages import MISSING, OK, STALE, decode, encode, to_ns
from rtlog_server.ticker import TickTime

LATENESS = LatenessSummary(600, 2, 1e-4, 5e-4, 0.25, [(1e-4, 500), (0.25, 100)])
DEVICES = [
    DeviceReport("laser/primary", OK, 0.02, "connected", 1, {"serial_number": "4711"}, {"scans lost": "0"}),
    DeviceReport("encoders", STALE, 0.5, "no answer from left_wheel", 3, {}, {}),
    DeviceReport("rfid", MISSING, math.inf, "connection refused", 0, {}, {}),
]
REPORT = Report(1_700_000_000_000_000_001, DEVICES, LATENESS, 7, {"scheduler": "SCHED_FIFO 80", "memory": "locked"})
INFO = ServerInfo(UUID(int=5), "trailer", "rtlog 0.1", "", (), time.monotonic_ns() - 2_000_000_000)


def test_diagnostics_level_each_device_and_the_ticks() -> None:
    message = diagnostics(REPORT, REPORT)
    message = decode(encode(message), "diagnostic_msgs/msg/DiagnosticArray")
    assert to_ns(message.header.stamp) == REPORT.stamp_ns
    assert [(s.name, s.level) for s in message.status] == [
        ("laser/primary", 0),
        ("encoders", 1),
        ("rfid", 2),
        ("server", 0),
    ]
    laser, encoders, _, server = message.status
    assert laser.hardware_id == "4711"
    assert {pair.key: pair.value for pair in laser.values}["scans lost"] == "0"
    assert encoders.message == "no answer from left_wheel"
    values = {pair.key: pair.value for pair in server.values}
    assert values["dropped_ticks"] == "7"
    assert values["overruns"] == "2"
    assert values["lateness_up_to_ms"] == "0.100:500 250.000:100"
    assert values["scheduler"] == "SCHED_FIFO 80"


def test_diagnostics_warn_of_a_device_that_delivers_and_is_not_well() -> None:
    dirty = replace(DEVICES[0], message="front window is dirty")
    told = diagnostics(replace(REPORT, devices=[dirty, DEVICES[1]]), None).status
    assert (told[0].level, told[0].message) == (1, "front window is dirty")


def test_diagnostics_warn_of_losses_once() -> None:
    worse = replace(REPORT, dropped_ticks=9)
    assert diagnostics(worse, REPORT).status[-1].level == 1
    assert "2 ticks dropped" in diagnostics(worse, REPORT).status[-1].message
    late = replace(REPORT, lateness=replace(LATENESS, overruns=5))
    assert "3 late by a period" in diagnostics(late, REPORT).status[-1].message
    assert diagnostics(worse, worse).status[-1].level == 0


def test_status_is_strict_json() -> None:
    answer = json.loads(json.dumps(status(INFO, REPORT, {"/rtlog/tick": 593}), allow_nan=False))
    assert answer["boot_id"] == "00000000-0000-0000-0000-000000000005"
    assert answer["uptime_s"] >= 2.0
    assert answer["ticks"]["dropped"] == 7
    assert answer["devices"]["rfid"]["age_s"] is None
    assert answer["devices"]["encoders"]["state"] == "STALE"
    assert answer["published"] == {"/rtlog/tick": 593}


def test_status_before_the_first_report() -> None:
    assert status(INFO, None, {}).keys() == {"boot_id", "vehicle", "software", "uptime_s", "published"}


def test_reports_are_due_each_second_and_at_each_change(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    timer, due = ReportTimer(), []
    for index in range(35):
        lost = index in (7, 8)
        devices = [replace(DEVICES[0], state=MISSING if lost else OK)]
        if timer.due(TickTime(index, index * 100_000_000, index * 100_000_000), devices):
            due.append(index)
    assert due == [0, 7, 9, 19, 29]
    assert caplog.messages == [
        "tick 0: laser/primary OK",
        "tick 7: laser/primary MISSING",
        "tick 9: laser/primary OK",
    ]


@pytest.mark.parametrize("abstract", [False, True])
def test_notify_speaks_to_systemd(abstract: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    name = f"@rtlog-test-{tmp_path.name}-{time.monotonic_ns()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(name.replace("@", "\0"))
        systemd.settimeout(PATIENCE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        notify(f"READY=1\nSTATUS={status_line(REPORT)}")
        lines = systemd.recv(1000).decode().splitlines()
        assert lines[0] == "READY=1"
        late = "600 ticks, 7 dropped, 2 overruns; late by 0.50 ms (p99), 250.00 ms (worst)"
        assert lines[1] == f"STATUS={late}; laser/primary OK, encoders STALE, rfid MISSING"
        for _ in range(1000):
            notify("WATCHDOG=1")  # nobody reads: the socket fills up, and this goes on


def test_notify_without_systemd_does_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    notify("READY=1")

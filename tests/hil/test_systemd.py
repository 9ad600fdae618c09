"""The unit under a real systemd: this machine's /usr is booted in a container with an empty /etc, the unit is installed
there as docs/board.md says, and systemd_probe.py puts it through its life.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
BOOT_S = 240
PROFILE = """\
schema = 1
name = "booted"
[lasers.primary]
device = { host = "127.0.0.1", port = 2112 }
[zenoh]
listen = ["tcp/127.0.0.1:7447"]
"""
PROBE_UNIT = """\
[Unit]
After=multi-user.target
SuccessAction=poweroff
FailureAction=poweroff
[Service]
Type=oneshot
TimeoutStartSec=150
Environment=LD_LIBRARY_PATH=/opt/python/lib
ExecStart=/opt/python/bin/{python} /probe/systemd_probe.py
"""
# What /opt/rtlog is on a board, a virtual environment, without copying it.
SERVER = """\
#!/bin/sh
export PYTHONPATH=/opt/source:/opt/packages PYTHONDONTWRITEBYTECODE=1 LD_LIBRARY_PATH=/opt/python/lib
exec /opt/python/bin/{python} -m rtlog_server.cli "$@"
"""


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What the probe saw."""
    if os.geteuid() != 0 or shutil.which("systemd-nspawn") is None or not Path("/usr/lib/systemd/systemd").exists():
        pytest.skip("no systemd can be booted: it takes root, and apt-get install systemd systemd-container")
    folder = tmp_path_factory.mktemp("container")
    for name in ("report", "bin"):
        (folder / name).mkdir()
    folder.chmod(0o755)
    python = f"python{sysconfig.get_python_version()}"
    files = {"vehicle.toml": PROFILE, "default": "RTLOG_PROFILE=/etc/rtlog/vehicle.toml\n"}
    files |= {"probe.service": PROBE_UNIT.format(python=python), "bin/rtlog-server": SERVER.format(python=python)}
    # the lines of the rules that each vehicle fills in are checked as well
    files["rules"] = re.sub(r"^#(SUBSYSTEM|ACTION)", r"\1", (ROOT / "systemd/70-rtlog.rules").read_text(), flags=re.M)
    for name, text in files.items():
        (folder / name).write_text(text)
    (folder / "bin/rtlog-server").chmod(0o755)
    places = {
        ROOT / "systemd/rtlog-server.service": "/etc/systemd/system/rtlog-server.service",
        ROOT / "systemd/rtlog.sysusers.conf": "/etc/sysusers.d/rtlog.conf",
        folder / "rules": "/etc/udev/rules.d/70-rtlog.rules",
        folder / "probe.service": "/etc/systemd/system/probe.service",
        folder / "vehicle.toml": "/etc/rtlog/vehicle.toml",
        folder / "bin": "/opt/rtlog/bin",
        sys.base_prefix: "/opt/python",
        sysconfig.get_path("purelib"): "/opt/packages",
        ROOT: "/opt/source",
        ROOT / "tests/hil": "/probe",
    }
    command = ["systemd-nspawn", "--quiet", "--directory=/", "--volatile=yes", "--register=no", "--keep-unit"]
    command += ["--private-network", "--capability=CAP_IPC_LOCK,CAP_SYS_NICE", "--console=pipe"]
    command += [f"--bind-ro={source}:{place}" for source, place in places.items()]
    command += [f"--bind={folder}/report:/report", f"--bind={folder}/default:/etc/default/rtlog-server"]
    command += ["--boot", "systemd.firstboot=off", "systemd.wants=probe.service"]
    try:
        booted = subprocess.run(command, capture_output=True, timeout=BOOT_S, check=False)
    except subprocess.TimeoutExpired as error:
        pytest.fail(f"the container did not end by itself: {(error.stdout or b'')[-2000:].decode(errors='replace')}")
    if not (folder / "report/journal.txt").exists():
        pytest.skip(f"no systemd can be booted: {booted.stderr.decode(errors='replace')[-300:]}")
    assert (folder / "report/report.json").exists(), (folder / "report/journal.txt").read_text()[-3000:]
    return json.loads((folder / "report/report.json").read_text())


def test_it_starts_and_says_how_it_is(report: dict[str, Any]) -> None:
    assert report["start"] == ""
    assert re.match(r"\d+ ticks, 0 dropped, 0 overruns; late by .*; laser/primary MISSING$", report["status_text"])


def test_it_is_a_user_of_its_own_with_real_time_and_locked_memory(report: dict[str, Any]) -> None:
    process = report["process"]
    user = re.match(r"uid=(\d+)\(rtlog\) gid=\d+\(rtlog\) groups=.*\(dialout\)", report["user"])
    assert user is not None, report["user"]
    assert set(process["Uid"].split()) == {user[1]} != {"0"}
    assert process["fifo 80"] == "True"
    assert int(process["threads"]) >= 3  # the tick loop, the outbox, a driver
    assert int(process["VmLck"].split()[0]) > 10_000  # kB
    assert (process["NoNewPrivs"], process["Seccomp"]) == ("1", "2")
    assert int(process["CapEff"], 16) == 1 << 23 | 1 << 14  # CAP_SYS_NICE, CAP_IPC_LOCK and no more


def test_a_hung_tick_loop_is_started_anew_and_tells_where_it_hung(report: dict[str, Any]) -> None:
    assert report["after_hang"] == {"NRestarts": "1", "ActiveState": "active"}
    assert "Watchdog timeout" in report["journal_of_hang"]
    assert "Fatal Python error: Aborted" in report["journal_of_hang"]
    assert 2 < report["watchdog_s"] < 15  # 3 s of silence, 1 s until the restart, the start


def test_it_is_started_anew_when_killed(report: dict[str, Any]) -> None:
    assert report["after_kill"] == {"NRestarts": "2", "ActiveState": "active"}


def test_it_stops_cleanly(report: dict[str, Any], capsys: pytest.CaptureFixture[str]) -> None:
    with capsys.disabled():
        print("\nseconds: " + ", ".join(f"{name[:-2]} {report[name]:.1f}" for name in report if name.endswith("_s")))
    assert report["after_stop"] == {"ActiveState": "inactive", "Result": "success", "ExecMainStatus": "0"}
    assert report["stop_s"] < 5


def test_a_wrong_profile_is_not_tried_again(report: dict[str, Any]) -> None:
    assert report["wrong_profile"] == {"ActiveState": "failed", "ExecMainStatus": "2", "NRestarts": "0"}


def test_udev_understands_the_rules(report: dict[str, Any]) -> None:
    read, *complaints = report["udev"]
    assert read.startswith("Reading rules file: ")
    assert complaints == []

"""`rtlog-server` as a user meets it: exit statuses, one line for what is wrong, the table of `check`."""

import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from patience import PATIENCE_S

from rtlog_server.cli import main

COMMAND = [sys.executable, "-m", "rtlog_server.cli"]
# On a busy machine the publishing process is loading for longer than the server waits for its end.
PATIENT = f"""
import sys
from rtlog_server import cli, daemon

daemon.CLOSE_PUBLISHER_S = {PATIENCE_S}
sys.exit(cli.main())
"""


@pytest.mark.parametrize("verb", ["run", "check"])
def test_help_of_each_verb_has_an_example(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([verb, "--help"])
    assert f"example:\n  rtlog-server {verb} --profile canmet_trailer" in capsys.readouterr().out


@pytest.mark.parametrize("verb", ["run", "check"])
def test_a_wrong_key_is_one_line_and_status_2(verb: str, absent_profile: Path) -> None:
    absent_profile.write_text(absent_profile.read_text().replace("track_width_m", "track_wdith_m"))
    command = [*COMMAND, verb, "--profile", str(absent_profile)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    expected = f"profile {absent_profile}: unknown key vehicle.track_wdith_m; the nearest known one is track_width_m"
    assert (result.returncode, result.stdout, result.stderr) == (2, "", f"rtlog-server: {expected}\n")


@pytest.mark.parametrize("verb", ["run", "check"])
@pytest.mark.parametrize(
    ("section", "replacement", "named"),
    [
        (r"\[lasers\.primary\]\ndevice = .*\n", "", r"\[lasers\.primary\.device\]"),
        (r"\[encoder_bus\]\n.*\n.*\n", "", r"\[encoder_bus\]"),
        (r"device = .*\n\[zenoh\]", "[zenoh]", r"\[rfid\.device\]"),
        (r'name = "testbed"', 'name = "test/*"', r"name is 'test/\*'"),
    ],
)
def test_a_profile_that_cannot_be_run_is_refused(
    verb: str, section: str, replacement: str, named: str, absent_profile: Path
) -> None:
    text, count = re.subn(section, replacement, absent_profile.read_text())
    assert count == 1
    absent_profile.write_text(text)
    command = [*COMMAND, verb, "--profile", str(absent_profile)]  # a process of its own: `run` becomes real-time
    result = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert (result.returncode, result.stdout) == (2, "")
    assert re.fullmatch(rf"rtlog-server: profile .*{named}.*\n", result.stderr)


def test_check_names_every_device_that_is_away(absent_profile: Path) -> None:
    command = [*COMMAND, "check", "--profile", str(absent_profile)]
    result = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert result.returncode == 1
    assert result.stderr == ""
    _, *lines = result.stdout.splitlines()
    rows, advice = lines[::2], lines[1::2]
    assert [row.split()[:3] for row in rows] == [
        [device, "reachable", "WRONG"] for device in ("laser/primary", "encoders", "rfid")
    ]
    assert "refused" in rows[0]
    assert "No such file" in rows[1]
    assert all(line.startswith("  -> ") for line in advice)
    assert "ping 127.0.0.1" in advice[2]


def test_a_signal_before_the_publisher_is_up_ends_it_cleanly(absent_profile: Path) -> None:
    command = [sys.executable, "-c", PATIENT, "run", "--profile", str(absent_profile)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        lines = [next(line for line in process.stderr if "real time" in line)]
        process.terminate()
        lines += process.stderr.readlines()
        assert process.wait(timeout=PATIENCE_S) == 0
    assert not [line for line in lines if "Traceback" in line or "publishing" in line]


def test_a_taken_port_is_one_line(absent_profile: Path) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        text = re.sub(r"listen = .*", f'listen = ["tcp/127.0.0.1:{port}"]', absent_profile.read_text())
        absent_profile.write_text(text)
        command = [*COMMAND, "run", "--profile", str(absent_profile)]
        result = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE_S, check=False)
    assert result.returncode == 1
    last_line = result.stderr.splitlines()[-1]
    assert re.match(rf"rtlog-server: zenoh on tcp/127\.0\.0\.1:{port}: .*in use", last_line), last_line
    assert "Traceback" not in result.stderr

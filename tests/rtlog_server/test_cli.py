"""`rtlog-server` as a user meets it: exit statuses, one line for what is wrong, the table of `check`."""

import json
import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest


def rtlog_server(*args: object, timeout_s: float = 15) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "rtlog_server.cli", *map(str, args)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


@pytest.mark.parametrize("verb", ["run", "check"])
def test_help_of_each_verb_has_an_example(verb: str) -> None:
    result = rtlog_server(verb, "--help")
    assert result.returncode == 0
    assert f"example:\n  rtlog-server {verb} --profile canmet_trailer" in result.stdout


@pytest.mark.parametrize("verb", ["run", "check"])
def test_a_wrong_key_is_one_line_and_status_2(verb: str, absent_profile: Path) -> None:
    absent_profile.write_text(absent_profile.read_text().replace("track_width_m", "track_wdith_m"))
    result = rtlog_server(verb, "--profile", absent_profile)
    expected = f"profile {absent_profile}: unknown key vehicle.track_wdith_m; the nearest known one is track_width_m"
    assert (result.returncode, result.stdout, result.stderr) == (2, "", f"rtlog-server: {expected}\n")


@pytest.mark.parametrize("verb", ["run", "check"])
@pytest.mark.parametrize(
    ("section", "named"),
    [
        (r"\[lasers\.primary\]\ndevice = .*\n", "[lasers.primary.device]"),
        (r"\[encoder_bus\]\n.*\n.*\n", "[encoder_bus]"),
        (r"device = .*\n\[zenoh\]", "[rfid.device]"),
    ],
)
def test_a_profile_for_processing_alone_is_refused(verb: str, section: str, named: str, absent_profile: Path) -> None:
    text, count = re.subn(section, "[zenoh]" if "zenoh" in section else "", absent_profile.read_text())
    assert count == 1
    absent_profile.write_text(text)
    result = rtlog_server(verb, "--profile", absent_profile)
    assert result.returncode == 2
    assert named in result.stderr
    assert len(result.stderr.splitlines()) <= 1


def test_a_name_that_is_no_zenoh_key_is_refused(absent_profile: Path) -> None:
    absent_profile.write_text(absent_profile.read_text().replace('name = "testbed"', 'name = "test/*"'))
    result = rtlog_server("run", "--profile", absent_profile)
    assert result.returncode == 2
    assert re.fullmatch(r"rtlog-server: profile .*: name is 'test/\*'.*\n", result.stderr)


def test_check_names_every_device_that_is_away(absent_profile: Path) -> None:
    began = time.monotonic()
    result = rtlog_server("check", "--profile", absent_profile)
    assert time.monotonic() - began < 10
    assert result.returncode == 1
    assert result.stderr == ""
    heading, *rows = result.stdout.splitlines()
    assert heading.split()[:4] == ["device", "address", "reachable", "identity"]
    assert [row.split()[0] for row in rows] == ["laser/primary", "encoders", "rfid"]
    assert [row.split()[2] for row in rows] == ["no", "no", "no"]
    assert "No such file" in rows[1]
    assert "refused" in rows[0]


def test_check_in_json(absent_profile: Path) -> None:
    result = rtlog_server("check", "--profile", absent_profile, "--json")
    assert result.returncode == 1
    answers = {answer["device"]: answer for answer in json.loads(result.stdout)}
    assert not any(answer["reachable"] for answer in answers.values())
    assert answers["encoders"]["address"].endswith("absent")
    assert "dialout" in answers["encoders"]["advice"]


def test_a_taken_port_is_one_line(absent_profile: Path) -> None:
    with socket.socket() as holder:
        holder.bind(("127.0.0.1", 0))
        holder.listen()
        port = holder.getsockname()[1]
        text = re.sub(r"listen = .*", f'listen = ["tcp/127.0.0.1:{port}"]', absent_profile.read_text())
        absent_profile.write_text(text)
        result = rtlog_server("run", "--profile", absent_profile)
    assert result.returncode == 1
    last_line = result.stderr.splitlines()[-1]
    assert re.match(rf"rtlog-server: zenoh on tcp/127\.0\.0\.1:{port}: .*in use", last_line), last_line
    assert "Traceback" not in result.stderr

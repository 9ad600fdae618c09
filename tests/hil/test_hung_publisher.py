"""A publishing process that hangs for good ends the server, for systemd to start it anew."""

import os
import signal
import subprocess
import sys
from pathlib import Path

PROFILE = """\
schema = 1
name = "hung"
tick_period_s = 0.01
lasers.primary.device = { host = "127.0.0.1", port = 9 }
zenoh.listen = ["tcp/127.0.0.1:0"]
"""


def test_a_publishing_process_that_hangs_ends_the_server(tmp_path: Path) -> None:
    profile = tmp_path / "hung.toml"
    profile.write_text(PROFILE)
    command = [sys.executable, "-m", "rtlog_server.cli", "run", "--profile", str(profile)]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
        assert server.stderr is not None
        next(line for line in server.stderr if "publishing" in line)
        (publisher,) = Path(f"/proc/{server.pid}/task/{server.pid}/children").read_text().split()
        os.kill(int(publisher), signal.SIGSTOP)
        try:
            told = server.stderr.readlines()
            assert server.wait(timeout=60) == 1
        finally:
            server.kill()
    assert "publishing process" in told[-1]
    assert not [line for line in told if "Traceback" in line]
    assert not Path(f"/proc/{publisher}").exists()

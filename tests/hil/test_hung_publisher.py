"""A publishing process that hangs for good ends the server, for systemd to start it anew."""

import os
import signal
from pathlib import Path

from rig import command

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
    with command("rtlog_server.cli", "run", "--profile", profile) as server:
        server.wait_for("publishing")
        publisher = server.child()
        os.kill(publisher, signal.SIGSTOP)
        assert server.popen.wait(timeout=60) == 1
    assert "publishing process" in server.lines[-1]
    assert not [line for line in server.lines if "Traceback" in line]
    assert not Path(f"/proc/{publisher}").exists()

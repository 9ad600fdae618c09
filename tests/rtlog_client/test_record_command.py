"""The command that records, stopped by signals and killed: what it had is there."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from patience import PATIENCE_S

from rtlog_client.cli import main
from rtlog_client.log_file import read_info
from rtlog_server.topics import JOINT_STATES, PRIMARY_SCAN, TAGS, TICK

EVERY_TICK = (TICK.name, PRIMARY_SCAN.name, JOINT_STATES.name, TAGS.name)
StartServer = Callable[..., Any]


@contextmanager
def record_command(server: Any, folder: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "rtlog_client.cli", "record", "-o", str(folder), "--connect", server.endpoint]
    pipe = subprocess.PIPE
    with subprocess.Popen([*command, *options], stdout=pipe, stderr=pipe, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def record_30_ticks(server: Any, process: subprocess.Popen[str]) -> None:
    """Returns when the process has told that it has synced them."""
    assert process.stderr is not None
    server.wait_for_subscriber()
    for k in range(30):
        server.tick(k)
    assert any(line.startswith("30 ticks  0 lost") for line in process.stderr)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_leaves_a_finished_file(start_server: StartServer, tmp_path: Path, number: signal.Signals) -> None:
    server = start_server()
    with record_command(server, tmp_path, "--json") as process:
        record_30_ticks(server, process)
        process.send_signal(number)
        output, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    [summary] = json.loads(output)
    assert summary["ticks"] == 30
    assert summary["lost"] == {}
    assert [str(p) for p in tmp_path.iterdir()] == [summary["path"]]
    assert summary["path"].endswith("Z_bench.mcap")
    assert read_info(Path(summary["path"])).message_counts[TICK.name] == 30


def test_a_killed_recording_gives_back_what_was_synced(start_server: StartServer, tmp_path: Path) -> None:
    server = start_server()
    with record_command(server, tmp_path, "--name", "run") as process:
        record_30_ticks(server, process)
        process.kill()
    assert main(["recover", str(tmp_path / "run.mcap.part")]) == 0
    assert read_info(tmp_path / "run.mcap").message_counts[TICK.name] == 30

"""What the system grants is taken, what it does not is told; in processes of their own, whose scheduling changes."""

import os
import shutil
import subprocess
import sys

import pytest

PROGRAM = """
import os, threading
from rtlog_server.realtime import become_realtime
answers = become_realtime()
print(answers["scheduler"], answers["memory"], sep="\\n")
print(os.sched_getscheduler(0) == os.SCHED_FIFO)
seen = []
thread = threading.Thread(target=lambda: seen.append(os.sched_getscheduler(0)))
thread.start()
thread.join()
print(seen[0] == os.SCHED_FIFO)
print([line.split()[1] != "0" for line in open("/proc/self/status") if line.startswith("VmLck")][0])
"""


def answers(*prefix: str) -> list[str]:
    command = [*prefix, sys.executable, "-c", PROGRAM]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


def test_the_answer_is_the_truth() -> None:
    scheduler, memory, is_fifo, thread_is_fifo, is_locked = answers()
    assert is_fifo == thread_is_fifo == str(scheduler.startswith("SCHED_FIFO 80"))
    assert is_locked == str(memory == "locked")


@pytest.mark.skipif(os.geteuid() != 0 or not shutil.which("setpriv"), reason="only root can give up capabilities")
def test_what_is_not_granted_is_told() -> None:
    scheduler, memory, is_fifo, thread_is_fifo, is_locked = answers("setpriv", "--bounding-set=-sys_nice,-ipc_lock")
    assert scheduler == "SCHED_FIFO not granted: Operation not permitted"
    assert memory.startswith("not locked: the limit is")
    assert is_fifo == thread_is_fifo == is_locked == "False"

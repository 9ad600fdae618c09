"""When did this machine stand still? A byte is sent through a pseudo-terminal every few milliseconds, and timed.

In: nothing. Out: `Stall`s. The byte needs a turn of this thread and one of the kernel's terminal worker, as what a
device on a serial line sends does; what it waits for either, no device and no driver can help.
"""

import os
import threading
import time
import tty
from typing import Self

from rtlog_client.replay_report import Stall

STEP_S = 0.002
STALL_NS = 2_000_000  # longer than a byte should take and this thread should sleep
MAX_STALLS = 100_000


class StallWatch:
    """A context manager; `stalls` in UTC, given its offset from the monotonic clock."""

    def __init__(self, utc_offset_ns: int) -> None:
        self.stalls: list[Stall] = []
        self._utc_offset_ns = utc_offset_ns
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stalls", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        into, out = os.openpty()
        tty.setraw(out)
        while not self._stopping.is_set() and len(self.stalls) < MAX_STALLS:
            began_ns = time.monotonic_ns()
            os.write(into, b"\0")
            os.read(out, 1)
            time.sleep(STEP_S)
            ended_ns = time.monotonic_ns()
            if ended_ns - began_ns > STALL_NS + round(STEP_S * 1e9):
                self.stalls.append(Stall(began_ns + self._utc_offset_ns, ended_ns + self._utc_offset_ns))
        os.close(into)
        os.close(out)

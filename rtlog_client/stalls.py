"""When did this process not get to run? A thread wakes up every few milliseconds; what it slept too long is a stall.

In: nothing. Out: `Stall`s. A replay that stood still gave its devices no time to answer, which is no fault of theirs.
"""

import threading
import time
from typing import Self

from rtlog_client.replay_report import Stall

STEP_NS = 5_000_000
STALL_NS = 5_000_000  # that it slept longer
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
        due_ns = time.monotonic_ns() + STEP_NS
        while not self._stopping.is_set() and len(self.stalls) < MAX_STALLS:
            time.sleep(max(0, due_ns - time.monotonic_ns()) * 1e-9)
            woken_ns = time.monotonic_ns()
            if woken_ns - due_ns > STALL_NS:
                self.stalls.append(Stall(due_ns + self._utc_offset_ns, woken_ns + self._utc_offset_ns))
            due_ns = woken_ns + STEP_NS

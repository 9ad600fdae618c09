"""What tests of running devices wait with: no load makes them fail, and nothing waits longer than it must."""

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

PATIENCE_S = 60.0  # for what comes within moments; only a machine that stands still takes longer


def wait_until(condition: Callable[[], object], what: Callable[[], object] = str) -> None:
    """Wait for a condition; `what` says how things stand where it does not come about."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {PATIENCE_S} s {what()}"
        time.sleep(0.005)


class Told:
    """All that a device says in its `message`: words that are soon followed by others are not missed."""

    def __init__(self, device: Any) -> None:
        self._messages: list[str] = []
        self._found = 0
        kind = type(device)

        def keep(device: Any, name: str, value: Any) -> None:
            if name == "message":
                self._messages.append(value)
            super(kind, device).__setattr__(name, value)

        device.__class__ = type(kind.__name__, (kind,), {"__setattr__": keep})

    def __call__(self, part: str) -> bool:
        """Whether this was said, after what was found last."""
        for number, message in enumerate(self._messages[self._found :], self._found):
            if part in message:
                self._found = number + 1
                return True
        return False


def left_behind(before: tuple[int, int]) -> bool:
    """Whether more descriptors or threads are in use than before."""
    return any(now > then for now, then in zip(in_use(), before, strict=True))


def in_use() -> tuple[int, int]:
    """Descriptors and threads of this process."""
    return len(list(Path("/proc/self/fd").iterdir())), threading.active_count()

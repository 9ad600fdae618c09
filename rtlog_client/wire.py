"""A wire between a host and an emulated device, and what can go wrong with it.

    host ═══ address of the profile ── Wire ── hidden address ═══ emulator
                                        │
                             fault: drop, delay, garble, cut, restart, swap

In: bytes from either end. Out: the same bytes at the other, bent by the fault at hand. The law: a wire knows nothing of
what it carries, so it serves every device; without a fault every byte passes at once and in order. Drop, delay and
garble are done to what the device sends.
"""

import queue
import random
import selectors
import socket
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from typing import Any, Self

from rtlog_client.faults import Fault
from rtlog_server.devices.device import DeviceError

READ_BYTES = 65536


class Wire(ABC):
    """A thread that owns the wire's state; everything else asks it. A context manager.

    Raises:
        OSError, DeviceError: on entering: an address is taken, or not there.
    """

    def __init__(self, name: str, seed: int) -> None:
        self.fault: Fault | None = None
        self.noise = random.Random(f"{seed} {name}")  # each wire its own, whatever the others carry
        self._tasks: queue.SimpleQueue[tuple[Callable[[], None], Future[None]]] = queue.SimpleQueue()
        self._selector = selectors.DefaultSelector()
        self._wake, self._waker = socket.socketpair()
        self._selector.register(self._wake, selectors.EVENT_READ, self._run_tasks)
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=f"wire {name}", daemon=True)

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            for opened in (self._wake, self._waker, self._selector):
                stack.callback(opened.close)
            self._open()
            self._thread.start()
            self._opened = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._call(self._close)
        self._thread.join()
        self._opened.close()

    def begin(self, fault: Fault) -> None:
        """Raises, as `end` does: OSError, DeviceError: an address is taken meanwhile, or gone."""
        self._call(lambda: self._begin(fault))

    def end(self) -> None:
        self._call(self._end)

    # In the thread

    def bend(self, data: bytes) -> bytes:
        """What is left of `data` from the device under the fault at hand."""
        fault = self.fault
        if fault is not None and fault.kind == "drop":
            return b""
        if fault is not None and fault.kind == "garble":
            return bytes(byte ^ self.noise.randrange(1, 256) if self._hit(fault) else byte for byte in data)
        return data

    def _hit(self, fault: Fault) -> bool:
        return self.noise.random() < (fault.share or 0.0)

    @abstractmethod
    def _open(self) -> None:
        """Take the wire's addresses, before the thread starts. Raises: OSError, DeviceError."""

    @abstractmethod
    def _begin(self, fault: Fault) -> None: ...
    @abstractmethod
    def _end(self) -> None: ...
    @abstractmethod
    def _flush(self) -> float | None:
        """Send what is due; how long until more is (None: nothing waits)."""

    @abstractmethod
    def _shut(self) -> None:
        """Release everything."""

    def _call(self, function: Callable[[], None]) -> None:
        task: Future[None] = Future()
        self._tasks.put((function, task))
        self._waker.send(b"\0")
        task.result()

    def _run_tasks(self) -> None:
        self._wake.recv(4096)
        while not self._tasks.empty():
            function, task = self._tasks.get()
            try:
                function()
            except (OSError, DeviceError) as error:
                task.set_exception(error)  # raised where it was asked for
            else:
                task.set_result(None)

    def _run(self) -> None:
        wait_s = None
        while not self._closing:
            for key, _ in self._selector.select(wait_s):
                key.data()
            wait_s = self._flush() if not self._closing else None

    def _close(self) -> None:
        self._closing = True
        self._shut()

    def _watch(self, end: Any, function: Callable[[], None]) -> None:
        self._selector.register(end, selectors.EVENT_READ, function)

    def _ignore(self, end: Any) -> None:
        if end in self._selector.get_map():
            self._selector.unregister(end)


class Flow:
    """One direction: bytes that wait for their time, in order; b"" is the end."""

    def __init__(self, write: Callable[[bytes], Any], from_device: bool) -> None:
        self.ended = False
        self._write = write
        self._from_device = from_device
        self._waiting: deque[tuple[float, bytes]] = deque()

    def put(self, data: bytes, wire: Wire) -> None:
        due_s = time.monotonic()
        if self._from_device:
            if data and not (data := wire.bend(data)):
                return
            due_s += wire.fault.by_s or 0.0 if wire.fault is not None else 0.0
        self._waiting.append((max(due_s, self._waiting[-1][0] if self._waiting else 0.0), data))

    def flush(self) -> float | None:
        """Send what is due; how long until more is. Raises: OSError: the other end is gone."""
        while self._waiting and (left_s := self._waiting[0][0] - time.monotonic()) <= 0:
            _, data = self._waiting.popleft()
            self._write(data)
            self.ended = self.ended or not data
        return left_s if self._waiting else None

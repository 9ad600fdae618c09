"""A thread that waits for sockets and for times, and does what others ask of it: all state in one thread, no locks.

In: sockets to watch, functions to call now or at a time (monotonic ns). Out: their calls, one after the other.
"""

import heapq
import itertools
import queue
import selectors
import socket
import threading
import time
from collections.abc import Callable
from typing import Any

Function = Callable[..., object]


class EventLoop:
    def __init__(self, name: str) -> None:
        self._tasks: queue.SimpleQueue[tuple[Function, tuple[Any, ...], threading.Event]] = queue.SimpleQueue()
        self._timers: list[tuple[int, int, Function, tuple[Any, ...]]] = []
        self._order = itertools.count()
        self._selector = selectors.DefaultSelector()
        self._wake, self._waker = socket.socketpair()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self.watch(self._wake, self._run_tasks)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """End the thread; the sockets that it watches are their owners' to close."""
        self.call(setattr, self, "_closing", True)
        self._thread.join()
        self._selector.close()
        self._wake.close()
        self._waker.close()

    # For other threads

    def post(self, function: Function, *arguments: Any) -> threading.Event:
        """Have the thread do it, soon; the event is set when it is done."""
        done = threading.Event()
        self._tasks.put((function, arguments, done))
        self._waker.send(b"\0")
        return done

    def call(self, function: Function, *arguments: Any) -> None:
        """Have the thread do it, and wait until it is done."""
        self.post(function, *arguments).wait()

    # For functions in the thread, and before it is started

    def watch(self, readable: socket.socket, function: Function) -> None:
        """Call `function` whenever the socket has something to read."""
        self._selector.register(readable, selectors.EVENT_READ, function)

    def forget(self, readable: socket.socket) -> None:
        self._selector.unregister(readable)

    def at(self, due_ns: int, function: Function, *arguments: Any) -> None:
        heapq.heappush(self._timers, (due_ns, next(self._order), function, arguments))

    def _run(self) -> None:
        while not self._closing:
            wait_s = max(0.0, (self._timers[0][0] - time.monotonic_ns()) * 1e-9) if self._timers else None
            for key, _ in self._selector.select(wait_s):
                key.data()
            while self._timers and self._timers[0][0] <= time.monotonic_ns():
                _, _, function, arguments = heapq.heappop(self._timers)
                function(*arguments)

    def _run_tasks(self) -> None:
        self._wake.recv(4096)
        while not self._tasks.empty():
            function, arguments, done = self._tasks.get()
            function(*arguments)
            done.set()

"""The tick thread's way to another process: a bounded queue, and a thread that writes it to a pipe.

In: objects, from one thread. Out: the same objects, pickled, at the other end of the pipe. The law: `put` never waits.
A reader that does not keep up costs whole objects, which are counted; a reader that is gone costs all the rest.
"""

import threading
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any


class Outbox:
    def __init__(self, connection: Connection, capacity: int) -> None:
        self.dropped = 0
        self._connection = connection
        self._capacity = capacity
        self._queue: SimpleQueue[Any] = SimpleQueue()
        self._thread = threading.Thread(target=self._send, name="outbox", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def put(self, item: object) -> bool:
        """Queue an item; False, and one more dropped, if the queue is full."""
        if self._queue.qsize() >= self._capacity:  # exact: this thread alone puts, so the size can only have shrunk
            self.dropped += 1
            return False
        self._queue.put(item)
        return True

    def close(self, timeout_s: float) -> bool:
        """Write what is queued, then end the pipe; False if the reader did not take it all in time."""
        self._queue.put(None)
        self._thread.join(timeout_s)
        finished = not self._thread.is_alive()
        if finished:
            self._connection.close()
        return finished and self._queue.empty()

    def _send(self) -> None:
        try:
            while (item := self._queue.get()) is not None:
                self._connection.send(item)
        except (BrokenPipeError, ConnectionResetError):  # the reader died: its owner notices that by its exit status
            return

"""What every emulated encoder bus shares: a thread that serves it, encoders cut off from it, the host cut off from it.

In: how a bus is plugged in, served and pulled. Out: a context manager with these faults. Used by emulators only.
"""

import threading
from abc import ABC, abstractmethod
from typing import Self

WATCH_S = 0.02  # how often the thread looks whether it is to stop


class EmulatedBus(ABC):
    """A bus, running from `replug()`, which its constructor calls last, to `close()`; a context manager.

    Args:
        name: of its thread.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._muted: set[int] = set()
        self._unplugged = threading.Event()
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.unplug()

    def mute(self, address: int, muted: bool = True) -> None:
        """The encoder is cut off from the bus, or back; it keeps its power."""
        (self._muted.add if muted else self._muted.discard)(address)

    def unplug(self) -> None:
        """The bus is cut from the host; an adapter is pulled: its terminal hangs up, its name is gone."""
        if self._thread is None:
            return
        self._unplugged.set()
        self._thread.join()
        self._thread = None
        self._pull()

    def replug(self) -> None:
        """The host has the bus again; an adapter is back under the same name."""
        self._plug()
        self._unplugged.clear()
        self._thread = threading.Thread(target=self._serve, name=self._name, daemon=True)
        self._thread.start()

    @abstractmethod
    def _plug(self) -> None: ...

    @abstractmethod
    def _pull(self) -> None: ...

    @abstractmethod
    def _serve(self) -> None:
        """The thread: answer until `_unplugged` is set, and look at it each `WATCH_S`."""

"""What a device is to the sampler: a thread of its own that connects, reads, hands over samples and reconnects.

    driver thread   connect → read, read, read … ─ error or silence → disconnect → wait → connect …
                                 │ hand_over(sample)
                                 v
    tick thread               collect(tick)         never waits, never fails

The law: nothing that a device does can delay a tick or end the daemon. A device that is away is a state, a line of
explanation and a next attempt. All times here are nanoseconds of the host's monotonic clock.
"""

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from hw_profiles.errors import RTLogError
from rtlog_server.messages import MISSING, OK, STALE

log = logging.getLogger(__name__)

RETRY_FIRST_S = 0.1
RETRY_LAST_S = 1.0  # back within 2 s of the device's return
INBOX_SAMPLES = 1024  # 20 s of a 50 Hz scanner; a sampler that stands still that long has lost its ticks anyway


class DeviceError(RTLogError):
    """The device is away, silent, refuses or talks nonsense: one line that says what and where."""


@dataclass(frozen=True, slots=True)
class TickGrid:
    """When ticks are: tick k is at `start_ns + k * period_ns` on the monotonic clock."""

    start_ns: int
    period_ns: int

    def next_after(self, now_ns: int) -> int:
        """The first tick time after `now_ns`."""
        ticks = max(0, (now_ns - self.start_ns) // self.period_ns + 1)
        return self.start_ns + ticks * self.period_ns


class Timed(Protocol):
    """A sample says when it was measured and when it was complete (a sweep takes time)."""

    @property
    def measured_ns(self) -> int: ...
    @property
    def complete_ns(self) -> int: ...


SampleT = TypeVar("SampleT", bound=Timed)


@dataclass(frozen=True, slots=True)
class Collected(Generic[SampleT]):
    """What a tick gets from a device."""

    samples: list[SampleT]  # complete since the last tick and not after this one, oldest first
    state: int  # OK, STALE or MISSING
    age_s: float  # of the newest sample ever, at the tick; +inf if there was none


class Device(ABC, Generic[SampleT]):
    """The frame of every driver. A driver fills in connect, read and disconnect; the rest is here, once."""

    def __init__(self, name: str, stale_after_s: float) -> None:
        self.name = name  # as in SensorState: laser/primary, encoders, rfid
        self.message = "not connected yet"  # one line for diagnostics
        self.connected = False
        self.connects = 0
        self.identity: dict[str, str] = {}  # serial number, firmware …, filled by connect()
        self.diagnostics: dict[str, str] = {}  # what the device says of its own health: temperature, contamination …
        self._stale_after_ns = int(stale_after_s * 1e9)
        self._inbox: deque[SampleT] = deque(maxlen=INBOX_SAMPLES)
        self._measured_ns: int | None = None
        self._heard_ns = 0
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None
        self.grid: TickGrid | None = None

    # A driver's part, called in the driver's thread:

    @abstractmethod
    def connect(self) -> None:
        """Open and configure the device, fill `identity`. Raises: DeviceError, OSError."""

    @abstractmethod
    def read(self) -> None:
        """Wait at most half a second for data and hand over what came. Raises: DeviceError, OSError."""

    @abstractmethod
    def disconnect(self) -> None:
        """Release everything, also after a connect() that failed half-way; must not raise OSError."""

    def hand_over(self, sample: SampleT) -> None:
        """Give a sample to the tick thread."""
        self._inbox.append(sample)
        self.heard()

    def heard(self) -> None:
        """The device gave a sign of life that is no sample."""
        self._heard_ns = time.monotonic_ns()

    def pause(self, seconds: float) -> bool:
        """Sleep, but wake up at once when the device is closed; True if it was."""
        return self._stopping.wait(seconds)

    # The sampler's part, called in the tick thread:

    def collect(self, tick_ns: int) -> Collected[SampleT]:
        """The samples that were complete by the tick and not collected before, and the device's state at it."""
        samples = []
        while self._inbox and self._inbox[0].complete_ns <= tick_ns:
            samples.append(self._inbox.popleft())
        if samples:
            self._measured_ns = samples[-1].measured_ns
        if not self.connected:
            state = MISSING
        elif tick_ns - self._heard_ns > self._stale_after_ns:
            state = STALE
        else:
            state = OK
        age_s = float("inf") if self._measured_ns is None else (tick_ns - self._measured_ns) * 1e-9
        return Collected(samples, state, age_s)

    def start(self, grid: TickGrid) -> None:
        """Start the thread; returns at once, whether the device is there or not."""
        self.grid = grid
        self._thread = threading.Thread(target=self._run, name=self.name, daemon=True)
        self._thread.start()

    def close(self, timeout_s: float = 2.0) -> None:
        """Stop the thread and release the device."""
        self._stopping.set()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        retry_s = RETRY_FIRST_S
        while not self._stopping.is_set():
            try:
                self.connect()
                self.heard()  # first: connected and long unheard of, it would be stale to a tick in between
                self.connected, self.message, retry_s = True, "connected", RETRY_FIRST_S
                self.connects += 1
                log.info("%s: connected %s", self.name, self.identity)
                while not self._stopping.is_set():
                    self.read()
            except (DeviceError, OSError) as error:
                if self.connected or str(error) != self.message:
                    log.warning("%s: %s", self.name, error)
                self.message = str(error)
            except Exception as error:  # a fault of the driver, not of the device: no reason to lose it for good
                log.exception("%s: fault in the driver", self.name)
                self.message = f"fault in the driver: {error!r}"
            finally:
                self.connected = False
                self.disconnect()
            self.pause(retry_s)
            retry_s = min(2 * retry_s, RETRY_LAST_S)

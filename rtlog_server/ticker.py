"""Ticks: when to sample, on absolute deadlines of the monotonic clock, and how late it really was.

                  start      +1          +2          +3          +4      tick k is at start + k · period, for ever:
    grid       ─────┼───────────┼───────────┼───────────┼───────────┼──   lateness never adds up
    sampling        └►0         └►1         └─── stopped ──────►2►3 └►4   what was missed is made up for at once, late

The law: the index has no gaps and a tick keeps its scheduled time; how late it came is told, never hidden.

UTC is the monotonic clock plus one offset, read once at start: the rate follows NTP (the kernel slews both clocks
alike), but a step of the wall clock cannot tear a recording. Nor is it corrected by one: a board whose clock is set
only after the server started keeps its wrong date until the next start.
"""

import itertools
import time
from bisect import bisect_left
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rtlog_server.bundle import LatenessSummary
from rtlog_server.devices.device import TickGrid

LEAD_NS = 20_000_000  # to start the device threads before the first tick
LONGEST_SLEEP_S = 0.1  # a request to stop is heeded this soon, also with long periods
BIN_EDGES_S = tuple(1e-5 * 10 ** (k / 10) for k in range(61))  # ten bins a decade, 10 µs … 10 s


@dataclass(frozen=True, slots=True)
class TickTime:
    """A tick; times are nanoseconds of the monotonic clock."""

    index: int
    scheduled_ns: int
    began_ns: int

    @property
    def lateness_ns(self) -> int:
        return self.began_ns - self.scheduled_ns


def utc_offset_ns() -> int:
    """UTC minus monotonic clock now: the tightest of five readings, good to a microsecond."""
    readings = []
    for _ in range(5):
        before, utc, after = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
        readings.append((after - before, utc - (before + after) // 2))
    return min(readings)[1]


def aligned_grid(period_ns: int, offset_ns: int, now_ns: int) -> TickGrid:
    """The grid whose ticks lie at whole multiples of the period in UTC and whose first is the next one with a lead."""
    earliest_utc = now_ns + LEAD_NS + offset_ns
    return TickGrid(-(-earliest_utc // period_ns) * period_ns - offset_ns, period_ns)


def ticks(grid: TickGrid, stopped: Callable[[], bool]) -> Iterator[TickTime]:
    """Sleep to each tick in turn and yield it; the end comes when `stopped()` says so."""
    for index in itertools.count():
        scheduled_ns = grid.start_ns + index * grid.period_ns
        while not stopped() and (left_ns := scheduled_ns - time.monotonic_ns()) > 0:
            time.sleep(min(left_ns * 1e-9, LONGEST_SLEEP_S))
        if stopped():
            return
        yield TickTime(index, scheduled_ns, time.monotonic_ns())


class Lateness:
    """How late the ticks were since the start, in a histogram that stays the same size."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._counts = [0] * (len(BIN_EDGES_S) + 1)
        self._overruns = 0
        self._max_ns = 0

    def add(self, tick: TickTime) -> None:
        self._counts[bisect_left(BIN_EDGES_S, tick.lateness_ns * 1e-9)] += 1
        self._overruns += tick.lateness_ns >= self._period_ns
        self._max_ns = max(self._max_ns, tick.lateness_ns)

    def summary(self) -> LatenessSummary:
        max_s = self._max_ns / 1e9
        edges = [min(edge, max_s) for edge in BIN_EDGES_S] + [max_s]
        totals = list(itertools.accumulate(self._counts))
        p50_s, p99_s = (edges[bisect_left(totals, q * totals[-1])] for q in (0.5, 0.99))
        histogram = [(edge, count) for edge, count in zip(edges, self._counts, strict=True) if count]
        return LatenessSummary(totals[-1], self._overruns, p50_s, p99_s, max_s, histogram)

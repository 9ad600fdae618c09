"""A device's microsecond clock → the host's monotonic clock.

In: pairs of the device's count (u32, wraps after 71.6 min) and the time at which the host received it. Out: the host
time of that count. The law: a delivery is delayed by something, never by less than nothing, so the true relation is a
straight line that lies under all points, and no result is later than its reception.

    receive - device  |        x          x = one delivery
                      |  x        x   x
                      | ___x____________x____   the line: offset, and drift as its slope
                      |    x      x
                      +-----------------------> device time

The line is the edge of the points' lower convex hull below their mean: of all lines under the points the one that is
nearest to them in sum. Points are the fastest delivery of each second in the last minute. Until there are enough for
a slope, the fastest delivery so far sets the offset, so that the first count already gives a time and nothing steps by
more than the deliveries' jitter. What even the fastest delivery takes (cable, kernel) stays in the result.

Source: Moon, Skelly & Towsley, "Estimation and removal of clock skew from network delay measurements", INFOCOM 1999.
"""

from collections import deque
from itertools import pairwise

WRAP_US = 1 << 32
BIN_S = 1.0
WINDOW_S = 60.0
SLOPE_AFTER_S = 10.0  # jitter over a shorter span would be taken for drift
MAX_DRIFT_NS_PER_S = 300_000.0  # 300 ppm; two quartz clocks differ by less
MAX_DISAGREEMENT_US = 10_000_000  # a device whose clock went on so differently from ours was restarted

Point = tuple[float, float]  # device time in s, receive minus device time in ns; both since the first count


class DeviceClock:
    """Follows one device's clock; starts anew when the device was restarted."""

    def __init__(self) -> None:
        self._device_us: int | None = None  # the newest count, unwrapped
        self._receive_ns = 0
        self._first_us = 0
        self._first_ns = 0
        self._points: deque[Point] = deque()
        self._bin_end_s = 0.0
        self._slope = 0.0  # ns/s
        self._intercept = 0.0  # ns

    def update(self, device_us: int, receive_ns: int) -> int:
        """The host time (monotonic ns) at which the device counted `device_us`, 0 … 2^32 - 1.

        To be called with each count in the order of reception; `receive_ns` is when it was received.
        """
        elapsed_us = self._elapsed_us(device_us, receive_ns)
        if self._device_us is None or elapsed_us is None:
            self._start(device_us, receive_ns)
        else:
            self._device_us += elapsed_us
        assert self._device_us is not None
        self._receive_ns = receive_ns
        since_first_us = self._device_us - self._first_us
        time_s = since_first_us * 1e-6
        delay_ns = receive_ns - self._first_ns - 1000 * since_first_us
        self._add(time_s, delay_ns)
        line_ns = self._slope * time_s + self._intercept
        if delay_ns < line_ns:
            self._intercept += delay_ns - line_ns
            line_ns = delay_ns
        return self._first_ns + 1000 * since_first_us + round(line_ns)

    def _elapsed_us(self, device_us: int, receive_ns: int) -> int | None:
        """Device time since the newest count; None if the device was restarted (or is new)."""
        if self._device_us is None:
            return None
        host_us = (receive_ns - self._receive_ns) // 1000
        elapsed_us = (device_us - self._device_us) % WRAP_US
        elapsed_us += WRAP_US * round((host_us - elapsed_us) / WRAP_US)
        return elapsed_us if elapsed_us >= 0 and abs(elapsed_us - host_us) <= MAX_DISAGREEMENT_US else None

    def _start(self, device_us: int, receive_ns: int) -> None:
        self._device_us = self._first_us = device_us
        self._first_ns = receive_ns
        self._points.clear()
        self._bin_end_s = 0.0
        self._slope = self._intercept = 0.0

    def _add(self, time_s: float, delay_ns: float) -> None:
        """Keep the fastest delivery of each second; at the end of a second, fit."""
        if time_s < self._bin_end_s:
            if delay_ns < self._points[-1][1]:
                self._points[-1] = time_s, delay_ns
            return
        while self._points and time_s - self._points[0][0] > WINDOW_S:
            self._points.popleft()
        if self._points:
            self._slope, self._intercept = lower_line(list(self._points), self._slope)
        else:
            self._intercept = delay_ns - self._slope * time_s
        self._points.append((time_s, delay_ns))
        self._bin_end_s = time_s + BIN_S


def lower_line(points: list[Point], slope: float) -> Point:
    """Slope and intercept of the line under the points, ascending in time; `slope` holds while they span too little."""
    if points[-1][0] - points[0][0] >= SLOPE_AFTER_S:
        (t0, d0), (t1, d1) = _edge_below_mean(points)
        slope = min(max((d1 - d0) / (t1 - t0), -MAX_DRIFT_NS_PER_S), MAX_DRIFT_NS_PER_S)
    return slope, min(delay - slope * time for time, delay in points)


def _edge_below_mean(points: list[Point]) -> tuple[Point, Point]:
    """The edge of the lower convex hull whose span holds the mean time (Andrew's monotone chain)."""
    hull: list[Point] = []
    for time, delay in points:
        while len(hull) >= 2:
            (t0, d0), (t1, d1) = hull[-2:]
            if (t1 - t0) * (delay - d0) > (time - t0) * (d1 - d0):
                break
            hull.pop()
        hull.append((time, delay))
    mean = sum(time for time, _ in points) / len(points)
    return next((a, b) for a, b in pairwise(hull) if b[0] >= mean)

"""From the device's view of a sweep to the host's: millimetres → metres, device angles → scanner frame, rays → times.

In: `ScanData` and the host time of its transmission. Out: `Scan`. The scanner turns counter-clockwise seen from above;
its 90° is the scanner frame's x axis.

                 90° x
                  |                 the field: -45° … 225°; the head crosses the rest
        180° y ---o--- 0°           with the laser off
                 . .
           225°       -45°

When was the first ray? The device counts microseconds and stamps each scan at the head's *zero index* "before the
measurement itself starts" (manual), "at the time of the first shot" (SICK's drivers). No source says at which angle
the index lies, only that it lies outside of the field; it is taken to be where the field begins, at -45°, and a
sector that starts later to be measured later by its share of a turn. The index may lie up to 90° earlier, so stamps
may be early by up to a quarter of a turn, 5 ms at 50 Hz, always by the same.

Firmware V1.80.2 sends its scans 3.1 ms after that stamp, which is before the head could have swept the field; another
LMS1xx takes a turn more, 23 ms. So with the former the stamp is that of the index which *ended* the turn: where the
stamp is too late for the last ray to be measured before the transmission, the turn began one period before it.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rtlog_server.clock import WRAP_US
from rtlog_server.devices.laser import Scan
from rtlog_server.devices.lms111.cola import ColaError
from rtlog_server.devices.lms111.scan_data import Channel, ScanData

FIELD_START_1E4DEG = -450_000
FIELD_STOP_1E4DEG = 2_250_000
AHEAD_1E4DEG = 900_000
TURN_1E4DEG = 3_600_000

NO_ECHO = 0
LOWEST_DISTANCE = 16  # smaller ones are codes: dazzled, rejected by a filter, reserved
RANGE_MIN_M = 0.016
RANGE_MAX_M = 20.0

LOWEST_CENTIHZ, HIGHEST_CENTIHZ = 500, 10_000  # 5 to 100 Hz, of any scanner with this protocol
MAX_AGE_US = 5_000_000  # of a sweep that is transmitted; on a connection that stalls the device buffers

MAX_MOTOR_ERROR = 0.02  # of the nominal period; the captured motor ran 0.57 % slow

STATUS = {
    0: "",
    1: "device error",
    2: "front window is dirty",
    4: "front window is too dirty",
    5: "front window is too dirty",
}


def first_ray_delay_us(start_angle_1e4deg: int, period_us: float) -> float:
    """From the zero index to the first ray of a sector."""
    return (start_angle_1e4deg - FIELD_START_1E4DEG) / TURN_1E4DEG * period_us


def sweep_us(rays: int, step_1e4deg: int, period_us: float) -> float:
    """From the first ray to the last."""
    return max(rays - 1, 0) * step_1e4deg / TURN_1E4DEG * period_us


def period_us(scan: ScanData, before: ScanData | None) -> float:
    """One turn of the head: as timed since the sweep before, if that was its neighbour, else the nominal.

    Raises:
        ColaError: no scanner turns as the scan tells.
    """
    if not LOWEST_CENTIHZ <= scan.scan_frequency_centihz <= HIGHEST_CENTIHZ:
        raise ColaError(f"scan frequency is {scan.scan_frequency_centihz / 100:g} Hz")
    nominal_us = 1e8 / scan.scan_frequency_centihz
    if before is not None and (scan.scan_counter - before.scan_counter) % 65536 == 1:
        timed_us = (scan.time_since_startup_us - before.time_since_startup_us) % WRAP_US
        if abs(timed_us - nominal_us) <= MAX_MOTOR_ERROR * nominal_us:
            return timed_us
    return nominal_us


def ranges_m(distances: Channel) -> NDArray[np.float32]:
    """(N,) ranges, REP-117: +inf where no echo came back, NaN for the codes of rays that the device rejects."""
    millimetres = distances.data * distances.scale_factor + distances.scale_offset
    ranges = (millimetres * 1e-3).astype(np.float32)
    ranges[(distances.data < LOWEST_DISTANCE) | (ranges <= 0)] = np.nan
    ranges[distances.data == NO_ECHO] = np.inf
    return ranges


def echoes(scan: ScanData, echo: str) -> tuple[Channel, NDArray[np.float32], NDArray[np.float32]]:
    """The distances' channel, (N,) ranges and (N,) or (0,) remissions of the first or the last echo.

    The last echo is the second where a ray has two, else the first. Raises: ColaError: the scan holds no distances.
    """
    first = scan.channel("DIST1")
    if first is None or len(first.data) == 0:
        raise ColaError("LMDscandata without DIST1")
    ranges, remission = ranges_m(first), _remission(scan, "RSSI1", len(first.data))
    second = scan.channel("DIST2") if echo == "last" else None
    if second is not None:
        if len(second.data) != len(first.data):
            raise ColaError(f"LMDscandata with {len(first.data)} first and {len(second.data)} second echoes")
        second_ranges, second_remission = ranges_m(second), _remission(scan, "RSSI2", len(second.data))
        has_two = np.isfinite(second_ranges)
        ranges = np.where(has_two, second_ranges, ranges)
        if len(remission) == len(second_remission):
            remission = np.where(has_two, second_remission, remission) if len(remission) else remission
    return first, ranges, remission


def _remission(scan: ScanData, content: str, rays: int) -> NDArray[np.float32]:
    """(rays,) as the device gives it: 0 is too weak, 255 or 65535 dazzled; (0,) if there is none for each ray."""
    channel = scan.channel(content)
    return (channel.data if channel is not None and len(channel.data) == rays else np.empty(0)).astype(np.float32)


def to_scan(scan: ScanData, transmitted_ns: int, period_us: float, echo: str = "first") -> Scan:
    """A sweep in SI units, the scanner's frame and host time, to which `transmitted_ns` (monotonic) takes its time of
    transmission; `period_us` is one turn of the head, `echo` "first" or "last". No ray is later than the transmission.

    Raises:
        ColaError: the scan holds no distances, or is one that no scanner can make.
    """
    channel, ranges, remission = echoes(scan, echo)
    start, step, rays = channel.start_angle_1e4deg, channel.angular_step_1e4deg, len(channel.data)
    if abs(start) > TURN_1E4DEG or not 0 < step * max(rays - 1, 1) <= TURN_1E4DEG:
        raise ColaError(f"LMDscandata with {rays} rays from {start * 1e-4:g}° in steps of {step * 1e-4:g}°")
    delay_us = first_ray_delay_us(start, period_us)
    duration_us = sweep_us(rays, step, period_us)
    index_age_us: float = (scan.time_of_transmission_us - scan.time_since_startup_us) % WRAP_US
    if index_age_us > MAX_AGE_US:
        raise ColaError(f"LMDscandata transmitted {index_age_us * 1e-6:.1f} s after its sweep")
    index_age_us += period_us * max(0, math.ceil((delay_us + duration_us - index_age_us) / period_us))
    measured_ns = transmitted_ns - round(1000 * (index_age_us - delay_us))
    return Scan(
        measured_ns=measured_ns,
        complete_ns=measured_ns + round(1000 * duration_us),
        ranges_m=ranges,
        intensities=remission,
        angle_min_rad=math.radians((start - AHEAD_1E4DEG) / 1e4),
        angle_increment_rad=math.radians(step / 1e4),
        time_increment_s=sweep_us(2, step, period_us) * 1e-6,
        scan_time_s=period_us * 1e-6,
        range_min_m=RANGE_MIN_M,
        range_max_m=RANGE_MAX_M,
        telegram_counter=scan.telegram_counter,
        scan_counter=scan.scan_counter,
        device_status=scan.device_status[1],
    )

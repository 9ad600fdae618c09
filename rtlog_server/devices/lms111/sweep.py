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
        ColaError: the scan tells no frequency.
    """
    if scan.scan_frequency_centihz == 0:
        raise ColaError("scan frequency is 0")
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
    ranges[distances.data < LOWEST_DISTANCE] = np.nan
    ranges[distances.data == NO_ECHO] = np.inf
    return ranges


def to_scan(scan: ScanData, transmitted_ns: int, period_us: float) -> Scan:
    """A sweep in SI units, the scanner's frame and host time, to which `transmitted_ns` (monotonic) takes its time of
    transmission; `period_us` is one turn of the head.

    Raises:
        ColaError: the scan holds no distances.
    """
    distances = scan.channel("DIST1")
    if distances is None or len(distances.data) == 0:
        raise ColaError("LMDscandata without DIST1")
    remission = scan.channel("RSSI1")
    rays = len(distances.data)
    delay_us = first_ray_delay_us(distances.start_angle_1e4deg, period_us)
    duration_us = sweep_us(rays, distances.angular_step_1e4deg, period_us)
    index_age_us: float = (scan.time_of_transmission_us - scan.time_since_startup_us) % WRAP_US
    if index_age_us < delay_us + duration_us:
        index_age_us += period_us
    measured_ns = transmitted_ns - round(1000 * (index_age_us - delay_us))
    has_intensities = remission is not None and len(remission.data) == rays
    return Scan(
        measured_ns=measured_ns,
        complete_ns=measured_ns + round(1000 * duration_us),
        ranges_m=ranges_m(distances),
        intensities=(remission.data if remission and has_intensities else np.empty(0)).astype(np.float32),
        angle_min_rad=math.radians((distances.start_angle_1e4deg - AHEAD_1E4DEG) / 1e4),
        angle_increment_rad=math.radians(distances.angular_step_1e4deg / 1e4),
        time_increment_s=sweep_us(2, distances.angular_step_1e4deg, period_us) * 1e-6,
        scan_time_s=period_us * 1e-6,
        range_min_m=RANGE_MIN_M,
        range_max_m=RANGE_MAX_M,
        telegram_counter=scan.telegram_counter,
        scan_counter=scan.scan_counter,
        device_status=scan.device_status[1],
    )

"""What every laser driver hands over: one sweep of the head, ready to become a LaserScan.

Frame: the scanner's (REP-103), x ahead, y left; angles run counter-clockwise. Ranges follow REP-117: +inf is no return,
NaN is a ray that the scanner measured and does not believe.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    measured_ns: int  # monotonic; the first ray
    complete_ns: int  # monotonic; the last ray
    ranges_m: NDArray[np.float32]  # (N,)
    intensities: NDArray[np.float32]  # (N,) in the device's unit, or (0,) if it sends none
    angle_min_rad: float  # of the first ray
    angle_increment_rad: float
    time_increment_s: float  # from ray to ray
    scan_time_s: float  # from sweep to sweep: one turn of the head
    range_min_m: float
    range_max_m: float
    telegram_counter: int  # telegrams that the device sent, and sweeps that it made; both modulo 65536
    scan_counter: int
    device_status: int  # 0: the device finds nothing wrong with itself

"""What an emulated scanner measures: metres and radians, as a LaserScan has them → the channels of LMDscandata.

In: (N,) ranges and remissions of one or two echoes. Out: `Channel`s in the device's integers, as many and as wide as
the client has asked for. The law: what a scanner cannot measure is refused at the door; what it cannot send is a code.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rtlog_server.devices.lms111.scan_data import Channel
from rtlog_server.devices.lms111.sweep import AHEAD_1E4DEG, LOWEST_DISTANCE, NO_ECHO

REJECTED = 3  # the code that real devices send where neighbours vanish
MAX_RAYS = 10_000
MAX_STEP_RAD = math.radians(6.5)
MAX_ANGLE_RAD = 2 * math.pi


@dataclass(frozen=True, slots=True, eq=False)
class Echo:
    ranges: NDArray[np.float64]  # (N,) m; +inf: none came back, NaN: rejected
    remission: NDArray[np.float64] | None  # (N,)


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """One turn's rays."""

    first_ray_ns: int
    start_1e4deg: int  # device angle
    step_1e4deg: int
    echoes: tuple[Echo, ...]  # the first; the second, if there is one


def make_sweep(
    ranges_m: ArrayLike,
    first_ray_ns: int,
    angle_min_rad: float,
    angle_increment_rad: float,
    intensities: ArrayLike | None,
    second_ranges_m: ArrayLike | None = None,
    second_intensities: ArrayLike | None = None,
) -> Sweep:
    """A sweep of (N,) ranges and as many intensities, or none. Raises: ValueError, if no scanner can measure it."""
    if not 0 < angle_increment_rad <= MAX_STEP_RAD or not abs(angle_min_rad) <= MAX_ANGLE_RAD:
        raise ValueError(f"rays from {angle_min_rad} rad in steps of {angle_increment_rad} rad")
    echoes = [_make_echo(ranges_m, intensities)]
    if second_ranges_m is not None:
        echoes.append(_make_echo(second_ranges_m, second_intensities))
    if len({echo.ranges.shape for echo in echoes}) > 1:
        raise ValueError("a sweep has as many second echoes as first ones")
    start = round(math.degrees(angle_min_rad) * 1e4) + AHEAD_1E4DEG
    return Sweep(first_ray_ns, start, round(math.degrees(angle_increment_rad) * 1e4), tuple(echoes))


def _make_echo(ranges_m: ArrayLike, intensities: ArrayLike | None) -> Echo:
    ranges = np.array(ranges_m, np.float64)  # copies: the caller may write the next sweep over this one
    remission = None if intensities is None or np.size(intensities) == 0 else np.array(intensities, np.float64)
    if ranges.ndim != 1 or ranges.size > MAX_RAYS or (remission is not None and remission.shape != ranges.shape):
        raise ValueError("a sweep is one row of ranges, and as many intensities or none")
    return Echo(ranges, remission)


def echo_channels(
    sweep: Sweep, echoes: int, with_remission: bool, in_16_bit: bool
) -> tuple[tuple[Channel, ...], tuple[Channel, ...]]:
    """The channels of 16 and of 8 bit. `echoes`, as in LMDscandatacfg: 1 the first, 2 the second, 3 both.

    A sweep without a second echo, for a client that wants it, has no second echo on any ray.
    """
    rays = len(sweep.echoes[0].ranges)
    second = sweep.echoes[1] if len(sweep.echoes) > 1 else Echo(np.full(rays, np.inf), np.zeros(rays))
    wide: list[Channel] = []
    narrow: list[Channel] = []
    for number, echo in ((1, sweep.echoes[0]), (2, second)):
        if echoes & number:
            wide.append(_channel(sweep, f"DIST{number}", quantise_ranges(echo.ranges)))
            if with_remission and echo.remission is not None:
                remission = np.round(np.nan_to_num(echo.remission))
                if in_16_bit:
                    wide.append(_channel(sweep, f"RSSI{number}", np.clip(remission, 0, 65535).astype(np.uint16)))
                else:
                    narrow.append(_channel(sweep, f"RSSI{number}", np.clip(remission, 0, 255).astype(np.uint8)))
    return tuple(wide), tuple(narrow)


def _channel(sweep: Sweep, content: str, data: Any) -> Channel:
    return Channel(content, 1.0, 0.0, sweep.start_1e4deg, sweep.step_1e4deg, data)


def quantise_ranges(ranges_m: NDArray[np.floating[Any]]) -> NDArray[np.uint16]:
    """(N,) millimetres: 0 for +inf and what is too far for 16 bits, a code for NaN and what no range is as near as."""
    millimetres = np.round(np.nan_to_num(ranges_m, nan=0.0, posinf=np.inf, neginf=0.0) * 1000)
    codes = np.where(millimetres < LOWEST_DISTANCE, REJECTED, NO_ECHO)
    measured = (millimetres >= LOWEST_DISTANCE) & (millimetres <= 65535)
    return np.where(measured, millimetres, codes).astype(np.uint16)

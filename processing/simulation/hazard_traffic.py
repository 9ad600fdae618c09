"""Traffic: other vehicles in view, as boxes that move or stand.

In: the drive of ours, what strikes it. Out: `Obstacle`s, and how far beams fly until they meet one.

    along      it keeps its distance on our way, ahead of us or behind, where the scanner looks
    oncoming   it comes on our way, and passes by to the side
    parked     it stands beside our way for the whole run; in other runs it is elsewhere
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import Mount
from processing.geometry import compose, relative
from processing.simulation.drive import Drive
from processing.simulation.hazards import Traffic
from processing.simulation.lots import Strike

Array = NDArray[np.float64]
STEP_S = 0.05  # between two tabulated poses
LEAST_M = 0.4  # between our scanner and the other vehicle
TRIES = 50


@dataclass(frozen=True, slots=True)
class Obstacle:
    """A box; it is there from the first of its times to the last."""

    length_m: float
    width_m: float
    time_s: Array  # (n,) ascending
    pose: Array  # (n, 3) of its middle, heading unwrapped

    def poses_at(self, time_s: Array) -> Array:
        return np.stack([np.interp(time_s, self.time_s, self.pose[:, k]) for k in range(3)], axis=-1)

    def distances(self, beams: Array, time_s: Array) -> Array:
        """Along beams that leave at poses (..., 3) at `time_s` (...): to the box, +inf past it; 0 from inside."""
        seen = relative(self.poses_at(time_s), beams)
        low, high = np.full(seen.shape[:-1], 0.0), np.full(seen.shape[:-1], np.inf)
        for half, along, start in (
            (self.length_m / 2, np.cos(seen[..., 2]), seen[..., 0]),
            (self.width_m / 2, np.sin(seen[..., 2]), seen[..., 1]),
        ):  # the beam is between two sides of the box from `near` to `far`
            slope = np.where(np.abs(along) < 1e-12, 1e-12, along)
            near, far = (-half - start) / slope, (half - start) / slope
            low, high = np.maximum(low, np.minimum(near, far)), np.minimum(high, np.maximum(near, far))
        there = (time_s >= self.time_s[0]) & (time_s <= self.time_s[-1])
        return np.where(there & (low <= high), low, np.inf)


def obstacles(strikes: list[Strike], drive: Drive, mount: Mount) -> list[Obstacle]:
    """The other vehicles of a run. Raises: BadInputError: one that was named for it would drive into ours."""
    found = []
    for strike in strikes:
        hazard = strike.hazard
        if not isinstance(hazard, Traffic):
            continue
        for _ in range(TRIES if hazard.at_s is None else 1):
            obstacle = _place(strike, hazard, drive, mount)
            if obstacle is not None and _clearance_m(obstacle, drive, mount) >= LEAST_M:
                found.append(obstacle)
                break
        else:
            strike.refuse(f"there is no room for it on the way of run {hazard.run}")
    return found


def _place(strike: Strike, hazard: Traffic, drive: Drive, mount: Mount) -> Obstacle | None:
    """Where it is at each time; None where our way is too short for it."""
    start_s, end_s = strike.spans_s(drive.duration_s)[0]
    end_s = min(end_s, drive.duration_s)
    whole_s = np.array([0.0, drive.duration_s + 1.0])
    if hazard.way == "parked":
        at = drive.poses_at(np.array([start_s, start_s]))
        return Obstacle(hazard.length_m, hazard.width_m, whole_s, _to_the_left(at, hazard.aside_m))
    time_s = np.arange(start_s, end_s, STEP_S)
    if hazard.way == "along":
        ahead = 1.0 if abs(mount.yaw_deg) <= 90.0 else -1.0
        way, aside = drive.way_at(time_s) + ahead * (hazard.gap_m + hazard.length_m / 2), 0.0
    else:
        middle_s = (start_s + end_s) / 2
        way = drive.way_at(np.array([middle_s])) - hazard.speed_m_s * (time_s - middle_s)
        aside = hazard.aside_m
    on_way = (way >= 0.0) & (way <= drive.length_m)
    if on_way.sum() < 2:
        return None
    pose = np.stack([np.interp(way[on_way], drive.path_m, drive.pose[:, k]) for k in range(3)], axis=-1)
    return Obstacle(hazard.length_m, hazard.width_m, time_s[on_way], _to_the_left(pose, aside))


def _to_the_left(pose: Array, by_m: float) -> Array:
    return pose + by_m * np.stack([-np.sin(pose[:, 2]), np.cos(pose[:, 2]), 0.0 * pose[:, 2]], axis=-1)


def _clearance_m(obstacle: Obstacle, drive: Drive, mount: Mount) -> float:
    """The least distance between the middle of our axle, or our scanner, and the box."""
    time_s = np.arange(obstacle.time_s[0], obstacle.time_s[-1], STEP_S)
    ours = drive.poses_at(time_s)
    box = obstacle.poses_at(time_s)
    half = np.array([obstacle.length_m, obstacle.width_m]) / 2
    least = np.inf
    for part in (ours, compose(ours, np.array([mount.x_m, mount.y_m, 0.0]))):
        outside = np.maximum(np.abs(relative(box, part)[:, :2]) - half, 0.0)
        least = min(least, float(np.hypot(*outside.T).min()))
    return least

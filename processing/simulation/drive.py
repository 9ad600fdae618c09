"""The drive: where the vehicle truly is at any time of a run.

In: the waypoints of a run. Out: a `Drive`: pose, distance, curvature as functions of time, consistent in themselves.

    waypoints → legs (cut where the vehicle changes gear) → corners rounded by arcs → a cubic B-spline through points a
    metre apart, which makes the curvature continuous → speed limited by curves and by acceleration → time

The vehicle's origin, the middle of its axle, follows the spline; wheels that roll without slip drive exactly that.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from hw_profiles.errors import BadInputError
from processing.geometry import wrap_angle
from processing.simulation.world import Driving, Run, World, route

Array = NDArray[np.float64]
CONTROL_M = 1.0  # spacing of the control points; rounds what is shorter
NODES_PER_CONTROL = 50  # the path is tabulated every 2 cm and linear between: 0.01 mm at a radius of 4 m
LARGEST_CUT_M = 0.5  # slight bends are rounded with as large a radius as cuts the corner by no more
LARGEST_RADIUS_M = 40.0
SMALLEST_RADIUS_M = 2.0
BACK = np.radians(175.0)  # a turn above this is driving back on the way one came
WANDER_LENGTH_M = 12.0


@dataclass(frozen=True, slots=True)
class Drive:
    """Nodes along the path, ascending in time; between two nodes the acceleration along the path is constant."""

    time_s: Array  # (n,)
    path_m: Array  # (n,) way along the path, never falling
    speed_m_s: Array  # (n,) along the path, not negative
    pose: Array  # (n, 3), heading unwrapped
    distance_m: Array  # (n,) falls in reverse
    curvature: Array  # (n,) dθ over signed distance

    @property
    def duration_s(self) -> float:
        return float(self.time_s[-1])

    @property
    def length_m(self) -> float:
        return float(self.path_m[-1])

    def way_at(self, time_s: Array) -> Array:
        """The way along the path at each time; before and after the drive the vehicle stands."""
        node = np.clip(np.searchsorted(self.time_s, time_s, side="right") - 1, 0, len(self.time_s) - 2)
        span = np.maximum(self.time_s[node + 1] - self.time_s[node], 1e-12)
        tau = np.clip(time_s - self.time_s[node], 0.0, span)
        acceleration = (self.speed_m_s[node + 1] - self.speed_m_s[node]) / span
        way = self.path_m[node] + self.speed_m_s[node] * tau + acceleration * tau**2 / 2
        return np.clip(way, self.path_m[node], self.path_m[node + 1])

    def poses_at(self, time_s: Array) -> Array:
        """Vehicle poses (..., 3) in the world frame; the heading is not wrapped."""
        way = self.way_at(time_s)
        return np.stack([np.interp(way, self.path_m, self.pose[:, k]) for k in range(3)], axis=-1)

    def at(self, time_s: Array, nodes: Array) -> Array:
        """A quantity that is tabulated at the nodes (n,), at each time."""
        return np.interp(self.way_at(time_s), self.path_m, nodes)


def plan_drive(world: World, run: Run, generator: np.random.Generator) -> Drive:
    """Raises: BadInputError: a turn is too sharp, or two waypoints are one."""
    what = f"world {world.name}: run {run.name}"
    way = route(world, run)
    points = np.array([point for _, point in way])
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    if np.any(lengths < CONTROL_M):
        index = int(np.argmin(lengths))
        raise BadInputError(f"{what}: waypoints {way[index][0]} and {way[index + 1][0]} are less than a metre apart")
    turns = turn_angles(points)
    cuts = [0, *(np.flatnonzero(np.abs(turns) > BACK) + 1).tolist(), len(points) - 1]
    legs: list[Drive] = []
    for leg, (first, last) in enumerate(pairwise(cuts)):
        stops_s = np.array([run.stops_s.get(str(place), 0.0) for place, _ in way[first : last + 1]])
        stops_s[0] = world.driving.gear_change_s if leg else world.driving.wait_s
        stops_s[-1] += world.driving.wait_s if last == len(points) - 1 else 0.0
        legs.append(_drive_leg(points[first : last + 1], stops_s, run.speed_m_s, world.driving, generator, what))
    return _join(legs)


def turn_angles(points: Array) -> Array:
    """By how much the way turns at each inner waypoint, (n - 2,), in (-π, π]."""
    chord = np.diff(points, axis=0)
    return wrap_angle(np.diff(np.arctan2(chord[:, 1], chord[:, 0])))


def round_corners(points: Array, radius_m: float, what: str) -> tuple[Array, Array]:
    """The polyline with an arc in place of each corner.

    Returns:
        Points (m, 2) of the rounded line, 0.1 m or less apart in the arcs; the way along it at each waypoint (n,).
    """
    chord = np.diff(points, axis=0)
    lengths = np.linalg.norm(chord, axis=1)
    ahead = chord / lengths[:, None]
    half_turns = np.abs(turn_angles(points)) / 2
    room = lengths / 2
    room[0], room[-1] = lengths[0] - 2 * CONTROL_M, lengths[-1] - 2 * CONTROL_M  # the ends of a leg stay straight
    line, marks = [points[:1]], [0]
    for k, half in enumerate(half_turns, start=1):
        wanted = min(LARGEST_RADIUS_M, LARGEST_CUT_M / max(1e-9, 1 / np.cos(half) - 1))
        tangent = min(max(radius_m, wanted) * np.tan(half), room[k - 1], room[k])
        if tangent < SMALLEST_RADIUS_M * np.tan(half):
            x, y = points[k]
            raise BadInputError(f"{what}: no room to turn by {np.degrees(2 * half):.0f}° at [{x:g}, {y:g}]")
        count = 2 * max(1, int(np.ceil(tangent / 0.1)))
        arc = _arc(points[k], ahead[k - 1], ahead[k], tangent, half, count)
        marks.append(sum(map(len, line)) + count // 2)
        line.append(arc)
    line.append(points[-1:])
    rounded = np.concatenate(line)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(rounded, axis=0), axis=1))])
    return rounded, way[[*marks, len(rounded) - 1]]


def _arc(corner: Array, before: Array, after: Array, tangent: float, half: float, count: int) -> Array:
    """Points (count + 1, 2) of the arc that touches both sides of a corner at the distance `tangent` from it."""
    start = corner - tangent * before
    if half < 1e-6:
        return np.linspace(start, corner + tangent * after, count + 1)
    radius = tangent / np.tan(half)
    side = np.sign(before[0] * after[1] - before[1] * after[0])
    left = side * np.array([-before[1], before[0]])
    angle = np.linspace(0.0, 2 * half, count + 1)[:, None]
    return np.asarray(start + radius * (np.sin(angle) * before + (1 - np.cos(angle)) * left))


def smooth_path(line: Array, wander_m: float, generator: np.random.Generator) -> tuple[Array, Array, Array]:
    """A cubic B-spline along a polyline (m, 2), straight at its ends: points (n, 2), headings (n,), curvatures (n,)."""
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    count = max(4, int(np.ceil(way[-1] / CONTROL_M)) + 1)
    stations = np.linspace(0.0, way[-1], count)
    control = np.column_stack([np.interp(stations, way, line[:, k]) for k in (0, 1)])
    ahead = np.gradient(control, axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0]]) / np.linalg.norm(ahead, axis=1, keepdims=True)
    control += left * _wander(stations, wander_m, generator)[:, None]
    control = np.vstack([2 * control[0] - control[1], control, 2 * control[-1] - control[-2]])
    spline = BSpline(np.arange(len(control) + 4) - 3.0, control, 3)  # goes through both ends without curvature
    u = np.linspace(0.0, count - 1.0, (count - 1) * NODES_PER_CONTROL + 1)
    first, second = spline(u, 1), spline(u, 2)
    curvature = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]) / np.linalg.norm(first, axis=1) ** 3
    return spline(u), np.unwrap(np.arctan2(first[:, 1], first[:, 0])), curvature


def _wander(stations: Array, wander_m: float, generator: np.random.Generator) -> Array:
    """How far to the left of the line the driver keeps at each station (n,); nothing near the ends."""
    coefficients = generator.standard_normal(int(stations[-1] / WANDER_LENGTH_M) + 5)
    spline = BSpline(np.arange(len(coefficients) + 4) - 3.0, coefficients, 3)
    inside = (np.minimum(stations, stations[-1] - stations) - 3 * CONTROL_M) / WANDER_LENGTH_M
    fade = np.clip(inside, 0.0, 1.0)
    unit = 1.45  # a cubic B-spline of unit coefficients spreads by 0.69
    return np.asarray(wander_m * unit * spline(stations / WANDER_LENGTH_M) * fade**2 * (3 - 2 * fade))


def limit_speed(way: Array, limit: Array, acceleration: float) -> Array:
    """The highest speeds (n,) along `way` (n,) under `limit` (n,) that need no more than the acceleration.

    v² grows and falls by no more than 2 a ds, so v² - 2 a s takes its running minimum, and v² + 2 a s from the end.
    """
    gain = 2 * acceleration * way
    squared = gain + np.minimum.accumulate(limit**2 - gain)
    squared = np.minimum.accumulate((squared + gain)[::-1])[::-1] - gain
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def _drive_leg(
    points: Array, stops_s: Array, speed_m_s: float, driving: Driving, generator: np.random.Generator, what: str
) -> Drive:
    """One leg driven ahead from standstill to standstill, with the pauses (n,) at its waypoints (n, 2)."""
    line, marks = round_corners(points, driving.turn_radius_m, what)
    position, heading, curvature = smooth_path(line, driving.wander_m, generator)
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    limit = np.sqrt(driving.lateral_acceleration_m_s2 / np.maximum(np.abs(curvature), 1e-9)).clip(max=speed_m_s)
    stop_nodes = np.searchsorted(way, marks / marks[-1] * way[-1]).clip(0, len(way) - 1)
    stop_nodes, stops_s = stop_nodes[stops_s > 0], stops_s[stops_s > 0]
    limit[[0, -1]] = limit[stop_nodes] = 0.0
    speed = limit_speed(way, limit, driving.acceleration_m_s2)
    time = np.concatenate([[0.0], np.cumsum(2 * steps / (speed[1:] + speed[:-1]))])
    pose = np.column_stack([position, heading])
    order = np.sort(np.concatenate([np.arange(len(way)), stop_nodes]))  # a pause is two nodes at one place
    pauses = np.zeros(len(order))
    pauses[stop_nodes + np.arange(1, len(stop_nodes) + 1)] = stops_s
    return Drive(time[order] + np.cumsum(pauses), way[order], speed[order], pose[order], way[order], curvature[order])


def _join(legs: list[Drive]) -> Drive:
    """The legs one after the other, every second one in reverse."""
    joined = legs[0]
    for index, leg in enumerate(legs[1:], start=1):
        sign, turn = (-1.0, np.pi) if index % 2 else (1.0, 0.0)
        joined = Drive(
            np.append(joined.time_s, joined.duration_s + leg.time_s),
            np.append(joined.path_m, joined.length_m + leg.path_m),
            np.append(joined.speed_m_s, leg.speed_m_s),
            np.vstack([joined.pose, leg.pose + np.array([0.0, 0.0, turn])]),
            np.append(joined.distance_m, joined.distance_m[-1] + sign * leg.distance_m),
            np.append(joined.curvature, sign * leg.curvature),
        )
    joined.pose[:, 2] = np.unwrap(joined.pose[:, 2])
    return joined

"""How near an atlas is to the truth: trajectories, beacons, edge lengths.

In: trajectories and the truth of the same runs, places of beacons. Out: errors in metres and degrees. Law: the atlas is
moved as one rigid body, and never bent or scaled, before it is compared. Its unconnected parts may also be moved each
for itself: that says how good each of them is, and hides that they do not lie as they should to each other.
Sources: absolute trajectory error and relative pose error after Sturm et al. 2012, with Umeyama 1991's alignment.

The truth is interpolated at the estimate's stamps; stamps outside the truth's time are not counted, and that is told.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.geometry import Array, align, compose, interpolate_poses, relative, transform, wrap_angle

START_EVERY_M = 1.0  # relative errors start at every metre driven, so that standing still weighs nothing
ROUNDING_M = 1e-6


@dataclass(frozen=True, slots=True)
class Trajectory:
    stamps_ns: NDArray[np.int64]  # (n,) ascending
    poses: Array  # (n, 3)


@dataclass(frozen=True, slots=True)
class Matched:
    """A run where the truth is known."""

    estimate: Array  # (n, 3) in the atlas frame
    truth: Array  # (n, 3) at the same moments
    uncounted: int  # stamps of the estimate that lie outside the truth's time


@dataclass(frozen=True, slots=True)
class AbsoluteError:
    stamps: int
    uncounted: int
    rmse_m: float
    max_m: float
    heading_rmse_deg: float


@dataclass(frozen=True, slots=True)
class RelativeError:
    distance_m: float  # travelled between the two poses of a pair
    pairs: int
    translation_rmse_m: float
    rotation_rmse_deg: float


@dataclass(frozen=True, slots=True)
class Beacon:
    """A node of the atlas: a place on the trajectory where a tag was passed, not the place of the tag."""

    epc: str
    position: Array  # (2,) in the atlas frame
    part: int
    runs: Sequence[str]  # that passed it


@dataclass(frozen=True, slots=True)
class BeaconError:
    epc: str
    error_m: float  # from where the atlas says that the place is to where the vehicle truly was at it
    to_tag_m: float | None  # from the place to the tag itself, as far as the vehicle passed beside it


@dataclass(frozen=True, slots=True)
class Distribution:
    count: int
    rmse: float
    max: float


def match_truth(estimate: Trajectory, truth: Trajectory) -> Matched:
    """The estimate's poses beside the truth at their stamps."""
    counted = (estimate.stamps_ns >= truth.stamps_ns[0]) & (estimate.stamps_ns <= truth.stamps_ns[-1])
    stamps = estimate.stamps_ns[counted]
    return Matched(estimate.poses[counted], truth_at(truth.stamps_ns, truth.poses, stamps), int(np.sum(~counted)))


def truth_at(stamps_ns: NDArray[np.int64], poses: Array, wanted_ns: NDArray[np.int64]) -> Array:
    """Poses (k, 3) at the wanted stamps (k,): linear between those (m, 3) at ascending stamps."""
    since, wanted = ((of - stamps_ns[0]).astype(float) for of in (stamps_ns, wanted_ns))
    found = interpolate_poses(since, poses, wanted)
    found[:, 2] = wrap_angle(found[:, 2])
    return found


def align_parts(runs: Mapping[str, Matched], parts: Mapping[str, int]) -> dict[int, Array]:
    """For each part the pose (3,) of the atlas frame in the true one: least squares over all its runs' positions."""
    found = {}
    for part in sorted({parts[run_id] for run_id in runs}):
        members = [matched for run_id, matched in runs.items() if parts[run_id] == part]
        estimate = np.concatenate([matched.estimate for matched in members])
        truth = np.concatenate([matched.truth for matched in members])
        found[part] = align(estimate[:, :2], truth[:, :2])
    return found


def align_whole(runs: Mapping[str, Matched], parts: Mapping[str, int]) -> dict[int, Array]:
    """The same for all parts as one rigid body: each part gets the one pose (3,)."""
    whole = align_parts(runs, dict.fromkeys(runs, 0))[0]
    return dict.fromkeys(sorted({parts[run_id] for run_id in runs}), whole)


def largest_part_share(ways_m: Mapping[str, float], parts: Mapping[str, int]) -> float:
    """What share of the way driven, by run, lies in the part that holds most of it."""
    held = [sum(ways_m[run_id] for run_id in ways_m if parts.get(run_id) == part) for part in set(parts.values())]
    return max(held) / sum(held) if sum(held) > 0 else 1.0


def way_driven(poses: Array) -> float:
    """Length [m] of a drive through poses (n, 3)."""
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())


def absolute_error(runs: Mapping[str, Matched], parts: Mapping[str, int], moves: Mapping[int, Array]) -> AbsoluteError:
    """Of all poses of these runs, after the alignment."""
    errors = np.concatenate(
        [relative(m.truth, compose(moves[parts[run_id]], m.estimate)) for run_id, m in runs.items()]
    )
    distances = np.hypot(errors[:, 0], errors[:, 1])
    return AbsoluteError(
        stamps=len(errors),
        uncounted=sum(matched.uncounted for matched in runs.values()),
        rmse_m=_rms(distances),
        max_m=float(distances.max()),
        heading_rmse_deg=float(np.degrees(_rms(errors[:, 2]))),
    )


def relative_error(runs: Mapping[str, Matched], distance_m: float) -> RelativeError | None:
    """Of all pairs of poses of a run that lie this far apart on the road truly driven; None: no run is that long."""
    errors = []
    for matched in runs.values():
        driven = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(matched.truth[:, :2], axis=0), axis=1))])
        marks = np.arange(0, driven[-1] - distance_m + ROUNDING_M, START_EVERY_M)
        starts = np.unique(np.searchsorted(driven, marks - ROUNDING_M))
        ends = np.searchsorted(driven, driven[starts] + distance_m - ROUNDING_M)
        starts, ends = starts[ends < len(driven)], ends[ends < len(driven)]
        true_motion = relative(matched.truth[starts], matched.truth[ends])
        errors.append(relative(true_motion, relative(matched.estimate[starts], matched.estimate[ends])))
    joined = np.concatenate(errors)
    if not len(joined):
        return None
    translations = np.hypot(joined[:, 0], joined[:, 1])
    return RelativeError(distance_m, len(joined), _rms(translations), float(np.degrees(_rms(joined[:, 2]))))


def true_place(beacon: Beacon, runs: Mapping[str, Matched]) -> Array:
    """Where a beacon's place truly is (2,).

    Each run that passed it knows the place from the nearest pose of its own trajectory, and where that pose truly was.
    """
    places = []
    for run_id in dict.fromkeys(beacon.runs):
        if run_id in runs and len(runs[run_id].estimate):
            matched = runs[run_id]
            nearest = int(np.argmin(np.sum((matched.estimate[:, :2] - beacon.position) ** 2, axis=1)))
            seen = relative(matched.estimate[nearest], np.array([*beacon.position, 0.0]))
            places.append(compose(matched.truth[nearest], seen)[:2])
    return np.mean(places, axis=0) if places else np.full(2, np.nan)


def beacon_errors(
    beacons: Sequence[Beacon], places: Array, moves: Mapping[int, Array], tags: Mapping[str, Array]
) -> list[BeaconError]:
    """Beacons against their true places (k, 2) and the tags' positions (2,) by EPC, where truth is known."""
    errors = []
    for beacon, place in zip(beacons, places, strict=True):
        if beacon.part not in moves or np.isnan(place).any():
            continue
        moved = transform(moves[beacon.part], beacon.position)
        to_tag = float(np.linalg.norm(moved - tags[beacon.epc])) if beacon.epc in tags else None
        errors.append(BeaconError(beacon.epc, float(np.linalg.norm(moved - place)), to_tag))
    return errors


def edge_length_errors(beacons: Sequence[Beacon], places: Array, edges: Sequence[tuple[int, int]]) -> Array:
    """Estimated less true distance [m] between the two beacons of each edge (i, j) whose ends are truly known."""
    ends = np.array(edges, dtype=np.int64).reshape(-1, 2)
    positions = np.array([beacon.position for beacon in beacons]).reshape(-1, 2)
    estimated = np.linalg.norm(positions[ends[:, 1]] - positions[ends[:, 0]], axis=1)
    true = np.linalg.norm(places[ends[:, 1]] - places[ends[:, 0]], axis=1)
    errors = estimated - true
    return np.asarray(errors[~np.isnan(errors)])


def distribution(errors: Array) -> Distribution | None:
    """Root mean square and largest magnitude; None of nothing."""
    return Distribution(len(errors), _rms(errors), float(np.abs(errors).max())) if len(errors) else None


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))

"""The open-loop estimate of one run: odometry and scan matching, fused step by step (paper, section 2.1).

In: a `Run`. Out: a pose for every scan, key frames with their scans ready for matching, and the chain of fused links
that joins them: the weak links of Lu & Milios. Passes of tags are key frames, so that a run can be cut there.

    scan   0 . . . . 5 . . . 9 . . .        every scan is matched to the key frame before it, not to the scan before it,
           ●         ●       ●              so errors add up per key frame; a new one is made when the view has changed

A drive is estimated in segments, which begin and end with a key frame and know nothing of each other: they can be
computed anywhere, and only one is in memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import OdometryNoise
from processing.chain import Chain, Contradiction
from processing.chain_step import add_up
from processing.geometry import accumulate, compose, interpolate_poses, relative
from processing.odometry import Motions, arc, odom_motions, wheel_motions, wheel_steps
from processing.pose_graph import Links
from processing.read_log import Run
from processing.scan_matching import LEVER_M, Matcher
from processing.skids import has_pace, without_skids
from processing.sweeps import StoredScans, Sweeps, velocities_of

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SEGMENT_SCANS = 1500
BENT_M = 0.02  # sweeps bent by more see a motion along a smooth drift that is none
# What /odom of an unknown robot may be trusted with.
FOREIGN_NOISE = OdometryNoise(
    distance_m_per_sqrt_m=0.06, lateral_m_per_sqrt_m=0.03, heading_deg_per_sqrt_m=3.0, heading_deg_per_sqrt_deg=1.0
)


@dataclass(frozen=True, slots=True)
class OpenLoop:
    """n scans, K key frames among them; poses of the vehicle, the first at (0, 0, 0)."""

    odometry: Motions  # n - 1, between scans
    sweeps: Sweeps  # n
    keyframes: Ints  # (K,) scan indices, the first is 0
    links: Links  # K - 1, between key frames in a row, fused: the chain
    wheels: Links  # K - 1, the same by odometry alone, with ample doubt: what is left where a match was wrong
    reference: Ints  # (n,) which key frame a scan was matched to
    offsets: Array  # (n, 3) pose of a scan in the frame of that key frame
    matched: NDArray[np.bool_]  # (n,) False: odometry alone
    contradictions: list[Contradiction]  # between wheels and walls, by scan

    def __len__(self) -> int:
        return len(self.reference)

    @property
    def scans(self) -> StoredScans:
        """K, of the key frames."""
        return StoredScans(self.sweeps, self.keyframes)

    @property
    def poses(self) -> Array:
        """(n, 3) of every scan, open loop."""
        return self.place(self.keyframe_poses)

    @property
    def keyframe_poses(self) -> Array:
        return accumulate(np.zeros(3), self.links.motions)

    def place(self, keyframe_poses: Array) -> Array:
        """Poses (n, 3) of all scans, given those of the key frames (K, 3)."""
        return compose(keyframe_poses[self.reference], self.offsets)


def mount_pose(run: Run) -> Array:
    mount = run.profile.lasers.primary.mount
    return np.array([mount.x_m, mount.y_m, np.radians(mount.yaw_deg)])


def drive_blind(run: Run) -> Array:
    """Dead reckoning at every sample of the odometry: poses (m, 3), the first at zero."""
    if run.wheels is None:
        assert run.odometry is not None
        return relative(run.odometry[0], run.odometry)
    distances, turns = wheel_steps(run.profile, run.wheels[:, 0], run.wheels[:, 1])
    return accumulate(np.zeros(3), arc(np.column_stack([distances, turns, np.zeros(len(turns))])))


def odometry_at_scans(run: Run) -> Motions:
    """Motions (n - 1) between the scans: the wheels' angles, or /odom's poses, interpolated to the scans' times.

    Where the scanner was silent while the wheels went on, all their samples count: a way round a corner is no arc.
    """
    times = run.scans.times
    if run.wheels is not None:
        between = (run.motion_times > times[0]) & (run.motion_times < times[-1])
        every = np.union1d(times, run.motion_times[between])
        first, second = (np.interp(every, run.motion_times, run.wheels[:, k]) for k in (0, 1))
        steps = wheel_motions(run.profile, first, second)
        motions = Motions(*add_up(steps.deltas, steps.covariances, np.searchsorted(every, times)))
        return without_skids(motions, np.diff(times))
    assert run.odometry is not None
    motions = odom_motions(interpolate_poses(run.motion_times, run.odometry, times), FOREIGN_NOISE)
    return without_skids(motions, np.diff(times))


@dataclass(frozen=True, slots=True)
class Segment:
    """A stretch of a run: s scans."""

    first: int  # scan of the run
    sweeps: Sweeps  # s
    odometry: Motions  # s - 1
    cuts: frozenset[int]  # scans of the segment that shall be key frames


@dataclass(frozen=True, slots=True)
class DrivenSegment:
    """The same, estimated; key frames and references are counted from the segment's first."""

    first: int
    keyframes: Ints  # (k,) the first and the last scan among them
    motions: Array  # (k - 1, 3) between key frames in a row, fused
    covariances: Array  # (k - 1, 3, 3)
    wheels: Motions  # k - 1, by odometry alone
    reference: Ints  # (s,)
    offsets: Array  # (s, 3)
    matched: NDArray[np.bool_]  # (s,)
    contradictions: list[Contradiction]  # scans counted from the segment's first, too


def cut_segments(sweeps: Sweeps, odometry: Motions, forced: Ints) -> list[Segment]:
    """Neighbours share a scan. `forced`: scans that shall be key frames, ascending."""
    last = len(sweeps) - 1
    ends = [0, *range(SEGMENT_SCANS, last - SEGMENT_SCANS // 2, SEGMENT_SCANS), last]
    return [
        Segment(
            a,
            sweeps.cut(a, b),
            Motions(odometry.deltas[a:b], odometry.covariances[a:b]),
            frozenset(int(k) - a for k in (*forced, b) if a < k <= b),
        )
        for a, b in pairwise(ends)
    ]


def drive_segment(segment: Segment, match: Matcher) -> DrivenSegment:
    """Drive through it; a second time where wheels that slipped have bent the sweeps, for bent walls lie."""
    driven = _drive(segment, match)
    poses = compose(accumulate(np.zeros(3), driven.motions)[driven.reference], driven.offsets)
    straight = straighten_by(segment.sweeps, poses)
    if np.any(_bent(segment.sweeps, straight.velocities) > BENT_M):
        driven = _drive(replace(segment, sweeps=straight), match)
    return driven


def straighten_by(sweeps: Sweeps, poses: Array) -> Sweeps:
    """The sweeps, straightened by the motions between these poses (n, 3)."""
    return replace(sweeps, velocities=velocities_of(relative(poses[:-1], poses[1:]), sweeps.times))


def _bent(sweeps: Sweeps, velocities: Array) -> Array:
    """How far (n,) m the end of a sweep lies from where it would with these velocities (n, 3) of the vehicle."""
    off = np.abs(velocities - sweeps.velocities)
    sweep_s = abs(sweeps.time_increment_s) * (sweeps.ranges.shape[1] - 1)
    return np.asarray((np.hypot(off[:, 0], off[:, 1]) + LEVER_M * off[:, 2]) * sweep_s)


def _drive(segment: Segment, match: Matcher) -> DrivenSegment:
    sweeps, odometry = segment.sweeps, segment.odometry
    seconds = np.diff(sweeps.times)
    chain = Chain(len(sweeps), sweeps.mount, match, has_pace(seconds))
    scans = sweeps.scans(np.arange(len(sweeps)))
    before = next(scans)
    chain.add_keyframe(0, before)
    for k, current in enumerate(scans, start=1):
        driven = odometry.deltas[k - 1], odometry.covariances[k - 1], float(seconds[k - 1])
        if not chain.advance(k, current, *driven):
            if chain.keyframes[-1] != k - 1:  # too little in common with the key frame; more with the scan before
                chain.add_keyframe(k - 1, before)
            if not (chain.advance(k, current, *driven) or chain.find(k, current, *driven)):
                chain.coast(k, *driven)
        if chain.wants_keyframe or k in segment.cuts:
            chain.add_keyframe(k, current)
        before = current
    return DrivenSegment(
        segment.first,
        np.array(chain.keyframes, np.int64),
        np.array(chain.motions).reshape(-1, 3),
        np.array(chain.covariances).reshape(-1, 3, 3),
        Motions(
            np.array(chain.odometry_motions).reshape(-1, 3), np.array(chain.odometry_covariances).reshape(-1, 3, 3)
        ),
        chain.reference,
        chain.offsets,
        chain.matched,
        chain.contradictions,
    )


def join_segments(sweeps: Sweeps, odometry: Motions, parts: Sequence[DrivenSegment]) -> OpenLoop:
    """The whole run. A scan that two segments share is the last of the one and the first key frame of the other.

    Its sweeps are straightened by the fused motions from now on: wheels that slipped bent them.
    """
    counts = np.cumsum([0] + [len(part.keyframes) - 1 for part in parts])
    keyframes, reference, offsets, matched = [np.zeros(1, np.int64)], [np.zeros(1, np.int64)], [], []
    for part, before in zip(parts, counts[:-1], strict=True):
        keyframes.append(part.first + part.keyframes[1:])
        reference.append(before + part.reference[1:])
        offsets.append(part.offsets[1:])
        matched.append(part.matched[1:])
    loop = OpenLoop(
        odometry,
        sweeps,
        np.concatenate(keyframes),
        _in_a_row([part.motions for part in parts], [part.covariances for part in parts], robust=True),
        _in_a_row([part.wheels.deltas for part in parts], [part.wheels.covariances for part in parts], robust=False),
        np.concatenate(reference),
        np.concatenate([np.zeros((1, 3)), *offsets]),
        np.concatenate([np.zeros(1, bool), *matched]),
        [replace(found, scan=part.first + found.scan) for part in parts for found in part.contradictions],
    )
    return replace(loop, sweeps=straighten_by(sweeps, loop.poses))


def _in_a_row(motions: list[Array], covariances: list[Array], robust: bool) -> Links:
    joined = np.concatenate(motions)
    ends = np.column_stack([np.arange(len(joined)), np.arange(1, len(joined) + 1)])
    return Links.of(ends, joined, np.asarray(np.linalg.inv(np.concatenate(covariances))), robust)

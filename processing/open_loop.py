"""The open-loop estimate of one run: odometry and scan matching, fused step by step (paper, section 2.1).

In: a `Run`. Out: a pose for every scan, key frames with their scans ready for matching, and the chain of fused links
that joins them: the weak links of Lu & Milios. Passes of tags are key frames, so that a run can be cut there.

    scan   0 . . . . 5 . . . 9 . . .        every scan is matched to the key frame before it, not to the scan before it,
           ●         ●       ●              so errors add up per key frame; a new one is made when the view has changed

A drive is estimated in segments, which begin and end with a key frame and know nothing of each other: they can be
computed anywhere, and only one is in memory.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import OdometryNoise
from processing.chain_step import carry, join, to_laser, to_vehicle
from processing.fusion import fuse
from processing.geometry import accumulate, compose, interpolate_poses, inverse
from processing.match_search import search_match
from processing.odometry import Motions, odom_motions, wheel_motions
from processing.pose_graph import Links
from processing.read_log import Run
from processing.scan_matching import Matcher
from processing.scan_walls import Scan
from processing.sweeps import StoredScans, Sweeps

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

SEGMENT_SCANS = 1500
KEYFRAME_SPACING_M = 0.75
KEYFRAME_TURN_RAD = 0.35
MIN_INLIERS = 0.6  # fewer of the points that both must see: no match
ENOUGH_OVERLAP = 0.7  # fewer points in common: time for a new key frame
SEARCH_M, SEARCH_RAD = 0.5, 0.6  # how far around the odometry a match is searched when all else failed
# What /odom of an unknown robot may be trusted with.
FOREIGN_NOISE = OdometryNoise(
    distance_m_per_sqrt_m=0.06, lateral_m_per_sqrt_m=0.03, heading_deg_per_sqrt_m=3.0, heading_deg_per_sqrt_deg=1.0
)
GATE = 9.0  # wheels err by their radius and by slip, not only at random: three times the standard deviation is let pass


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


def odometry_at_scans(run: Run) -> Motions:
    """Motions (n - 1) between the scans: the wheels' angles, or /odom's poses, interpolated to the scans' times."""
    times = run.scans.times
    if run.wheels is not None:
        first, second = (np.interp(times, run.motion_times, run.wheels[:, k]) for k in (0, 1))
        return wheel_motions(run.profile, first, second)
    assert run.odometry is not None
    return odom_motions(interpolate_poses(run.motion_times, run.odometry, times), FOREIGN_NOISE)


class _Chain:
    """The growing chain of key frames, and where the vehicle is since the last of them."""

    scan: Scan  # of the last key frame

    def __init__(self, count: int, mount: Array, match: Matcher) -> None:
        self.mount, self.to_scanner, self.match = mount, inverse(mount), match
        self.keyframes: list[int] = []
        self.motions: list[Array] = []
        self.covariances: list[Array] = []
        self.odometry_motions: list[Array] = []
        self.odometry_covariances: list[Array] = []
        self.reference, self.offsets = np.zeros(count, np.int64), np.zeros((count, 3))
        self.matched = np.zeros(count, bool)
        self.offset, self.covariance = np.zeros(3), np.zeros((3, 3))  # fused, since the key frame
        self.driven, self.driven_covariance = np.zeros(3), np.zeros((3, 3))  # by odometry alone, since the key frame
        self.wants_keyframe = False

    def add_keyframe(self, k: int, scan: Scan) -> None:
        if self.keyframes:
            self.motions.append(self.offset)
            self.covariances.append(self.covariance)
            self.odometry_motions.append(self.driven)
            self.odometry_covariances.append(GATE * self.driven_covariance)
        self.keyframes.append(k)
        self.scan = scan
        self.reference[k], self.offsets[k] = len(self.keyframes) - 1, 0.0
        self.offset, self.covariance = np.zeros(3), np.zeros((3, 3))
        self.driven, self.driven_covariance = np.zeros(3), np.zeros((3, 3))

    def advance(self, k: int, scan: Scan, step: Array, noise: Array, search: bool) -> bool:
        """Match scan `k`, one odometry `step` after the last; False leaves all as it was."""
        driven, covariance = carry(self.driven, self.driven_covariance, step, noise)
        guess = to_laser(self.mount, self.to_scanner, join(self.offset, step))
        if search:
            result = search_match(self.scan, scan, guess, SEARCH_M, SEARCH_RAD)
        else:
            result = self.match(self.scan, scan, guess)
        if not (result.converged and result.inliers >= MIN_INLIERS):
            return False
        motion, doubt = to_vehicle(self.mount, self.to_scanner, result.motion, result.covariance)
        agrees, fused, fused_covariance = fuse(driven, covariance, GATE, motion, doubt)
        if not agrees:
            return False
        if search:  # what had to be searched for may be elsewhere
            fused_covariance = GATE * covariance
        self._arrive(k, fused, fused_covariance, driven, covariance, result.overlap)
        return True

    def coast(self, k: int, step: Array, noise: Array) -> None:
        """Take odometry's word for scan `k`."""
        offset, covariance = carry(self.offset, self.covariance, step, GATE * noise)
        self._arrive(k, offset, covariance, *carry(self.driven, self.driven_covariance, step, noise), 0.0)

    def _arrive(
        self, k: int, offset: Array, covariance: Array, driven: Array, driven_cov: Array, overlap: float
    ) -> None:
        self.offset, self.covariance = offset, covariance
        self.driven, self.driven_covariance = driven, driven_cov
        self.reference[k], self.offsets[k], self.matched[k] = len(self.keyframes) - 1, offset, overlap > 0
        self.wants_keyframe = (
            np.hypot(offset[0], offset[1]) > KEYFRAME_SPACING_M
            or abs(offset[2]) > KEYFRAME_TURN_RAD
            or overlap < ENOUGH_OVERLAP
        )


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
    """Drive through it once."""
    sweeps, odometry = segment.sweeps, segment.odometry
    chain = _Chain(len(sweeps), sweeps.mount, match)
    scans = sweeps.scans(np.arange(len(sweeps)))
    before = next(scans)
    chain.add_keyframe(0, before)
    for k, current in enumerate(scans, start=1):
        step, noise = odometry.deltas[k - 1], odometry.covariances[k - 1]
        if not chain.advance(k, current, step, noise, search=False):
            if chain.keyframes[-1] != k - 1:  # too little in common with the key frame; more with the scan before
                chain.add_keyframe(k - 1, before)
            if not (
                chain.advance(k, current, step, noise, search=False)
                or chain.advance(k, current, step, noise, search=True)
            ):
                chain.coast(k, step, noise)
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
    )


def join_segments(sweeps: Sweeps, odometry: Motions, parts: Sequence[DrivenSegment]) -> OpenLoop:
    """The whole run. A scan that two segments share is the last of the one and the first key frame of the other."""
    counts = np.cumsum([0] + [len(part.keyframes) - 1 for part in parts])
    keyframes, reference, offsets, matched = [np.zeros(1, np.int64)], [np.zeros(1, np.int64)], [], []
    for part, before in zip(parts, counts[:-1], strict=True):
        keyframes.append(part.first + part.keyframes[1:])
        reference.append(before + part.reference[1:])
        offsets.append(part.offsets[1:])
        matched.append(part.matched[1:])
    return OpenLoop(
        odometry,
        sweeps,
        np.concatenate(keyframes),
        _in_a_row([part.motions for part in parts], [part.covariances for part in parts], robust=True),
        _in_a_row([part.wheels.deltas for part in parts], [part.wheels.covariances for part in parts], robust=False),
        np.concatenate(reference),
        np.concatenate([np.zeros((1, 3)), *offsets]),
        np.concatenate([np.zeros(1, bool), *matched]),
    )


def _in_a_row(motions: list[Array], covariances: list[Array], robust: bool) -> Links:
    joined = np.concatenate(motions)
    ends = np.column_stack([np.arange(len(joined)), np.arange(1, len(joined) + 1)])
    return Links.of(ends, joined, np.asarray(np.linalg.inv(np.concatenate(covariances))), robust)

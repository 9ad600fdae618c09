"""The open-loop estimate of one run: odometry and scan matching, fused step by step (paper, section 2.1).

In: a `Run`. Out: a pose for every scan, key frames with their scans ready for matching, and the chain of fused links
that joins them: the weak links of Lu & Milios. Passes of tags are key frames, so that a run can be cut there.

    scan   0 . . . . 5 . . . 9 . . .        every scan is matched to the key frame before it, not to the scan before it,
           ●         ●       ●              so errors add up per key frame; a new one is made when the view has changed
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hw_profiles.profile import OdometryNoise
from processing.fusion import consistent, fuse
from processing.geometry import accumulate, compose, compose_jacobians, inverse
from processing.match_search import search_match
from processing.odometry import Motions, odom_motions, wheel_motions
from processing.pose_graph import Links
from processing.read_log import Run, Scans
from processing.scan_match import through_mount
from processing.scan_matching import Matcher, Scan, match_scans, prepare_scan

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

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
    points: NDArray[np.float32]  # (n, B, 2) m, scanner frame, the motion during the sweep removed; NaN without a return
    keyframes: Ints  # (K,) scan indices, the first is 0
    scans: list[Scan]  # K
    links: Links  # K - 1, between key frames in a row, fused: the chain
    wheels: Links  # K - 1, the same by odometry alone, with ample doubt: what is left where a match was wrong
    reference: Ints  # (n,) which key frame a scan was matched to
    offsets: Array  # (n, 3) pose of a scan in the frame of that key frame
    matched: NDArray[np.bool_]  # (n,) False: odometry alone

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


def interpolate_poses(times: Array, poses: Array, at: Array) -> Array:
    """Poses (k, 3) at times `at` (k,), between poses (m, 3) at rising `times` (m,); held before the first and after
    the last.
    """
    columns = [poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2])]
    return np.column_stack([np.interp(at, times, column) for column in columns])


def undistort(scans: Scans, odometry: Motions, mount: Array) -> NDArray[np.float32]:
    """Points (n, B, 2) of each sweep as if all beams had been measured at its first ray; NaN where there is no range.

    While the mirror turns, the vehicle drives on: at 20 km/h and 15 ms a sweep that is 8 cm.
    """
    ranges = np.where(np.isfinite(scans.ranges), scans.ranges, np.nan).astype(np.float64)
    angles = scans.angles
    points = np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=-1)
    if scans.time_increment_s != 0 and len(ranges) > 1:
        seconds = np.diff(scans.times)
        seconds = np.maximum(seconds, np.median(seconds) / 2)  # times squeezed by a clock set back are no speed
        rates = np.vstack([odometry.deltas, odometry.deltas[-1:]]) / np.append(seconds, seconds[-1])[:, None]
        since = scans.time_increment_s * np.arange(len(angles))
        if scans.time_increment_s < 0:
            since = since - since[-1]
        moved = rates[:, None, :] * since[None, :, None]  # (n, B, 3) of the vehicle, since the first ray
        scanner = compose(inverse(mount), compose(moved, mount))
        c, s = np.cos(scanner[..., 2]), np.sin(scanner[..., 2])
        x, y = points[..., 0].copy(), points[..., 1].copy()
        points[..., 0] = scanner[..., 0] + c * x - s * y
        points[..., 1] = scanner[..., 1] + s * x + c * y
    return points.astype(np.float32)


class _Chain:
    """The growing chain of key frames, and where the vehicle is since the last of them."""

    def __init__(self, count: int, mount: Array, match: Matcher) -> None:
        self.mount, self.to_scanner, self.match = mount, inverse(mount), match
        self.keyframes: list[int] = []
        self.scans: list[Scan] = []
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
        self.scans.append(scan)
        self.reference[k], self.offsets[k] = len(self.keyframes) - 1, 0.0
        self.offset, self.covariance = np.zeros(3), np.zeros((3, 3))
        self.driven, self.driven_covariance = np.zeros(3), np.zeros((3, 3))

    def advance(self, k: int, scan: Scan, step: Array, noise: Array, search: bool) -> bool:
        """Match scan `k`, one odometry `step` after the last; False leaves all as it was."""
        j_before, j_step = compose_jacobians(self.driven, step)
        driven = compose(self.driven, step)
        covariance = j_before @ self.driven_covariance @ j_before.T + j_step @ noise @ j_step.T
        guess = compose(self.to_scanner, compose(compose(self.offset, step), self.mount))
        if search:
            result = search_match(self.scans[-1], scan, guess, SEARCH_M, SEARCH_RAD)
        else:
            result = self.match(self.scans[-1], scan, guess)
        motion, doubt = through_mount(self.mount, result.motion, result.covariance)
        odometry = Motions(driven[None], covariance[None])
        accepted = result.converged and result.inliers >= MIN_INLIERS
        if not accepted or not consistent(Motions(driven[None], GATE * covariance[None]), motion[None], doubt[None])[0]:
            return False
        fused = fuse(odometry, motion[None], doubt[None], np.array([True]))
        doubt = GATE * covariance if search else fused.covariances[0]  # what had to be searched for may be elsewhere
        self._arrive(k, fused.deltas[0], doubt, driven, covariance, result.overlap)
        return True

    def coast(self, k: int, step: Array, noise: Array) -> None:
        """Take odometry's word for scan `k`."""
        j_before, j_step = compose_jacobians(self.offset, step)
        covariance = j_before @ self.covariance @ j_before.T + j_step @ (GATE * noise) @ j_step.T
        j_before, j_step = compose_jacobians(self.driven, step)
        driven_covariance = j_before @ self.driven_covariance @ j_before.T + j_step @ noise @ j_step.T
        self._arrive(k, compose(self.offset, step), covariance, compose(self.driven, step), driven_covariance, 0.0)

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


def estimate_open_loop(run: Run, forced: Ints, match: Matcher = match_scans) -> OpenLoop:
    """Drive through the run once. `forced`: scans that shall be key frames, ascending."""
    odometry, mount = odometry_at_scans(run), mount_pose(run)
    points = undistort(run.scans, odometry, mount)
    count = len(points)
    cuts = set(forced.tolist()) | {count - 1}
    chain = _Chain(count, mount, match)
    before = prepare_scan(points[0], run.scans.angle_min, run.scans.angle_increment)
    chain.add_keyframe(0, before)
    for k in range(1, count):
        step, noise = odometry.deltas[k - 1], odometry.covariances[k - 1]
        current = prepare_scan(points[k], run.scans.angle_min, run.scans.angle_increment)
        if not chain.advance(k, current, step, noise, search=False):
            if chain.keyframes[-1] != k - 1:  # too little in common with the key frame; more with the scan before
                chain.add_keyframe(k - 1, before)
            if not (
                chain.advance(k, current, step, noise, search=False)
                or chain.advance(k, current, step, noise, search=True)
            ):
                chain.coast(k, step, noise)
        if chain.wants_keyframe or k in cuts:
            chain.add_keyframe(k, current)
        before = current
    return OpenLoop(
        odometry,
        points,
        np.array(chain.keyframes, np.int64),
        chain.scans,
        _in_a_row(chain.motions, chain.covariances, robust=True),
        _in_a_row(chain.odometry_motions, chain.odometry_covariances, robust=False),
        chain.reference,
        chain.offsets,
        chain.matched,
    )


def _in_a_row(motions: list[Array], covariances: list[Array], robust: bool) -> Links:
    count = len(motions)
    ends = np.column_stack([np.arange(count), np.arange(1, count + 1)])
    informations = np.asarray(np.linalg.inv(np.array(covariances).reshape(count, 3, 3)), np.float64)
    return Links.of(ends, np.array(motions).reshape(count, 3), informations, robust)

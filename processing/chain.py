"""The chain of key frames of a drive, with two witnesses: the wheels and the walls, each believed as far as it can see.

In: scans in a row, and each time how the wheels moved. Out: key frames, the fused motions between them, and the
stretches in which a witness was convicted.

    do they agree?                          both, as eq. (3) weighs them
    they do not, and the walls object to    the wheels are convicted: the walls decide where they see, and where they
    the wheels' pose wherever one looks     see nothing, the wheels and the motion so far, with ample doubt
    they do not, and the walls fit the      the scan is convicted: it may be moved along the way from the one pose to
    wheels' pose nearly as well             the other, so there the wheels decide; across it the walls still do

A match starts from the wheels, and where these contradict it or nothing is found there, from the motion so far too: a
vehicle cannot change its motion at once, wheels can. So a slip, a stuck or a reset encoder costs its own stretch.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.chain_step import carry, invert, join, to_laser, to_vehicle
from processing.fusion import CHI_SQUARED_3_999, fuse
from processing.match_search import agreement, search_match
from processing.objection import objection
from processing.odometry import SPEED_UP_M_S2, TURN_UP_RAD_S2
from processing.scan_match import ScanMatch
from processing.scan_matching import LEVER_M, Matcher
from processing.scan_walls import Scan

Array = NDArray[np.float64]

KEYFRAME_SPACING_M = 0.75
KEYFRAME_TURN_RAD = 0.35
MIN_INLIERS = 0.6  # fewer of the points that both must see: no match
ENOUGH_OVERLAP = 0.7  # fewer points in common: time for a new key frame
SEARCH_M, SEARCH_RAD = 0.5, 0.6  # how far around the odometry a match is searched when all else failed
GATE = 9.0  # wheels err by their radius and by slip, not only at random: three times the standard deviation is let pass
HONEST = 3.0  # standard deviations that wheels may be off without being at fault
OPEN = 100.0  # of what the two witnesses differ by, squared: the doubt of a match that may as well be moved so far
OBJECTS = 0.02  # walls that fit worse by as much at the wheels' pose convict them
NEUTRAL = 0.005  # smooth walls, which fit there as well, differ by less
ASKEW_RAD = 0.05  # what moves along with the vehicle does not turn a match; one as far turned saw other walls
HALF_TRACK_M = 0.8  # of a vehicle of this kind
PAUSE_S = 1.0  # a single match after a longer one convicts nobody: where the vehicle went meanwhile, wheels know best
SUSPECT_S = 3.0
STUCK_M, STUCK_RAD = 1e-3, 1e-4
LONG_S = 0.3  # of a pause so long the motion before says as much as it ever will
STEP_M, STEP_RAD = 0.05, 0.03  # what a match and a stamp may be off, besides
AWRY = (0.3, 0.3, 0.2)  # m, m, rad: what convicted wheels may be off in one step, where the walls show nothing
SLIPPED = (0.05, 0.05, 0.02)  # m, m, rad: and where they do
STEADY_M_S2, STEADY_RAD_S2 = 1.0, 1.0  # how fast motions usually change


@dataclass(frozen=True, slots=True)
class Contradiction:
    """A scan at which wheels and walls contradicted each other, and who was convicted."""

    scan: int
    convicts_wheels: bool
    missed: Array  # (3,) what the wheels would have been off, or the scan


@dataclass(frozen=True, slots=True)
class Motion:
    """Since the last key frame, in its frame."""

    pose: Array  # (3,)
    covariance: Array  # (3, 3)


class Chain:
    """The growing chain, and where the vehicle is since its last key frame."""

    scan: Scan  # of the last key frame

    def __init__(self, count: int, mount: Array, match: Matcher, is_even: bool = True) -> None:
        """`is_even`: scans and odometry keep an even pace, so that a sudden change of motion means something."""
        self.mount, self.match, self.is_even = mount, match, is_even
        self.keyframes: list[int] = []
        self.motions: list[Array] = []
        self.covariances: list[Array] = []
        self.odometry_motions: list[Array] = []
        self.odometry_covariances: list[Array] = []
        self.contradictions: list[Contradiction] = []
        self.reference, self.offsets = np.zeros(count, np.int64), np.zeros((count, 3))
        self.matched = np.zeros(count, bool)
        self.offset, self.covariance = np.zeros(3), np.zeros((3, 3))  # fused, since the key frame
        self.driven, self.driven_covariance = np.zeros(3), np.zeros((3, 3))  # by odometry alone, since the key frame
        self.suspect_s = 0.0  # for how long the wheels have been suspect
        self.velocity: Array | None = None  # (3,) of the last step, m/s and rad/s
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

    def advance(self, k: int, scan: Scan, step: Array, noise: Array, seconds: float) -> bool:
        """Match scan `k`, one odometry `step` and `seconds` after the last; False leaves all as it was."""
        wheels = Motion(*carry(self.driven, self.driven_covariance, step, noise))
        result = self._match(scan, join(self.offset, step))
        if _is_good(result):
            walls = self._motion_of(result)
            # at an uneven pace the views differ too much for walls to object to little
            gate = 1.0 if self.is_even else GATE
            agrees, *fused = fuse(wheels.pose, wheels.covariance, gate, walls.pose, walls.covariance)
            if agrees:
                self.suspect_s = 0.0
                self._arrive(k, Motion(*fused), wheels, result.overlap, seconds)
                return True
        onward = self._onward(step, seconds)
        tried = [result] if self.velocity is None else [result, self._match(scan, join(self.offset, onward))]
        good = [of for of in tried if _is_good(of)]
        if not good:
            return False
        possible = [of for of in good if self._is_possible(self._motion_of(of), onward, seconds)]
        best = max(possible or good, key=agreement)
        return self._judge(k, scan, best, bool(possible), wheels, step, onward, seconds)

    def _suspected_for(self, step: Array, onward: Array, seconds: float) -> float:
        """For how long the wheels have said what the vehicle can hardly have done, this step included [s]."""
        by_wheels = Motion(join(self.offset, step), np.zeros((3, 3)))
        return 0.0 if self._is_possible(by_wheels, onward, seconds) else self.suspect_s + seconds

    def _are_suspect(self, step: Array, suspect_s: float) -> bool:
        """Not for long: it may be the motion so far that is wrong; but wheels that do not turn at all may be stuck."""
        stuck = math.hypot(step[0], step[1]) < STUCK_M and abs(step[2]) < STUCK_RAD
        return self.is_even and (0 < suspect_s < SUSPECT_S or (suspect_s > 0 and stuck))

    def find(self, k: int, scan: Scan, step: Array, noise: Array, seconds: float) -> bool:
        """The same by a search around where the wheels say; what had to be searched for convicts nobody."""
        wheels = Motion(*carry(self.driven, self.driven_covariance, step, noise))
        at = to_laser(self.mount, self.mount, join(self.offset, step))
        result = search_match(self.scan, scan, at, SEARCH_M, SEARCH_RAD)
        if not _is_good(result):
            return False
        walls = self._motion_of(result)
        agrees, fused, _ = fuse(wheels.pose, wheels.covariance, GATE, walls.pose, walls.covariance)
        if agrees:  # but it may be elsewhere
            self._arrive(k, Motion(fused, GATE * wheels.covariance), wheels, result.overlap, seconds)
        return agrees

    def _judge(
        self,
        k: int,
        scan: Scan,
        result: ScanMatch,
        possible: bool,
        wheels: Motion,
        step: Array,
        onward: Array,
        seconds: float,
    ) -> bool:
        """The wheels contradict a match, or led to none: who of the two is right? False: it is no match at all."""
        walls = self._motion_of(result)
        # what the walls leave open they do not quarrel about
        ample = GATE * wheels.covariance + np.diag(np.square(SLIPPED))
        _, demanded, _ = fuse(wheels.pose, ample, 1.0, walls.pose, walls.covariance)
        missed = demanded - wheels.pose
        missed[2] = math.remainder(missed[2], 2 * math.pi)
        honest = _honest_share(missed, wheels.covariance)
        poses = (to_laser(self.mount, self.mount, pose) for pose in (demanded, wheels.pose + honest))
        against = objection(self.scan, scan, *poses) if possible else -1.0
        suspect_s = self._suspected_for(step, onward, seconds)
        if possible and against >= -OBJECTS and self._are_suspect(step, suspect_s):
            against = max(against, OBJECTS)  # what only a part of the view says is enough then
        within, *fused = fuse(wheels.pose, wheels.covariance, GATE, walls.pose, walls.covariance)
        if np.allclose(honest, missed) or (within and NEUTRAL <= against < OBJECTS):
            self._arrive(k, Motion(*fused), wheels, result.overlap, seconds)
        elif (against < OBJECTS and abs(missed[2]) > ASKEW_RAD) or (not within and seconds > PAUSE_S):
            return False
        elif against < OBJECTS:
            unsure = walls.covariance + OPEN * np.outer(missed, missed)
            _, *fused = fuse(wheels.pose, wheels.covariance, GATE, walls.pose, unsure)
            self._arrive(k, Motion(*fused), wheels, result.overlap, seconds)
        elif within:  # a slip that is not worth to be told
            quarrel = missed - honest
            doubted = wheels.covariance + np.outer(quarrel, quarrel)
            doubted[0, 0] += (HALF_TRACK_M * quarrel[2]) ** 2  # one wheel that slips counts the way wrongly as well
            _, *fused = fuse(wheels.pose, doubted, GATE, walls.pose, walls.covariance)
            self._arrive(k, Motion(*fused), Motion(wheels.pose, doubted), result.overlap, seconds)
        else:
            prior = self._without_wheels(step, onward, seconds)
            _, *fused = fuse(prior.pose, prior.covariance, GATE, walls.pose, walls.covariance)
            # from here on the wheels count from where the walls put the vehicle
            slipped = wheels.covariance + np.outer(missed, missed) + np.diag(np.square(SLIPPED))
            self._arrive(k, Motion(*fused), Motion(fused[0], slipped), result.overlap, seconds)
        self.suspect_s = suspect_s
        if not within:
            self.contradictions.append(Contradiction(k, against >= OBJECTS, missed))
        return True

    def coast(self, k: int, step: Array, noise: Array, seconds: float) -> None:
        """Take odometry's word for scan `k`."""
        fused = Motion(*carry(self.offset, self.covariance, step, GATE * noise))
        self._arrive(k, fused, Motion(*carry(self.driven, self.driven_covariance, step, noise)), 0.0, seconds)

    def _match(self, scan: Scan, guess: Array) -> ScanMatch:
        return self.match(self.scan, scan, to_laser(self.mount, self.mount, guess))

    def _motion_of(self, result: ScanMatch) -> Motion:
        return Motion(*to_vehicle(self.mount, self.mount, result.motion, result.covariance))

    def _onward(self, step: Array, seconds: float) -> Array:
        """The next step of a vehicle that keeps its motion."""
        return step if self.velocity is None else self.velocity * seconds

    def _is_possible(self, motion: Motion, onward: Array, seconds: float) -> bool:
        """Could the vehicle have got there from its motion so far, as far as that is known?"""
        if self.velocity is None:
            return True
        far, turned = (
            np.array([SPEED_UP_M_S2, TURN_UP_RAD_S2]) * min(seconds, LONG_S) ** 2 + (STEP_M, STEP_RAD)
        ).tolist()
        reach = self.covariance + np.diag([far**2, far**2, turned**2]) / CHI_SQUARED_3_999
        return fuse(join(self.offset, onward), reach, 1.0, motion.pose, motion.covariance)[0]

    def _without_wheels(self, step: Array, onward: Array, seconds: float) -> Motion:
        """Where convicted wheels and the motion so far put the vehicle together, and with what doubt."""
        spread = np.diag(np.square(AWRY))
        if self.velocity is None:
            return Motion(join(self.offset, step), self.covariance + spread)
        change = np.array([STEADY_M_S2, 0.2 * STEADY_M_S2, STEADY_RAD_S2]) * seconds**2
        steady = np.diag(np.square(change + np.array([1e-3, 1e-3, 1e-3])))
        _, moved, doubt = fuse(onward, steady, GATE, step, spread)
        return Motion(*carry(self.offset, self.covariance, moved, doubt))

    def _arrive(self, k: int, fused: Motion, wheels: Motion, overlap: float, seconds: float) -> None:
        if seconds > 0:
            self.velocity = join(invert(self.offset), fused.pose) / seconds
        offset = self.offset = fused.pose
        self.covariance = fused.covariance
        self.driven, self.driven_covariance = wheels.pose, wheels.covariance
        self.reference[k], self.offsets[k], self.matched[k] = len(self.keyframes) - 1, offset, overlap > 0
        self.wants_keyframe = (
            np.hypot(offset[0], offset[1]) > KEYFRAME_SPACING_M
            or abs(offset[2]) > KEYFRAME_TURN_RAD
            or overlap < ENOUGH_OVERLAP
        )


def _is_good(result: ScanMatch) -> bool:
    return bool(result.converged and result.inliers >= MIN_INLIERS)


def _honest_share(missed: Array, covariance: Array) -> Array:
    """Of what the wheels missed (3,) as much as honest wheels may miss: what lies within HONEST along the axes of their
    covariance (3, 3). The rest is what the two witnesses quarrel about.
    """
    lever = np.array([1.0, 1.0, LEVER_M])
    values, axes = np.linalg.eigh(covariance * np.outer(lever, lever))
    along = axes.T @ (missed * lever)
    along[np.abs(along) > HONEST * np.sqrt(values)] = 0.0
    return np.asarray(axes @ along / lever)

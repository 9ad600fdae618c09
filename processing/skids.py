"""Skids: stretches in which the wheels did what no vehicle does, and then went on as before.

In: the motions of an odometry, and how long each took. Out: the same, with the motions of a skid replaced by those of a
vehicle that keeps rolling, in ample doubt. Wheels that lock, spin or jump change their motion at once; a vehicle needs
a second for it. What does not come back within seconds was no skid: then the motion before may have been wrong.

    speed  ────────┐        ┌────────       two changes that no vehicle makes, and the same speed before and after:
                   └────────┘               between smooth walls nothing else would tell
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from processing.odometry import MAX_M_S, MAX_RAD_S, SPEED_UP_M_S2, TURN_UP_RAD_S2, Motions

Array = NDArray[np.float64]

LONGEST_S = 3.0
MAX_PACE_S, UNEVEN = 0.3, 1.5  # samples further apart, or at no pace, do not show which change is sudden
OFF_M_S, OFF_RAD_S = 0.15, 1.0  # what an uneven floor and a quick hand at the wheel make of it, besides; so many times
NOISE = 6.0  # what stamps that are off and coarse counts make of it everywhere
SHARE = 0.15
STEADY_M_S2, STEADY_RAD_S2 = 0.3, 0.3  # how much it may have changed meanwhile
MOVES_M_S = 0.1
LEAST_JUMP_M, LEAST_JUMP_RAD = 2.0, 1.0
ROLLS = (0.05, 0.02, 0.02)  # m, m, rad: doubt of a step that was filled in


def without_skids(motions: Motions, seconds: Array) -> Motions:
    """The motions over so many `seconds` (n,), rolling on through every skid; `guessed` where they do."""
    if not len(seconds):
        return motions
    seconds = np.maximum(seconds, np.median(seconds) / 2)  # times squeezed by a clock set back are no speed
    velocities = motions.deltas / seconds[:, None]
    impossible = _impossible(motions.deltas, velocities)
    guessed = impossible.copy()
    if has_pace(seconds):
        changes = np.abs(np.diff(velocities[:, [0, 2]], axis=0))
        changes = changes[np.abs(velocities[1:, 0]) > MOVES_M_S]
        usual = np.median(changes, axis=0) if len(changes) else np.zeros(2)
        off = np.array([OFF_M_S, OFF_RAD_S]) + NOISE * usual
        _find_skids(velocities, seconds, off, guessed)
    if not guessed.any():
        return motions
    kept, number = np.flatnonzero(~guessed), np.arange(len(seconds))
    rolling = np.zeros_like(velocities)  # nothing is known where no step is one that a vehicle makes
    if len(kept):
        rolling = np.column_stack([np.interp(number, kept, velocities[kept, of]) for of in range(3)])
    deltas = np.where(guessed[:, None], rolling * seconds[:, None], motions.deltas)
    ample = motions.covariances + np.diag(np.square(ROLLS))
    ample[impossible] = np.diag(np.square(ROLLS))  # their own doubt grew with a way that nobody drove
    return Motions(deltas, np.where(guessed[:, None, None], ample, motions.covariances), guessed)


def has_pace(seconds: Array) -> bool:
    """Do samples so many `seconds` (n,) apart come quickly and evenly enough to show sudden changes?"""
    pace_s = float(np.median(seconds)) if len(seconds) else np.inf
    return bool(pace_s <= MAX_PACE_S and np.quantile(seconds, 0.9) < UNEVEN * pace_s)


def _impossible(deltas: Array, velocities: Array) -> NDArray[np.bool_]:
    """Steps (n, 3) that are too far for any vehicle: a count or a pose that starts anew."""
    metres, radians = np.hypot(deltas[:, 0], deltas[:, 1]), np.abs(deltas[:, 2])
    too_far = (np.hypot(velocities[:, 0], velocities[:, 1]) > MAX_M_S) & (metres > LEAST_JUMP_M)
    return np.asarray(too_far | ((np.abs(velocities[:, 2]) > MAX_RAD_S) & (radians > LEAST_JUMP_RAD)))


@njit(cache=True)
def _find_skids(velocities: Array, seconds: Array, off: Array, guessed: NDArray[np.bool_]) -> None:
    """Mark the skids among velocities (n, 3), which may be `off` (2,) by so many m/s and rad/s."""
    count = len(velocities)
    before = -1  # the last motion that is believed
    k = 0
    while k < count:
        if guessed[k]:
            k += 1
            continue
        if before < 0 or not _is_sudden(velocities[before], velocities[k], seconds[k], off):
            before = k
            k += 1
            continue
        elapsed, end = seconds[k], k + 1
        while end < count and elapsed <= LONGEST_S:
            sudden = _is_sudden(velocities[end - 1], velocities[end], seconds[end], off)
            if sudden and not guessed[end] and _comes_back(velocities[before], velocities[end], elapsed, off):
                break
            elapsed += seconds[end]
            end += 1
        if end < count and elapsed <= LONGEST_S:
            guessed[k:end] = True
        else:
            end = k + 1
        before = end - 1 if end == k + 1 and not guessed[k] else before
        k = end


@njit(cache=True)
def _is_sudden(before: Array, now: Array, elapsed_s: float, off: Array) -> bool:
    changes = abs(now[0] - before[0]) > SPEED_UP_M_S2 * elapsed_s + off[0]
    return changes or abs(now[2] - before[2]) > TURN_UP_RAD_S2 * elapsed_s + off[1]


@njit(cache=True)
def _comes_back(before: Array, now: Array, elapsed_s: float, off: Array) -> bool:
    speed = abs(before[0])
    same = abs(now[0] - before[0]) < STEADY_M_S2 * elapsed_s + off[0] + SHARE * speed
    return same and abs(now[2] - before[2]) < STEADY_RAD_S2 * elapsed_s + off[1]

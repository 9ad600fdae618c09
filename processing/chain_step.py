"""One step of the chain of key frames, compiled: what happens for every scan must not wait for small arrays in Python.

The same as `compose`, `compose_jacobians` and `through_mount` do for many steps at once; the tests hold the two against
each other.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]


@njit(cache=True)
def join(a: Array, b: Array) -> Array:
    """a ⊕ b of two poses (3,)."""
    c, s, turn = math.cos(a[2]), math.sin(a[2]), a[2] + b[2]
    turn = -((-turn + math.pi) % (2 * math.pi) - math.pi)
    return np.array([a[0] + c * b[0] - s * b[1], a[1] + s * b[0] + c * b[1], turn])


@njit(cache=True)
def invert(pose: Array) -> Array:
    """⊖ of a pose (3,)."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.array([-c * pose[0] - s * pose[1], s * pose[0] - c * pose[1], -pose[2]])


@njit(cache=True)
def carry(pose: Array, covariance: Array, step: Array, noise: Array) -> tuple[Array, Array]:
    """A pose (3,) and its covariance (3, 3) after one more step (3,) with covariance `noise`."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    j_pose = np.array([[1.0, 0.0, -s * step[0] - c * step[1]], [0.0, 1.0, c * step[0] - s * step[1]], [0.0, 0.0, 1.0]])
    j_step = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return join(pose, step), j_pose @ covariance @ j_pose.T + j_step @ noise @ j_step.T


@njit(cache=True)
def to_laser(first: Array, second: Array, motion: Array) -> Array:
    """From a vehicle with its laser at `first` (3,) to one with its laser at `second`, or the same one later: a motion
    (3,) of the vehicles as that of their lasers.
    """
    return join(invert(first), join(motion, second))


@njit(cache=True)
def to_vehicle(first: Array, second: Array, motion: Array, covariance: Array) -> tuple[Array, Array]:
    """The way back: a motion (3,) from the laser at `first` to the laser at `second`, and its covariance (3, 3), as the
    vehicles'.
    """
    moved = join(join(first, motion), invert(second))
    c, s, cm, sm = math.cos(moved[2]), math.sin(moved[2]), math.cos(first[2]), math.sin(first[2])
    jacobian = np.array(
        [[cm, -sm, s * second[0] + c * second[1]], [sm, cm, -c * second[0] + s * second[1]], [0.0, 0.0, 1.0]]
    )
    return moved, jacobian @ covariance @ jacobian.T


@njit(cache=True)
def add_up(steps: Array, noises: Array, ends: NDArray[np.int64]) -> tuple[Array, Array]:
    """Motions (n - 1, 3) and their covariances, of all steps (m, 3) from each of the `ends` (n,) to the next."""
    count = len(ends) - 1
    motions, covariances = np.zeros((count, 3)), np.zeros((count, 3, 3))
    for k in range(count):
        motions[k], covariances[k] = steps[ends[k]], noises[ends[k]]
        for i in range(ends[k] + 1, ends[k + 1]):
            motions[k], covariances[k] = carry(motions[k], covariances[k], steps[i], noises[i])
    return motions, covariances

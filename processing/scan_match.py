"""The result of matching two scans, whichever matcher found it, and its way from the laser to the vehicle.

Its law: a match keeps its doubt. The covariance is that of the three numbers of the motion, and large where the walls
leave the motion open.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing import geometry

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ScanMatch:
    """Pose of the current scan's laser in the frame of the reference scan's laser."""

    motion: Array  # (3,) x [m], y [m], θ [rad]
    covariance: Array  # (3, 3)
    inliers: float  # 0…1: of the current scan's beams that the reference must have seen, those that found their wall
    residual_m: float  # root mean square distance of the inliers from it
    converged: bool
    overlap: float = 1.0  # 0…1: of all valid beams of the current scan, those that found their wall


def through_mount(mount: Array, motions: Array, covariances: Array) -> tuple[Array, Array]:
    """Motions (..., 3) of a laser that sits at `mount` (3,) in the vehicle, as motions of the vehicle.

    With `geometry.inverse(mount)` the other way: what a motion of the vehicle is to the laser.
    """
    moved = geometry.compose(geometry.compose(mount, motions), geometry.inverse(mount))
    jacobian = np.zeros_like(covariances)
    jacobian[..., :2, :2] = geometry.rotation(mount[2])
    # by which way the origin swings about the laser when the vehicle turns: -∂(R(θ) mount)/∂θ
    c, s = np.cos(moved[..., 2]), np.sin(moved[..., 2])
    jacobian[..., 0, 2] = s * mount[0] + c * mount[1]
    jacobian[..., 1, 2] = -c * mount[0] + s * mount[1]
    jacobian[..., 2, 2] = 1.0
    return moved, np.asarray(jacobian @ covariances @ np.swapaxes(jacobian, -1, -2))

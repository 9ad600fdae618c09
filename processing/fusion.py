"""Fusion of odometry and scan matching: two opinions on a motion become one.

In: a motion by odometry and the same one by the match of two scans, each with its covariance, in the same frame (the
vehicle's: see `chain_step.to_vehicle`). Out: whether they agree, and the motion that both give. Compiled, for it
happens at every scan.

Source: Lavigne & Marshall 2012, eq. (3), (4): a Kalman update with the odometry a priori. What makes it right is a
match that admits what it cannot see: along a smooth drift its variance is large, and the wheels decide.
"""

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]

CHI_SQUARED_3_999 = 16.27  # 99.9 % quantile of chi squared with three degrees of freedom
TREMBLE_M, TREMBLE_RAD = 0.003, 0.002  # what an engine does to a vehicle that stands is no contradiction


@njit(cache=True)
def fuse(
    expected: Array,  # (3,) by odometry
    expected_covariance: Array,  # (3, 3)
    gate: float,
    matched: Array,  # (3,)
    matched_covariance: Array,  # (3, 3) positive definite; where nothing is seen large, not infinite
) -> tuple[bool, Array, Array]:
    """Whether the two agree, and the fused motion (3,) with its covariance (3, 3).

    They agree where the squared Mahalanobis distance of the innovation lies within 99.9 %, the odometry's covariance
    taken `gate` times, and as much as a vehicle trembles. The fused motion is less uncertain in every direction than
    either opinion.
    """
    innovation = matched - expected
    innovation[2] = -((-innovation[2] + math.pi) % (2 * math.pi) - math.pi)
    tremble = np.diag(np.array([TREMBLE_M * TREMBLE_M, TREMBLE_M * TREMBLE_M, TREMBLE_RAD * TREMBLE_RAD]))
    spread = gate * expected_covariance + matched_covariance + tremble
    agrees = innovation @ np.linalg.solve(spread, innovation) <= CHI_SQUARED_3_999
    # K = P_odom (P_odom + P_sm)⁻¹, all symmetric
    gain = np.ascontiguousarray(np.linalg.solve(expected_covariance + matched_covariance, expected_covariance).T)
    fused = expected + gain @ innovation  # eq. (3)
    fused[2] = -((-fused[2] + math.pi) % (2 * math.pi) - math.pi)
    # eq. (4) in Joseph's form: the same number, but symmetric and positive whatever the rounding
    kept = np.eye(3) - gain
    covariance = kept @ expected_covariance @ kept.T + gain @ matched_covariance @ gain.T
    return bool(agrees), fused, covariance

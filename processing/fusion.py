"""Fusion of odometry and scan matching: two opinions on each motion become one.

In: `Motions` of the odometry, the matches of the scans at the same steps, in the same frame (the vehicle's: see
`scan_match.through_mount`). Out: `Motions`. A step without a match, or with a refused one, keeps its odometry.

Source: Lavigne & Marshall 2012, eq. (3), (4): a Kalman update with the odometry a priori. What makes it right is a
match that admits what it cannot see: along a smooth drift its variance is large, and the wheels decide.

The open loop takes one step at a time, compiled: `chain_step.weigh`. This is the plain form that tests hold it against.
"""

import numpy as np
from numpy.typing import NDArray

from processing import geometry
from processing.odometry import Motions

Array = NDArray[np.float64]

CHI_SQUARED_3_999 = 16.27  # 99.9 % quantile of chi squared with three degrees of freedom


def fuse(
    odometry: Motions,
    matched: Array,  # (n, 3)
    matched_covariances: Array,  # (n, 3, 3) positive definite; where nothing is seen large, not infinite
    accepted: NDArray[np.bool_],  # (n,)
) -> Motions:
    """The fused motions: where a match is accepted, less uncertain in every direction than either opinion."""
    deltas, covariances = odometry.deltas.copy(), odometry.covariances.copy()
    prior, measured = covariances[accepted], matched_covariances[accepted]
    gain = np.swapaxes(np.linalg.solve(prior + measured, prior), -1, -2)  # K = P_odom (P_odom + P_sm)⁻¹, all symmetric
    innovation = _innovation(deltas[accepted], matched[accepted])
    deltas[accepted] += (gain @ innovation[..., None])[..., 0]  # eq. (3)
    deltas[:, 2] = geometry.wrap_angle(deltas[:, 2])
    # eq. (4) in Joseph's form: the same number, but symmetric and positive whatever the rounding
    kept = np.eye(3) - gain
    covariances[accepted] = _congruent(kept, prior) + _congruent(gain, measured)
    return Motions(deltas, covariances)


def consistent(odometry: Motions, matched: Array, matched_covariances: Array) -> NDArray[np.bool_]:
    """Which matches (n,) agree with the odometry: innovation within the 99.9 % gate of its Mahalanobis distance."""
    innovation = _innovation(odometry.deltas, matched)
    spread = odometry.covariances + matched_covariances
    whitened = np.linalg.solve(spread, innovation[..., None])[..., 0]
    return np.asarray(np.einsum("ni,ni->n", innovation, whitened) <= CHI_SQUARED_3_999)


def _innovation(expected: Array, measured: Array) -> Array:
    difference = measured - expected
    difference[:, 2] = geometry.wrap_angle(difference[:, 2])
    return difference


def _congruent(a: Array, p: Array) -> Array:
    return np.asarray(a @ p @ np.swapaxes(a, -1, -2))

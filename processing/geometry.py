"""SE(2): wrap_angle, composition, relative pose, Jacobians. The only ones.

A pose is an array (..., 3) of x [m], y [m], heading θ [rad], REP-103: x ahead, y left, θ counter-clockwise. All
functions broadcast over the leading axes.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def wrap_angle(angle: Array | float) -> Array:
    """The same angle in (-π, π]."""
    return np.asarray(-((-np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi))


def compose(a: Array, b: Array) -> Array:
    """a ⊕ b: the pose b, given in the frame of a, in the frame that a is given in."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    x = a[..., 0] + c * b[..., 0] - s * b[..., 1]
    y = a[..., 1] + s * b[..., 0] + c * b[..., 1]
    return np.stack([x, y, wrap_angle(a[..., 2] + b[..., 2])], axis=-1)


def inverse(a: Array) -> Array:
    """⊖a: compose(a, inverse(a)) is zero."""
    a = np.asarray(a, dtype=float)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    return np.stack([-c * a[..., 0] - s * a[..., 1], s * a[..., 0] - c * a[..., 1], wrap_angle(-a[..., 2])], axis=-1)


def relative(a: Array, b: Array) -> Array:
    """b ⊖ a: the pose b seen in the frame of a; compose(a, relative(a, b)) is b."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    return np.stack([c * dx + s * dy, -s * dx + c * dy, wrap_angle(b[..., 2] - a[..., 2])], axis=-1)


def transform(pose: Array, points: Array) -> Array:
    """Points (..., 2) in the frame of `pose` (3,), in the frame that the pose is given in."""
    return np.asarray(points) @ rotation(pose[2]).T + np.asarray(pose)[:2]


def rotation(angle: float) -> Array:
    """R(θ), (2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def compose_jacobians(a: Array, b: Array) -> tuple[Array, Array]:
    """∂(a ⊕ b)/∂a and ∂(a ⊕ b)/∂b, each (..., 3, 3)."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    j_a = np.broadcast_to(np.eye(3), (*c.shape, 3, 3)).copy()
    j_a[..., 0, 2] = -s * b[..., 0] - c * b[..., 1]
    j_a[..., 1, 2] = c * b[..., 0] - s * b[..., 1]
    j_b = np.zeros((*c.shape, 3, 3))
    j_b[..., 0, 0], j_b[..., 0, 1], j_b[..., 1, 0], j_b[..., 1, 1], j_b[..., 2, 2] = c, -s, s, c, 1.0
    return j_a, j_b


def relative_jacobians(a: Array, b: Array) -> tuple[Array, Array]:
    """∂(b ⊖ a)/∂a and ∂(b ⊖ a)/∂b, each (..., 3, 3)."""
    a, b = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    c, s = np.cos(a[..., 2]), np.sin(a[..., 2])
    dx, dy = b[..., 0] - a[..., 0], b[..., 1] - a[..., 1]
    j_b = np.zeros((*c.shape, 3, 3))
    j_b[..., 0, 0], j_b[..., 0, 1], j_b[..., 1, 0], j_b[..., 1, 1], j_b[..., 2, 2] = c, s, -s, c, 1.0
    j_a = -j_b
    j_a[..., 0, 2] = -s * dx + c * dy
    j_a[..., 1, 2] = -c * dx - s * dy
    return j_a, j_b


def accumulate(start: Array, motions: Array) -> Array:
    """Poses (n + 1, 3) of a chain: `start` (3,), then each motion (n, 3) in the frame of the pose before it."""
    headings = np.concatenate([[start[2]], start[2] + np.cumsum(motions[:, 2])])
    c, s = np.cos(headings[:-1]), np.sin(headings[:-1])
    steps = np.stack([c * motions[:, 0] - s * motions[:, 1], s * motions[:, 0] + c * motions[:, 1]], axis=-1)
    positions = np.concatenate([[start[:2]], start[:2] + np.cumsum(steps, axis=0)])
    return np.column_stack([positions, wrap_angle(headings)])


def align(source: Array, target: Array) -> Array:
    """The pose (3,) that best carries points `source` (n, 2) onto `target` (n, 2): least squares, no scaling.

    Source: Umeyama 1991, eq. 34, in the plane, where the singular value decomposition becomes one arctangent.
    """
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    angle = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    shift = target.mean(axis=0) - rotation(angle) @ source.mean(axis=0)
    return np.array([shift[0], shift[1], angle])


def interpolate_poses(times: Array, poses: Array, at: Array) -> Array:
    """Poses (k, 3) at times `at` (k,), between poses (m, 3) at rising `times` (m,); held before the first and after
    the last.
    """
    columns = [poses[:, 0], poses[:, 1], np.unwrap(poses[:, 2])]
    return np.column_stack([np.interp(at, times, column) for column in columns])

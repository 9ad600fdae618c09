"""Sparse Cholesky factors of normal equations whose unknowns are poses: blocks of 3 × 3 numbers.

In: which poses are linked. Out: the pattern of the factor, found once; then factors, solutions and blocks of the
inverse for as many matrices of that pattern as are wanted. Poses are eliminated by minimum degree, those of a chain in
its order; the entries of the matrix lie where those of the factor will, which is computed in place, column by column.

    order   2 0 1        diagonal (n, 3, 3)      below (e, 3, 3): the blocks of a column one after the other,
            ▪                                     of rows `rows[first[j]:first[j + 1]]`, ascending
              ▪
            ▪ ▪ ▪

Sources: Davis 2006, "Direct Methods for Sparse Linear Systems", chapter 4 (elimination tree, left-looking);
Takahashi, Fagan & Chin 1973 for the blocks of the inverse.
"""

import math
from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numba import njit
from numpy.typing import NDArray
from scipy.sparse.linalg import splu

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

CHAIN = 16  # where no link reaches further along a row of poses, they are best eliminated one after the other


@dataclass(frozen=True, slots=True)
class Pattern:
    """n unknown poses, in the order in which they are eliminated."""

    free: Ints  # (n,) the number of each
    place: Ints  # (N,) of every pose in that order; -1: it is fixed
    first: Ints  # (n + 1,) where each column begins
    rows: Ints  # (e,) ascending within a column
    by_row: Ints  # (n + 1,) where each row begins in the two below
    columns: Ints  # (e,)
    entries: Ints  # (e,) which block of `rows` that is

    def __len__(self) -> int:
        return len(self.free)

    def slots(self, ends: Ints) -> Ints:
        """Where the blocks of links (m, 2) lie below the diagonal; -1 where an end is fixed."""
        return _slots(self.place, self.first, self.rows, ends)


def find_pattern(poses: int, ends: Ints, fixed: NDArray[np.bool_]) -> Pattern:
    """The pattern of `poses` poses with links (m, 2) between them, some of which are fixed."""
    free = np.flatnonzero(~fixed)
    number = np.full(poses, -1, np.int64)
    number[free] = np.arange(len(free))
    both = number[ends]
    both = both[np.all(both >= 0, axis=1) & (both[:, 0] != both[:, 1])]
    a, b = np.concatenate([both, both[:, ::-1]]).T
    adjacent = sp.csr_array((np.ones(len(a)), (a, b)), shape=(len(free), len(free)))
    is_chain = np.abs(a - b).max(initial=0) <= CHAIN
    place = np.arange(len(free)) if is_chain else _minimum_degree(adjacent)
    order = np.argsort(place)
    first, rows = _fill(adjacent.indptr.astype(np.int64), adjacent.indices.astype(np.int64), place, order)
    of_row = np.argsort(rows, kind="stable")
    columns = np.repeat(np.arange(len(free)), np.diff(first))[of_row]
    placed = np.full(poses, -1, np.int64)
    placed[free] = place
    by_row = np.searchsorted(rows[of_row], np.arange(len(free) + 1))
    return Pattern(free[order], placed, first, rows, by_row, columns, of_row)


def _minimum_degree(adjacent: sp.csr_array) -> Ints:
    """The place (n,) of each unknown in the order of elimination: SuperLU finds one on its way to factors."""
    if adjacent.shape[0] < 3:
        return np.arange(adjacent.shape[0])
    dominant = adjacent + sp.diags_array(np.asarray(adjacent.sum(axis=1)).ravel() + 1.0)
    options = {"SymmetricMode": True}
    factors = splu(dominant.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    return np.asarray(factors.perm_c, np.int64)


@njit(cache=True)
def _fill(starts: Ints, neighbours: Ints, place: Ints, order: Ints) -> tuple[Ints, Ints]:
    """Columns and rows of the factor: row i holds all that is met on the way up the elimination tree from its links."""
    n = len(place)
    parent, mark, first = np.full(n, -1), np.full(n, -1), np.zeros(n + 1, np.int64)
    for i in range(n):
        mark[i] = i
        for q in range(starts[order[i]], starts[order[i] + 1]):
            j = place[neighbours[q]]
            while j < i and mark[j] != i:
                if parent[j] < 0:
                    parent[j] = i
                first[j + 1] += 1
                mark[j] = i
                j = parent[j]
    first = np.cumsum(first)
    rows, end = np.empty(first[n], np.int64), first[:-1].copy()
    mark[:] = -1
    for i in range(n):
        mark[i] = i
        for q in range(starts[order[i]], starts[order[i] + 1]):
            j = place[neighbours[q]]
            while j < i and mark[j] != i:
                rows[end[j]] = i
                end[j] += 1
                mark[j] = i
                j = parent[j]
    return first, rows


@njit(cache=True)
def _slots(place: Ints, first: Ints, rows: Ints, ends: Ints) -> Ints:
    out = np.full(len(ends), -1)
    for k in range(len(ends)):
        a, b = place[ends[k, 0]], place[ends[k, 1]]
        if a >= 0 and b >= 0 and a != b:
            low, high = min(a, b), max(a, b)
            out[k] = first[low] + np.searchsorted(rows[first[low] : first[low + 1]], high)
    return out


def factorise(pattern: Pattern, diagonal: Array, below: Array) -> bool:
    """Replace a matrix by its factor, in place; False where it is not positive definite."""
    return bool(
        _factorise(pattern.first, pattern.rows, pattern.by_row, pattern.columns, pattern.entries, diagonal, below)
    )


@njit(cache=True)
def _factorise(
    first: Ints, rows: Ints, by_row: Ints, columns: Ints, entries: Ints, diagonal: Array, below: Array
) -> bool:
    n = len(diagonal)
    work = np.zeros((n, 3, 3))
    for k in range(n):
        d = diagonal[k]
        for q in range(first[k], first[k + 1]):
            work[rows[q]] = below[q]
        for p in range(by_row[k], by_row[k + 1]):
            j, entry = columns[p], entries[p]
            b00, b01, b02 = below[entry, 0, 0], below[entry, 0, 1], below[entry, 0, 2]
            b10, b11, b12 = below[entry, 1, 0], below[entry, 1, 1], below[entry, 1, 2]
            b20, b21, b22 = below[entry, 2, 0], below[entry, 2, 1], below[entry, 2, 2]
            d[0, 0] -= b00 * b00 + b01 * b01 + b02 * b02
            d[1, 0] -= b10 * b00 + b11 * b01 + b12 * b02
            d[1, 1] -= b10 * b10 + b11 * b11 + b12 * b12
            d[2, 0] -= b20 * b00 + b21 * b01 + b22 * b02
            d[2, 1] -= b20 * b10 + b21 * b11 + b22 * b12
            d[2, 2] -= b20 * b20 + b21 * b21 + b22 * b22
            for q in range(entry + 1, first[j + 1]):
                w = work[rows[q]]
                for r in range(3):
                    x, y, z = below[q, r, 0], below[q, r, 1], below[q, r, 2]
                    w[r, 0] -= x * b00 + y * b01 + z * b02
                    w[r, 1] -= x * b10 + y * b11 + z * b12
                    w[r, 2] -= x * b20 + y * b21 + z * b22
        if not d[0, 0] > 0:
            return False
        d[0, 0] = math.sqrt(d[0, 0])
        d[1, 0] /= d[0, 0]
        d[2, 0] /= d[0, 0]
        d[1, 1] -= d[1, 0] * d[1, 0]
        if not d[1, 1] > 0:
            return False
        d[1, 1] = math.sqrt(d[1, 1])
        d[2, 1] = (d[2, 1] - d[2, 0] * d[1, 0]) / d[1, 1]
        d[2, 2] -= d[2, 0] * d[2, 0] + d[2, 1] * d[2, 1]
        if not d[2, 2] > 0:
            return False
        d[2, 2] = math.sqrt(d[2, 2])
        d[0, 1] = d[0, 2] = d[1, 2] = 0.0
        for q in range(first[k], first[k + 1]):
            for r in range(3):  # x Lᵀ = w
                x = work[rows[q], r, 0] / d[0, 0]
                y = (work[rows[q], r, 1] - x * d[1, 0]) / d[1, 1]
                below[q, r, 0], below[q, r, 1] = x, y
                below[q, r, 2] = (work[rows[q], r, 2] - x * d[2, 0] - y * d[2, 1]) / d[2, 2]
    return True


@njit(cache=True)
def _forward(first: Ints, rows: Ints, diagonal: Array, below: Array, x: Array) -> None:
    """x (n, 3, c) becomes L⁻¹ x."""
    for j in range(len(diagonal)):
        d = diagonal[j]
        for c in range(x.shape[2]):
            x0 = x[j, 0, c] / d[0, 0]
            x1 = (x[j, 1, c] - d[1, 0] * x0) / d[1, 1]
            x2 = (x[j, 2, c] - d[2, 0] * x0 - d[2, 1] * x1) / d[2, 2]
            x[j, 0, c], x[j, 1, c], x[j, 2, c] = x0, x1, x2
        for q in range(first[j], first[j + 1]):
            for r in range(3):
                for c in range(x.shape[2]):
                    x[rows[q], r, c] -= (
                        below[q, r, 0] * x[j, 0, c] + below[q, r, 1] * x[j, 1, c] + below[q, r, 2] * x[j, 2, c]
                    )


@njit(cache=True)
def _backward(first: Ints, rows: Ints, diagonal: Array, below: Array, x: Array) -> None:
    """x (n, 3) becomes L⁻ᵀ x."""
    for j in range(len(diagonal) - 1, -1, -1):
        d = diagonal[j]
        for q in range(first[j], first[j + 1]):
            for c in range(3):
                for r in range(3):
                    x[j, c] -= below[q, r, c] * x[rows[q], r]
        x[j, 2] /= d[2, 2]
        x[j, 1] = (x[j, 1] - d[2, 1] * x[j, 2]) / d[1, 1]
        x[j, 0] = (x[j, 0] - d[1, 0] * x[j, 1] - d[2, 0] * x[j, 2]) / d[0, 0]


def whiten(pattern: Pattern, diagonal: Array, below: Array, right: Array) -> Array:
    """L⁻¹ right (n, 3, c), of the factor L; places as in the pattern."""
    out = np.array(right)
    _forward(pattern.first, pattern.rows, diagonal, below, out)
    return out


def solve_factors(pattern: Pattern, diagonal: Array, below: Array, right: Array) -> Array:
    """The solution (n, 3) for one right side (n, 3)."""
    out = whiten(pattern, diagonal, below, right[..., None])[..., 0]
    _backward(pattern.first, pattern.rows, diagonal, below, out)
    return out


def inverse_blocks(pattern: Pattern, diagonal: Array, below: Array) -> Array:
    """The blocks (n, 3, 3) on the diagonal of the inverse; no others but those of the pattern are computed."""
    return np.asarray(_invert(pattern.first, pattern.rows, diagonal, below))


@njit(cache=True)
def _invert(first: Ints, rows: Ints, diagonal: Array, below: Array) -> Array:
    n = len(diagonal)
    on, off = np.zeros((n, 3, 3)), np.zeros(below.shape)
    local = np.full(n, -1)
    for j in range(n - 1, -1, -1):
        start, count = first[j], first[j + 1] - first[j]
        inner = _inverse_lower(diagonal[j])
        scaled = np.zeros((count, 3, 3))  # L_kj L_jj⁻¹
        for k in range(count):
            add_product(below[start + k], inner, 1.0, scaled[k])
            local[rows[start + k]] = k
        total = np.zeros((count, 3, 3))
        for k in range(count):  # Z_ij = -Σ_k Z_ik L_kj L_jj⁻¹
            row = rows[start + k]
            add_product(on[row], scaled[k], -1.0, total[k])
            for q in range(first[row], first[row + 1]):
                i = local[rows[q]]
                if i >= 0:
                    add_product(off[q], scaled[k], -1.0, total[i])
                    add_product(off[q].T, scaled[i], -1.0, total[k])
        add_product(inner.T, inner, 1.0, on[j])
        for k in range(count):
            off[start + k] = total[k]
            add_product(scaled[k].T, total[k], -1.0, on[j])
            local[rows[start + k]] = -1
    return on


@njit(cache=True)
def _inverse_lower(lower: Array) -> Array:
    """The inverse of a lower triangle (3, 3)."""
    out = np.zeros((3, 3))
    for i in range(3):
        out[i, i] = 1.0 / lower[i, i]
    out[1, 0] = -lower[1, 0] * out[0, 0] * out[1, 1]
    out[2, 1] = -lower[2, 1] * out[1, 1] * out[2, 2]
    out[2, 0] = -(lower[2, 0] * out[0, 0] + lower[2, 1] * out[1, 0]) * out[2, 2]
    return out


@njit(cache=True)
def add_product(a: Array, b: Array, sign: float, out: Array) -> None:
    """out += sign · a b, of 3 × 3: written out, for a call to a library costs more than ten such products."""
    for i in range(3):
        u, v, w = sign * a[i, 0], sign * a[i, 1], sign * a[i, 2]
        for j in range(3):
            out[i, j] += u * b[0, j] + v * b[1, j] + w * b[2, j]

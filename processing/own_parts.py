"""The vehicle's own parts in view of its scanner: what stays where it is however the view changes.

A part that rides along says "you did not move" at every scan. It is told from walls by views that differ: in a straight
smooth drift the walls stay where they are as well, and before a parked vehicle all does, but then nearly the whole view
does so, and all of it is one view only.

    views that differ      range of one beam [m]
           1              1.52   2.30               a part: the same in most views, and hardly ever is anything seen
           2              1.53   4.71               beyond it; nearer there may be dust
           3              0.80   2.28
           4              1.52   3.05

In: the ranges of a run. Out: its `OwnPart`s. A vehicle ahead, or one that follows, keeps no distance to the centimetre.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]
Rows = NDArray[np.float32]

CANDIDATES = 1000  # scans of the run that are looked at, evenly spaced
BLOCKS, MIN_BLOCK = 60, 9  # a view is the furthest return in each block of beams, which dust and dropouts leave alone
FAR_M = 10.0  # changes beyond it do not count
CHANGED_M, CHANGED_SHARE = 0.1, 0.5  # two views differ when more than half of their blocks do
MIN_VIEWS, ENOUGH_VIEWS = 10, 20  # on one straight way to a crossing, side walls stay where they are in most of a few
REACH_M = 5.0  # no vehicle is larger
SPREAD_M = 0.05  # what a part's ranges keep within: four standard deviations of a laser
SEEN_SHARE, CLEAR_SHARE = 0.5, 0.9  # of the views in which a part is seen: where there are enough of them, and if not
SOLID_SHARE = 0.8  # of those in which it is seen or something beyond it is
WIDEN_BEAMS = 2  # that hit the edge of a part now and then


@dataclass(frozen=True, slots=True)
class OwnPart:
    """A sector of beams, `first` to before `end`, that see the vehicle itself."""

    first: int
    end: int
    from_rad: float
    to_rad: float
    range_m: float  # the median of its beams

    def __str__(self) -> str:
        from_deg, to_deg = np.degrees((self.from_rad, self.to_rad))
        return f"{from_deg:.0f}°…{to_deg:.0f}° see the vehicle itself at {self.range_m:.1f} m"


class Stored(Protocol):
    """Ranges (n, B) [m] in memory, or rows of them in a file."""

    @property
    def shape(self) -> tuple[int, ...]: ...
    def __getitem__(self, rows: Ints, /) -> Rows: ...


class Constancy(NamedTuple):
    """Of each beam (B,): how steadily it sees something near."""

    seen: Array  # the share of views in which its range is within SPREAD_M of the usual one
    solid: Array  # the same, of the views in which nothing nearer hides it
    range_m: Array


def find_own_parts(ranges: Stored, angles: Array) -> list[OwnPart]:
    """The parts of the vehicle that are in view over the whole run, by ascending angle.

    Args:
        ranges: (n, B) m; not finite: no return.
        angles: (B,) rad, ascending.
    """
    candidates = np.linspace(0, ranges.shape[0] - 1, min(CANDIDATES, ranges.shape[0])).astype(np.int64)
    rows = ranges[candidates]
    views = differing_views(rows)
    if len(views) < MIN_VIEWS:
        return []
    found = constancy(rows[views])
    seen_share = SEEN_SHARE if len(views) >= ENOUGH_VIEWS else CLEAR_SHARE
    own = (found.seen >= seen_share) & (found.solid >= SOLID_SHARE)
    own = own & (_shift(own, 1) | _shift(own, -1))  # one beam alone is chance
    wide = own.copy()
    for beams in range(1, WIDEN_BEAMS + 1):
        wide |= _shift(own, beams) | _shift(own, -beams)
    edges = np.flatnonzero(np.diff(wide, prepend=False, append=False))
    return [
        OwnPart(
            first,
            end,
            float(angles[first]),
            float(angles[end - 1]),
            float(np.median(found.range_m[first:end][own[first:end]])),
        )
        for first, end in edges.reshape(-1, 2).tolist()
    ]


def differing_views(ranges: Rows) -> Ints:
    """Rows (k,) of ranges (n, B) each of which differs from all that were taken before it."""
    views = _signatures(ranges)
    kept: list[int] = []
    taken = np.empty_like(views)
    for row in np.flatnonzero(np.isfinite(views).mean(axis=1) > CHANGED_SHARE).tolist():
        change = np.abs(taken[: len(kept)] - views[row])
        known = np.isfinite(change).sum(axis=1)
        if np.all((change > CHANGED_M).sum(axis=1) > CHANGED_SHARE * known):
            taken[len(kept)] = views[row]
            kept.append(row)
    return np.array(kept, np.int64)


def constancy(ranges: Rows) -> Constancy:
    """How steadily each beam sees something near, in views (k, B) that differ."""
    seen, solid, usual = np.zeros((3, ranges.shape[1]))
    for beam, column in enumerate(np.sort(np.where(np.isfinite(ranges), ranges, np.inf), axis=0).T):
        returns = column[: np.searchsorted(column, np.inf)]
        near = returns[: np.searchsorted(returns, REACH_M)]
        if len(near):
            first = np.arange(len(near))
            alike = np.searchsorted(returns, near + SPREAD_M, side="right") - first
            best = int(np.argmax(alike))
            seen[beam], solid[beam] = alike[best] / len(column), alike[best] / (len(returns) - best)
            usual[beam] = np.median(returns[best : best + alike[best]])
    return Constancy(seen, solid, usual)


def _signatures(ranges: Rows) -> Array:
    """The furthest return in each block of beams (n, blocks), FAR_M at most; NaN where there is none."""
    block = max(MIN_BLOCK, ranges.shape[1] // BLOCKS)
    whole = ranges[:, : ranges.shape[1] // block * block].reshape(len(ranges), -1, block)
    furthest = np.where(np.isfinite(whole), np.minimum(whole, FAR_M), -1.0).max(axis=2)
    return np.where(furthest < 0, np.nan, furthest)


def _shift(mask: Bools, beams: int) -> Bools:
    """The mask (B,) moved by so many beams; what moves in is False."""
    moved = np.zeros_like(mask)
    if beams > 0:
        moved[beams:] = mask[:-beams]
    else:
        moved[:beams] = mask[-beams:]
    return moved

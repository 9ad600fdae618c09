"""Tags that are not at one place: moved between two passes or during a run, or one EPC on two tags.

In: the passes of all runs, and where open loop puts them. Out: the EPCs that must not join anything.

    run 1   ──A────────T──────B──         Fixed tags are as far from each other in every run, whichever way was driven
    run 2   ──A─────────────T─B──         between them: |AT| has grown and |TB| shrunk, |AB| is the same. T was moved.

Nothing but distances is compared, so no run need be joined to another first, and a moved tag bends nothing. Each pair
of passes of a tag is judged by the majority of the tags that both runs passed near by. Passes that see the same walls
are at one place, whatever open loop says; so a run that went astray between two tags does not condemn either.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from processing.beacons import Pass

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
PassId = tuple[int, int]  # run, number of the pass in it

NEIGHBOURS = 8  # passes before and after that may bear witness
WITNESSES = 4  # the tags with the least doubt
LATER = 4  # each pass of a tag is compared with so many later ones
JITTER_M, DRIFT_SHARE = 2.0, 0.03  # how far a distance may differ, besides what the read clouds leave open


@dataclass(frozen=True, slots=True)
class OpenPasses:
    """The passes of one run, and where open loop puts their centres."""

    passes: Sequence[Pass]
    positions: Array  # (k, 2) m
    way: Array  # (k,) m driven until there


def find_moved(runs: Sequence[OpenPasses], same_walls: Callable[[PassId, PassId], bool]) -> list[str]:
    """The EPCs that were passed at two places or more, ascending; `same_walls` says whether two passes surely see the
    same walls.

    The worst is left out first, and the others judged without it; where several are as bad, as when only two tags
    are there, all of them are.
    """
    moved: list[str] = []
    while True:
        apart = {epc: pairs for epc, pairs in _pairs_apart(runs, set(moved)).items() if _stand(pairs, same_walls)}
        if not apart:
            return sorted(moved)
        worst = max(_blame(pairs) for pairs in apart.values())
        moved += [epc for epc, pairs in apart.items() if _blame(pairs) == worst]


@dataclass(frozen=True, slots=True)
class _Pair:
    """Two passes of one tag that more of the tags near by say are apart than say are together, and how many more."""

    first: PassId
    second: PassId
    majority: int


def _blame(pairs: list[_Pair]) -> int:
    return max(pair.majority for pair in pairs)


def _stand(pairs: list[_Pair], same_walls: Callable[[PassId, PassId], bool]) -> bool:
    """Does what the distances say hold before the scans? One pair of different places in twenty looks alike."""
    return 2 * sum(same_walls(pair.first, pair.second) for pair in pairs) < len(pairs)


def _pairs_apart(runs: Sequence[OpenPasses], without: set[str]) -> dict[str, list[_Pair]]:
    visits: dict[str, list[PassId]] = defaultdict(list)
    for r, run in enumerate(runs):
        for k, found in enumerate(run.passes):
            if found.epc not in without:
                visits[found.epc].append((r, k))
    apart: dict[str, list[_Pair]] = defaultdict(list)
    for epc, of in sorted(visits.items()):
        for number, first in enumerate(of):
            for second in of[number + 1 : number + 1 + LATER]:
                witnesses = sorted(_witnesses(runs, first, second, without))[:WITNESSES]
                majority = sum(1 if excess > 0 else -1 for _, excess in witnesses)
                if majority > 0:
                    apart[epc].append(_Pair(first, second, majority))
    return apart


def _witnesses(
    runs: Sequence[OpenPasses], first: PassId, second: PassId, without: set[str]
) -> list[tuple[float, float]]:
    """For each tag that both runs passed near by: the doubt in metres, and by how much more the distances differ.

    Where one run made both passes, the first of them is a witness too: its own distance must be none.
    """
    out = []
    near_first, near_second = _near(runs[first[0]], first[1], without), _near(runs[second[0]], second[1], without)
    for epc in sorted(near_first.keys() & near_second.keys()):
        if epc == runs[first[0]].passes[first[1]].epc:
            continue
        out.append(min(_compare(runs, first, second, a, b) for a in near_first[epc] for b in near_second[epc]))
    if first[0] == second[0]:
        out.append(_compare(runs, first, second, first[1], first[1]))
    return out


def _near(run: OpenPasses, k: int, without: set[str]) -> dict[str, list[int]]:
    near: dict[str, list[int]] = defaultdict(list)
    for other in range(max(0, k - NEIGHBOURS), min(len(run.passes), k + NEIGHBOURS + 1)):
        if run.passes[other].epc not in without:
            near[run.passes[other].epc].append(other)
    return near


def _compare(runs: Sequence[OpenPasses], first: PassId, second: PassId, a: int, b: int) -> tuple[float, float]:
    distances, doubt = [], JITTER_M
    for (r, k), witness in ((first, a), (second, b)):
        run = runs[r]
        distances.append(float(np.hypot(*(run.positions[k] - run.positions[witness]))))
        doubt += DRIFT_SHARE * float(abs(run.way[k] - run.way[witness]))
        doubt += (run.passes[k].range_m + run.passes[witness].range_m) / 2
    return doubt, abs(distances[0] - distances[1]) - doubt

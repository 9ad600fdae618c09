"""What the tags say, reviewed: tags that are not at one place are left out, passes that were not read are put in.

In: driven runs, before and after they are mapped. Out: the same runs with other passes, and what was left out and why,
as it stands in atlas.json.
"""

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from processing.beacons import Pass, thin_passes
from processing.edge_placement import Placement
from processing.missed_tags import MappedRun, add_passes, find_missed
from processing.moved_tags import OpenPasses, PassId, find_moved
from processing.registration import Passing, register_passes
from processing.scan_matching import Matcher
from processing.trajectory import keyframe_poses

REACH_M = 20.0  # from the middle of a cloud to its ends; no reader of passive tags reaches as far
ELSEWHERE = "it was read over much less way than is usual: from elsewhere, down the drift or through rock"
RIDES = "it was read on and on over more way than a reader reaches: it rides along"
MOVED = "by its distance to other tags it was read at more than one place: moved, or two tags of one EPC"

if TYPE_CHECKING:
    from processing.pipeline import DrivenRun


def leave_out_moved(runs: list["DrivenRun"]) -> tuple[list["DrivenRun"], list[dict[str, Any]]]:
    """The runs without reads from elsewhere and without tags that are at no one place, and what to tell of these."""
    thin = thin_passes([run.passes for run in runs], [len(run.loop) for run in runs])
    left_out = [
        _left_out(run, found.epc, [found], ELSEWHERE) for run, of in zip(runs, thin, strict=True) for found in of
    ]
    runs = [
        replace(run, passes=[found for found in run.passes if found not in of])
        for run, of in zip(runs, thin, strict=True)
    ]
    riding = {found.epc for run in runs for found in _passed_on_and_on(run)}
    staying = _without(runs, riding)

    open_loop = [run.loop.keyframe_poses for run in staying]

    def passing(of: PassId) -> Passing:
        loop, centre = staying[of[0]].loop, staying[of[0]].passes[of[1]].centre
        return Passing(open_loop[of[0]], loop.scans, loop.sweeps.mount, int(np.searchsorted(loop.keyframes, centre)))

    @cache
    def same_walls(first: PassId, second: PassId) -> bool:
        return register_passes(passing(first), passing(second)) is not None

    moved = find_moved([_open_passes(run) for run in staying], same_walls)
    reasons = dict.fromkeys(riding, RIDES) | dict.fromkeys(moved, MOVED)
    left_out += [
        _left_out(run, epc, passes, reason)
        for epc, reason in sorted(reasons.items())
        for run in runs
        if (passes := [found for found in run.passes if found.epc == epc])
    ]
    return _without(staying, set(moved)), left_out


def _left_out(run: "DrivenRun", epc: str, passes: list[Pass], reason: str) -> dict[str, Any]:
    ticks = [int(run.run.scan_ticks[found.centre]) for found in passes]
    return {"what": f"tag {epc}", "run": run.run.run_id, "ticks": ticks, "reason": reason}


def _without(runs: list["DrivenRun"], epcs: set[str]) -> list["DrivenRun"]:
    return [replace(run, passes=[found for found in run.passes if found.epc not in epcs]) for run in runs]


def _passed_on_and_on(driven: "DrivenRun") -> list[Pass]:
    """Passes that are none: the tag was read without a break at places too far from each other."""
    at, keyframes = driven.loop.keyframe_poses[:, :2], driven.loop.keyframes
    out = []
    for found in driven.passes:
        first, centre, last = np.searchsorted(keyframes, [found.first, found.centre, found.last])
        if np.hypot(*(at[first : last + 1] - at[centre]).T).max(initial=0.0) > REACH_M:
            out.append(found)
    return out


def _open_passes(driven: "DrivenRun") -> OpenPasses:
    poses = driven.loop.keyframe_poses
    way = np.append(0.0, np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T)))
    at = np.searchsorted(driven.loop.keyframes, [found.centre for found in driven.passes]).astype(int)
    return OpenPasses(driven.passes, poses[at, :2], way[at])


def add_missed(runs: list["DrivenRun"], placed: Placement, match: Matcher) -> list["DrivenRun"] | None:
    """The runs with the passes that they made without reading the tag; None where there is none to be added."""
    parts = {span.run: piece.part for piece in placed.pieces for span in piece.solved.input.piece.spans}
    mapped = [
        MappedRun(
            run.passes,
            run.loop.keyframes,
            keyframe_poses(placed.pieces, number, len(run.loop.keyframes)),
            run.loop.scans,
            parts[number],
            run.loop.sweeps.mount,
        )
        for number, run in enumerate(runs)
    ]
    passes = [add_passes(run.passes, missed) for run, missed in zip(runs, find_missed(mapped, match), strict=True)]
    if all(len(run.passes) == len(of) for run, of in zip(runs, passes, strict=True)):
        return None
    return [replace(run, passes=of) for run, of in zip(runs, passes, strict=True)]

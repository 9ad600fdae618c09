"""What the user should know about an atlas, a line each: what was driven by, what stays alone, what could not be seen.

In: the runs as they were mapped, and where their pieces lie. Out: lines for `build`, `info` and atlas.json.
"""

from collections import Counter, defaultdict
from typing import TYPE_CHECKING

import numpy as np

from processing.beacons import Pass, overlapping_passes
from processing.edge_placement import Placement

GAP_S, GAP_M = 1.0, 2.0  # a scanner that is silent for longer, on a vehicle that drives on

if TYPE_CHECKING:
    from processing.pipeline import DrivenRun


def remarks(runs: list["DrivenRun"], placed: Placement) -> list[str]:
    out = []
    for driven in runs:
        name = driven.run.run_id
        out += [f"run {name}: beams at {part}; they are left out" for part in driven.run.scans.own_parts]
        for found in driven.passes:
            if not found.read:
                tick = int(driven.run.scan_ticks[found.centre])
                out.append(f"run {name} drove by {found.epc} at tick {tick} without reading it; it is cut there")
        out += [f"run {name}: the read clouds of {a} and {b} overlap" for a, b in _overlaps(driven.passes)]
        lost = int((~driven.loop.matched[1:]).sum())
        if lost:
            out.append(f"run {name}: {lost} of {len(driven.loop.matched)} scans follow odometry alone")
        out += [f"run {name} {gap}" for gap in _gaps(driven)]
    return out + placed.remarks + _remark_parts(runs, placed)


def _gaps(driven: "DrivenRun") -> list[str]:
    """Where a run went on without a scan, as when a part of the recording is missing."""
    seconds, moved = np.diff(driven.run.scans.times), np.hypot(*driven.loop.odometry.deltas[:, :2].T)
    return [
        f"moved {moved[k]:.1f} m in {seconds[k]:.1f} s without a scan after tick {int(driven.run.scan_ticks[k])}"
        for k in np.flatnonzero((seconds > GAP_S) & (moved > GAP_M)).tolist()
    ]


def _overlaps(passes: list[Pass]) -> list[tuple[str, str]]:
    pairs = overlapping_passes([found for found in passes if found.read])
    return sorted({(min(a.epc, b.epc), max(a.epc, b.epc)) for a, b in pairs})


def _remark_parts(runs: list["DrivenRun"], placed: Placement) -> list[str]:
    """Which runs hang together by little or by nothing."""
    of_run = {span.run: piece.part for piece in placed.pieces for span in piece.solved.input.piece.spans}
    members = defaultdict(list)
    for number, driven in enumerate(runs):
        members[of_run[number]].append(driven.run.run_id)
    epcs = [{found.epc for found in driven.passes} for driven in runs]
    passed_by = Counter(epc for of in epcs for epc in of)
    out = []
    for number, driven in enumerate(runs):
        tags, alone = len(epcs[number]), len(members[of_run[number]]) == 1
        if alone and (tags < 2 or len(runs) > 1):
            shares = f"passed {tags} tag{'s' * (tags != 1)}" if tags < 2 else "shares no tag with the others"
            if tags > 1 and any(passed_by[epc] > 1 for epc in epcs[number]):
                shares = "saw no walls like the others' at the tags that they share"
            out.append(f"run {driven.run.run_id} {shares}: it is mapped alone")
        elif tags < 2:
            out.append(
                f"run {driven.run.run_id} passed 1 tag: that alone, and the walls around it, join it to the others"
            )
    if len(members) > 1:
        names = "; ".join(", ".join(of) for _, of in sorted(members.items()))
        out.append(f"runs of each part: {names}")
    return out

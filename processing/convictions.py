"""Convictions: the stretches of a run in which one witness was not believed, and by how much it was off.

In: the scans at which wheels and walls contradicted each other. Out: what stands in atlas.json: run, ticks from and to,
which witness, and how much. Contradictions close to each other are one stretch: a wheel that slips for a second.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from processing.chain import Contradiction
from processing.geometry import accumulate, relative
from processing.sensor_calibration import SIGNIFICANT

if TYPE_CHECKING:
    from processing.pipeline import DrivenRun

Array = NDArray[np.float64]

WORTH_TELLING = 0.02  # every tyre is worn by a percent
TOGETHER_S = 2.0  # a pause between contradictions that is shorter belongs to the stretch


def convictions(driven: "DrivenRun") -> list[dict[str, Any]]:
    """Those of a run, in order."""
    times, ticks, poses = driven.run.scans.times, driven.run.scan_ticks, driven.loop.poses
    whole, scale = [int(ticks[0]), int(ticks[-1])], driven.wheels.scale
    wrong = list(driven.put_right)
    if abs(scale - 1) > max(WORTH_TELLING, SIGNIFICANT * driven.wheels.sigma):
        wrong.append(f"the wheels' way off by {100 * (1 - scale):.1f} ± {100 * driven.wheels.sigma:.1f} %")
    out: list[dict[str, Any]] = [
        {"run": driven.run.run_id, "ticks": whole, "what": "profile", "how_much": line} for line in wrong
    ]
    out += [_tell_skid(driven, int(a), int(b)) for a, b in _stretches_of(driven.loop.odometry.guessed)]
    for convicts_wheels in (True, False):
        found = [of for of in driven.loop.contradictions if of.convicts_wheels == convicts_wheels]
        cuts = [k for k, (a, b) in enumerate(pairwise(found), 1) if times[b.scan] - times[a.scan] > TOGETHER_S]
        for first, last in pairwise([0, *cuts, len(found)]):
            if first < last:
                a, b = found[first].scan - 1, found[last - 1].scan
                if convicts_wheels:
                    wheels = accumulate(np.zeros(3), driven.loop.odometry.deltas[a:b])[-1]
                    how_much = _tell_wheels(relative(wheels, relative(poses[a], poses[b])))
                else:
                    how_much = _tell_scans(found[first:last])
                out.append(
                    {
                        "run": driven.run.run_id,
                        "ticks": [int(ticks[a]), int(ticks[b])],
                        "what": "wheels" if convicts_wheels else "scan",
                        "how_much": f"{how_much} within {times[b] - times[a]:.1f} s",
                    }
                )
    return sorted(out, key=lambda of: (of["ticks"], of["what"]))


def _tell_wheels(off: Array) -> str:
    """By how much the wheels would have led astray (3,) in all."""
    return f"{np.hypot(off[0], off[1]):.2f} m and {abs(np.degrees(off[2])):.1f}° off the walls"


def _tell_scans(stretch: Sequence[Contradiction]) -> str:
    """What the worst was; the walls of these scans would have fitted elsewhere as well."""
    missed = np.array([of.missed for of in stretch])
    metres, degrees = np.hypot(missed[:, 0], missed[:, 1]).max(), np.degrees(np.abs(missed[:, 2]).max())
    return f"{len(stretch)} scans up to {metres:.2f} m and {degrees:.1f}° off the wheels"


def _stretches_of(marked: NDArray[np.bool_] | None) -> NDArray[np.int64]:
    """Where each begins, and one past its end (k, 2)."""
    if marked is None:
        return np.zeros((0, 2), np.int64)
    return np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]))).reshape(-1, 2)


def _tell_skid(driven: "DrivenRun", first: int, end: int) -> dict[str, Any]:
    """Motions from `first` to before `end` are none that a vehicle makes."""
    ticks, times = driven.run.scan_ticks, driven.run.scans.times
    how_much = f"motions that no vehicle makes within {times[end] - times[first]:.1f} s"
    return {
        "run": driven.run.run_id,
        "ticks": [int(ticks[first]), int(ticks[end])],
        "what": "wheels",
        "how_much": how_much,
    }
